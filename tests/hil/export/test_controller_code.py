"""The identified arm in the control loop: C that a compiler builds, and the momentum observer."""

from __future__ import annotations

import ctypes
import re
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

import hil
from hil.base.arrays import Array
from hil.export.controller_code import AGREES, STRICT, CompiledArm, checked, pointer
from hil.importers.recording_import import ImportOptions
from hil.pipeline.identified_model import model_of
from identification.errors import ModelError, ShapeError
from identification.export.controller.c_source import Precision, c_source
from identification.export.controller.reference import pinocchio_bodies, reference_torque
from identification.export.controller.structured_text import structured_text
from identification.export.controller.tables import control_tables
from identification.export.exported_arm import ExportedArm
from identification.export.observer import MomentumObserver
from identification.export.simulators import random_states
from identification.export.urdf import WriteBackError
from identification.model.coupling import Coupling
from identification.model.elements import (
    Anchors,
    ExtensionSpring,
    GasCylinder,
    PositionTorque,
    TorqueRipple,
    TorsionSpring,
)
from identification.model.friction import FrictionLaw
from identification.model.known_payload import Payload
from identification.model.motion import Motion
from identification.purposes.thresholds import ContactThreshold
from sim_fixtures.ns16 import urdf_text
from tests.hil.structured_text_reader import Block, blocks_of
from tests.identification.exported_arm import WRIST, an_arm
from tests.identification.robots import random_urdf
from tests.identification.two_link import four_sines
from tests.tiers import quick_ones

COMPILER = next(filter(shutil.which, ("cc", "gcc", "clang")), None)
pytestmark = pytest.mark.skipif(COMPILER is None, reason="there is no C compiler")

EVERY_TERM = FrictionLaw(
    offset=True, asymmetric=True, stribeck=0.2, load=True, presliding=0.02, third="quadratic"
)


def a_whole_arm() -> ExportedArm:
    """Six joints with a coupled wrist, every friction term, a payload and every element."""
    return an_arm(
        urdf_text(),
        friction=EVERY_TERM,
        gravity=(0.0, 3.0, -9.0),
        coupling=Coupling(WRIST),
        payload=Payload(4.0, (0.0, 0.1, 0.2), (0.1, 0.01, 0.0, 0.2, 0.0, 0.15)),
        elements=[
            TorsionSpring("joint_2", 0.3, 50.0),
            TorsionSpring("joint_2", -0.1, identified=True),
            ExtensionSpring("joint_3", Anchors(0.5, 0.3, 0.2), 0.4, 100.0, 3.0),
            GasCylinder("joint_3", Anchors(0.8, 0.2, 0.1), 0.6, 1e-3, 1e6, 1e-3),
            GasCylinder(
                "joint_2", Anchors(0.8, 0.2, 0.1), 0.7, 1e-3, 1e6, 1e-3,
                pulls=False, identified=True,
            ),
            TorqueRipple("joint_1", (1, 3), (("joint_1", 100.0),)),
            PositionTorque("joint_2"),
        ],
    )  # fmt: skip


ARMS = {
    "a tree with sliding joints": lambda: an_arm(
        random_urdf(1), friction=FrictionLaw(third="cubic")
    ),
    "smooth dry friction": lambda: an_arm(random_urdf(2), friction=FrictionLaw(tanh=0.1)),
    "linear at low speed": lambda: an_arm(
        urdf_text(), friction=FrictionLaw(zone="linear", standstill=0.5)
    ),
    "everything": a_whole_arm,
}


def compiled(arm: ExportedArm, folder: Path, precision: Precision = "double") -> CompiledArm:
    assert COMPILER is not None
    code = c_source(control_tables(arm), "arm", ["a remark */ with an end"], precision)
    return CompiledArm.of(code, "arm", folder, COMPILER, precision)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> tuple[ExportedArm, CompiledArm]:
    arm = a_whole_arm()
    return arm, compiled(arm, tmp_path_factory.mktemp("code"))


@pytest.mark.parametrize("precision", AGREES)
@pytest.mark.parametrize("name", quick_ones(("everything",), ARMS))
def test_the_compiled_torque_is_pinocchios(name: str, precision: Precision) -> None:
    """Without a warning of the compiler, under another prefix."""
    arm = ARMS[name]()
    code = c_source(control_tables(arm), "left_arm", ["a remark"], precision)
    check = checked(code, "left_arm", arm, precision)
    assert not isinstance(check, str)
    assert check.difference <= AGREES[precision]
    assert 0.0 < check.seconds < 1e-3


def test_thresholds_are_tables_that_a_program_reads(tmp_path: Path) -> None:
    arm = an_arm(urdf_text())
    torque = tuple(np.arange(1.0, 7.0).tolist())
    low = tuple(np.arange(0.5, 6.0).tolist())
    high = tuple(np.arange(2.0, 8.0).tolist())
    levels = [
        ContactThreshold(period, False, torque, low, high, force, 5.0)
        for period, force in ((12.5, 50.0), (60.0, np.inf))
    ]
    code = c_source(control_tables(arm), "arm", [], "double", levels)
    assert COMPILER is not None
    built = CompiledArm.of(code, "arm", tmp_path, COMPILER, "double")
    periods = (ctypes.c_double * 2).in_dll(built.library, "arm_threshold_period")
    rows = (ctypes.c_double * 12).in_dll(built.library, "arm_threshold")
    forces = (ctypes.c_double * 2).in_dll(built.library, "arm_threshold_force")
    masses = (ctypes.c_double * 2).in_dll(built.library, "arm_threshold_mass")
    assert [*forces] == [50.0, np.inf] and [*masses] == [5.0, 5.0]
    assert [*periods] == [12.5, 60.0]
    assert tuple(rows[6:]) == torque
    for end, expected in (("low", low), ("high", high)):
        ends = (ctypes.c_double * 12).in_dll(built.library, f"arm_threshold_{end}")
        assert tuple(ends[6:]) == expected


def test_another_arm_is_refused() -> None:
    arm = an_arm(urdf_text())
    code = c_source(control_tables(replace(arm, standard=1.01 * arm.standard)), "arm", [])
    with pytest.raises(WriteBackError, match="joint_"):
        checked(code, "arm", arm, "double")


def called(arm: CompiledArm, name: str, size: int, *arguments: Any) -> Array:
    """What a function of the code writes into its last argument."""
    out = np.zeros(size)
    arm.function(name)(*arguments, pointer(out))
    return out


def test_gravity_and_mass_matrix(whole: tuple[ExportedArm, CompiledArm]) -> None:
    arm, code = whole
    n = arm.model.n_joints
    states = random_states(arm, 20)
    rest = replace(states, velocity=0.0 * states.velocity, acceleration=0.0 * states.acceleration)
    friction = an_offset(arm)
    expected = reference_torque(arm, rest) - friction
    model = pinocchio_bodies(arm)
    data = model.createData()
    for q, torque in zip(states.position, expected, strict=True):
        np.testing.assert_allclose(called(code, "gravity", n, pointer(q)), torque, rtol=1e-11)
        upper = pin.crba(model, data, q)
        inertia = np.triu(upper) + np.triu(upper, 1).T + arm.rotors
        mass = called(code, "mass_matrix", n * n, pointer(q)).reshape(n, n)
        np.testing.assert_allclose(mass, inertia, atol=1e-11 * np.abs(inertia).max())


def an_offset(arm: ExportedArm) -> Array:
    """Friction at rest: offsets alone."""
    table = arm.model.friction.table(arm.values[arm.model.friction_part])
    return np.array([row.get("fo", 0.0) for row in table[: arm.model.n_joints]])


def test_payload_and_gravity_are_set_at_run_time(tmp_path: Path) -> None:
    arm = an_arm(urdf_text())
    code = compiled(arm, tmp_path)
    load = Payload(7.0, (0.05, -0.1, 0.2), (0.3, 0.02, 0.01, 0.4, -0.03, 0.35))
    down = (1.0, -4.0, 9.0)
    model = replace(arm.model, gravity=np.array(down), payload=load)
    code.function("set_gravity")(pointer(np.array(down)))
    centre, inertia = np.array(load.centre), np.array(load.inertia)
    code.function("set_payload")(ctypes.c_double(load.mass), pointer(centre), pointer(inertia))
    states = random_states(arm, 50)
    torque = code.torque(states.position, states.velocity, states.acceleration)
    expected = reference_torque(replace(arm, model=model), states)
    np.testing.assert_allclose(torque, expected, atol=1e-12 * np.abs(expected).max())


def test_dry_friction_follows_the_motion_as_identified(
    whole: tuple[ExportedArm, CompiledArm],
) -> None:
    """Presliding of joints and coupled motors over reversals between two cycles."""
    arm, code = whole
    n = arm.model.n_joints
    motion = slow_motion(n)
    expected = reference_torque(arm, motion, presliding=True)
    rows = [
        np.ascontiguousarray(x) for x in (motion.position, motion.velocity, motion.acceleration)
    ]
    state = ctypes.create_string_buffer(4096)
    dt = ctypes.c_double(float(np.diff(motion.time)[0]))
    code.function("presliding_start")(state, dt, pointer(rows[0][0]), pointer(rows[1][0]))
    for k, torque in enumerate(expected):
        q, v, a = (pointer(row[k]) for row in rows)
        rigid = called(code, "rigid_torque", n, q, v, a)
        friction = called(code, "friction", n, q, v, a, state)
        np.testing.assert_allclose(rigid + friction, torque, atol=1e-9 * np.abs(expected).max())


def slow_motion(n: int) -> Motion:
    """Sines that reverse several times; one column for each of n joints."""
    times = np.arange(0.0, 2.0, 0.004)
    first = four_sines(times, 0.3)
    columns = np.arange(n) % first.position.shape[1]
    turned = np.where(np.arange(n) // first.position.shape[1] % 2, -1.0, 1.0)
    return Motion(
        times,
        first.position[:, columns] * turned,
        first.velocity[:, columns] * turned,
        first.acceleration[:, columns] * turned,
    )


class TestObserver:
    GAIN = 25.0
    DT = 0.001

    def a_push(self, arm: ExportedArm) -> tuple[Motion, Array, Array]:
        """A motion, the torque of its drives, and a torque from outside in its second half."""
        times = np.arange(0.0, 1.0, self.DT)
        n = arm.model.n_joints
        first = four_sines(times, 0.5)
        columns = np.arange(n) % first.position.shape[1]
        motion = Motion(
            times,
            first.position[:, columns],
            first.velocity[:, columns],
            first.acceleration[:, columns],
        )
        torque = reference_torque(arm, motion, presliding=True)
        outside = np.zeros(torque.shape)
        outside[len(times) // 2 :] = 0.1 * np.abs(torque).max(axis=0)
        return motion, torque - outside, outside

    def seen(self, arm: ExportedArm) -> tuple[Array, Array]:
        motion, torque, outside = self.a_push(arm)
        observer = MomentumObserver(arm, self.GAIN, self.DT)
        rows = zip(motion.position, motion.velocity, torque, strict=True)
        return np.array([observer.step(*row) for row in rows]), outside

    def test_a_step_is_found_within_three_time_constants(self) -> None:
        arm = an_arm(urdf_text(), coupling=Coupling(WRIST))
        seen, outside = self.seen(arm)
        begin = len(seen) // 2
        settled = begin + round(3.0 / self.GAIN / self.DT)
        size = np.abs(outside).max(axis=0)
        assert (np.abs(seen[:begin]).max(axis=0) < 0.02 * size).all()
        # e^-3 of a first-order low-pass is left
        assert (np.abs(seen[settled:] - outside[settled:]).max(axis=0) < 0.07 * size).all()

    def test_nothing_drifts_at_standstill(self) -> None:
        arm = an_arm(urdf_text(), coupling=Coupling(WRIST))
        q = random_states(arm, 1).position[0]
        rest = Motion.at_rest(q[None, :])
        torque = reference_torque(arm, rest)[0]
        observer = MomentumObserver(arm, self.GAIN, self.DT)
        for _ in range(5000):
            seen = observer.step(q, np.zeros(len(q)), torque)
        assert np.abs(seen).max() < 1e-9 * np.abs(torque).max()

    def test_the_compiled_observer_is_this_one(
        self, whole: tuple[ExportedArm, CompiledArm]
    ) -> None:
        arm, code = whole
        motion, torque, _ = self.a_push(arm)
        observer = MomentumObserver(arm, self.GAIN, self.DT)
        state = ctypes.create_string_buffer(8192)
        q, v = (np.ascontiguousarray(x) for x in (motion.position, motion.velocity))
        gain, dt = ctypes.c_double(self.GAIN), ctypes.c_double(self.DT)
        code.function("observer_start")(state, gain, dt, pointer(q[0]), pointer(v[0]))
        observer.step(q[0], v[0], torque[0])
        worst = 0.0
        for k in range(1, 300):
            tau = np.ascontiguousarray(torque[k])
            seen = called(
                code, "observer_step", q.shape[1], state, pointer(q[k]), pointer(v[k]), pointer(tau)
            )
            worst = max(worst, float(np.abs(seen - observer.step(q[k], v[k], tau)).max()))
        assert worst < 1e-6 * np.abs(torque).max()

    def test_wrong_arguments_are_named(self) -> None:
        arm = an_arm(urdf_text())
        with pytest.raises(ModelError, match="positive gain and dt"):
            MomentumObserver(arm, 0.0, 0.001)
        with pytest.raises(ShapeError, match="tau"):
            MomentumObserver(arm, 1.0, 0.001).step(np.zeros(6), np.zeros(6), np.zeros(5))


def test_the_loop_of_the_page_compiles(tmp_path: Path) -> None:
    page = (Path(__file__).parents[3] / "docs" / "simulators.md").read_text("utf-8")
    (loop,) = re.findall(r"```c\n(.*?)```", page, re.DOTALL)
    level = ContactThreshold(60.0, True, (1.0,) * 6, (1.0,) * 6, (1.0,) * 6, 50.0, 5.0)
    code = c_source(control_tables(an_arm(urdf_text())), "arm", [], "double", [level])
    (tmp_path / "arm.h").write_text(code.header)
    (tmp_path / "loop.c").write_text(loop)
    assert COMPILER is not None
    done = subprocess.run(
        [COMPILER, *STRICT, "-c", "loop.c", "-o", "loop.o"],
        cwd=tmp_path, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr


def test_the_page_names_every_function() -> None:
    page = (Path(__file__).parents[3] / "docs" / "simulators.md").read_text("utf-8")
    header = c_source(control_tables(an_arm(urdf_text())), "arm", []).header
    for name in re.findall(r"^void (arm_\w+)\(", header, re.MULTILINE):
        assert name in page, name


@pytest.mark.slow
def test_on_a_real_arm_without_contact_it_shows_the_residual() -> None:
    """Predicted minus measured torque of an unseen motion, low-passed."""
    data = Path(__file__).parents[4] / "shared" / "data" / "kr300"
    if not data.is_dir():
        pytest.skip(f"there is no recording {data}")
    reading = ImportOptions(columns=data / "map.toml")
    arm = hil.identify(
        data / "A.csv", urdf=data / "robot.urdf", predict=data / "B.csv", reading=reading
    )
    (samples,) = arm.identification.prepared.held_out
    gain, dt = 25.0, float(np.median(np.diff(samples.motion.time)))
    observer = arm.observer(gain, dt)
    model = model_of(arm.identification).arm
    residual = reference_torque(model, samples.motion, presliding=True) - samples.torque
    shown, expected = np.zeros(residual.shape), np.zeros(residual.shape)
    for k, (q, v, _) in enumerate(samples.motion.states()):
        shown[k] = observer.step(q, v, samples.torque[k])
        before = expected[k - 1] if k else 0.0
        expected[k] = (before + gain * dt * residual[k]) / (1.0 + gain * dt)
    settled = round(5.0 / gain / dt)
    error = np.sqrt(np.mean((shown - expected)[settled:] ** 2, axis=0))
    size = np.sqrt(np.mean(samples.torque**2, axis=0))
    assert (error < 0.02 * size).all()


class TestStructuredText:
    """As the tests' own reader of IEC 61131-3 runs it."""

    @pytest.mark.parametrize("name", ARMS)
    def test_the_torque_is_pinocchios(self, name: str) -> None:
        arm = ARMS[name]()
        blocks = blocks_of(structured_text(control_tables(arm), "left", ["a remark *) and on"]))
        torque = Block("LEFT_TORQUE", blocks)
        states = random_states(arm, 10)
        expected = reference_torque(arm, states)
        for (q, v, a), row in zip(states.states(), expected, strict=True):
            torque(q=q, v=v, a=a)
            np.testing.assert_allclose(torque.tau.values, row, atol=1e-12 * np.abs(expected).max())

    def test_every_block_agrees_with_the_compiled_code(
        self, whole: tuple[ExportedArm, CompiledArm]
    ) -> None:
        arm, code = whole
        n = arm.model.n_joints
        blocks = blocks_of(structured_text(control_tables(arm), "arm", []))
        gravity, mass = Block("ARM_GRAVITY", blocks), Block("ARM_MASS_MATRIX", blocks)
        q = random_states(arm, 1).position[0]
        gravity(q=q)
        mass(q=q)
        np.testing.assert_allclose(
            gravity.tau.values, called(code, "gravity", n, pointer(q)), rtol=1e-11
        )
        np.testing.assert_allclose(
            mass.mass.values.ravel(), called(code, "mass_matrix", n * n, pointer(q)), atol=1e-9
        )

    @pytest.mark.long
    def test_the_observer_follows_the_motion(self) -> None:
        arm = a_whole_arm()
        motion = slow_motion(arm.model.n_joints).rows(slice(0, 120))
        torque = reference_torque(arm, motion, presliding=True)
        dt = float(np.diff(motion.time)[0])
        observer = MomentumObserver(arm, 25.0, dt)
        block = Block("ARM_OBSERVER", blocks_of(structured_text(control_tables(arm), "arm", [])))
        for k, (q, v, _) in enumerate(motion.states()):
            block(q=q, v=v, tau=torque[k], dt=dt, start=k == 0)
            seen = observer.step(q, v, torque[k])
            np.testing.assert_allclose(block.outside.values, seen, atol=1e-8)

    def test_a_payload_is_an_input(self) -> None:
        arm = an_arm(urdf_text())
        load = Payload(7.0, (0.05, -0.1, 0.2), (0.3, 0.02, 0.01, 0.4, -0.03, 0.35))
        torque = Block("ARM_TORQUE", blocks_of(structured_text(control_tables(arm), "arm", [])))
        states = random_states(arm, 3)
        expected = reference_torque(replace(arm, model=replace(arm.model, payload=load)), states)
        for (q, v, a), row in zip(states.states(), expected, strict=True):
            torque(
                q=q, v=v, a=a, payload_mass=load.mass, payload_centre=load.centre,
                payload_inertia=load.inertia,
            )  # fmt: skip
            np.testing.assert_allclose(torque.tau.values, row, atol=1e-12 * np.abs(expected).max())
