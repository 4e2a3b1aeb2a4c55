"""The board: the same rows for both, its line of JSON, and what counts as a right verdict."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

from benchmarks import board, degradations, plain_fit
from benchmarks.choices import CHOICES, judged_by_others, taken, without
from benchmarks.degradations import DEGRADATIONS, EXPECTED, FITTED_ONLY
from benchmarks.joint_log import JointLog
from benchmarks.plain_fit import Measured
from benchmarks.published import Published, Split, known
from hil.importers.imported_robot import Robot
from identification.selection.folds import Errors
from identification.selection.questions import BANDWIDTH
from identification.selection.scores import SettingsTrial
from identification.selection.settings import Settings
from identification.signals.samples import Preprocessing
from tests.identification.two_link import MODEL

pytestmark = pytest.mark.long

URDF = Path(__file__).resolve().parents[2] / "examples" / "two_joints" / "robot.urdf"
Logs = dict[str, JointLog]
Archives = dict[str, Path]
COULOMB = np.array([4.0, 2.0])
VISCOUS = np.array([2.0, 1.0])
ROTOR = np.array([0.5, 0.2])


def two_joint_log(seed: int, *, noise: float = 1.0, seconds: float = 10.0) -> JointLog:
    """A motion of sines with friction and rotors, at 100 Hz."""
    random = np.random.default_rng(seed)
    time = np.arange(0.0, seconds, 0.01)
    rate = 2.0 * np.pi * random.uniform(0.1, 0.6, (3, 2))
    angle = rate * time[:, None, None] + random.uniform(0.0, 2.0 * np.pi, (3, 2))
    size = 0.4
    q = size * np.sin(angle).sum(axis=1)
    qd = size * (rate * np.cos(angle)).sum(axis=1)
    qdd = -size * (rate**2 * np.sin(angle)).sum(axis=1)
    robot = pin.buildModelFromUrdf(str(URDF))
    data = robot.createData()
    torque = np.array([pin.rnea(robot, data, *row) for row in zip(q, qd, qdd, strict=True)])
    torque += COULOMB * np.sign(qd) + VISCOUS * qd + ROTOR * qdd
    return JointLog(
        robot=Robot.from_urdf(URDF),
        time=time,
        position=q + noise * 1e-5 * random.standard_normal(q.shape),
        velocity=qd,
        torque=torque + noise * 0.3 * random.standard_normal(q.shape),
        rated_payload=5.0,
    )


@pytest.fixture(scope="module")
def logs() -> Logs:
    return {name: two_joint_log(seed) for name, seed in (("one", 1), ("other", 2))}


@pytest.fixture(scope="module")
def archives(logs: Logs, tmp_path_factory: pytest.TempPathFactory) -> Archives:
    folder = tmp_path_factory.mktemp("archives")
    return {name: log.imported(folder / f"{name}.mcap") for name, log in logs.items()}


class TestSplit:
    @pytest.mark.parametrize(("part", "fitted"), [("first", (0, 700)), ("last", (300, 1000))])
    def test_a_part_is_fitted_and_the_rest_predicted(
        self, logs: Logs, part: str, fitted: tuple[int, int]
    ) -> None:
        parts = board.cut(Split(fitted="one", part=part), logs)
        whole = logs["one"].time
        assert np.array_equal(parts.fitted.time, whole[slice(*fitted)])
        assert np.array_equal(
            np.sort(np.concatenate([parts.fitted.time, parts.predicted.time])), whole
        )

    def test_seconds_of_the_fitted_rows_and_one_row_in_two(self, logs: Logs) -> None:
        split = Split(fitted="one", predicted="other", seconds=4.0, every=2)
        parts = board.cut(split, logs)
        assert np.array_equal(parts.fitted.time, logs["one"].time[:400:2])
        assert np.array_equal(parts.predicted.time, logs["other"].time[::2])

    def test_the_split_of_an_archive_is_that_of_its_log(
        self, logs: Logs, archives: Archives, tmp_path: Path
    ) -> None:
        """`Options.split` on the archive, and two files cut beforehand, are near each other.

        Apart from what the filters know beyond the cut: a tenth of so short a log.
        """
        split = Split(fitted="one", part="first")
        parts = board.cut(split, logs)
        by_files = board.identified_parts(parts, tmp_path)
        by_option = board.identified_split(split, archives, parts)
        assert by_files.error == pytest.approx(by_option.error, rel=0.1)


class TestRow:
    @pytest.mark.parametrize(
        "split", [Split(fitted="one", predicted="other"), Split(fitted="one", part="all")], ids=str
    )
    def test_both_are_near_the_noise(self, split: Split, logs: Logs, archives: Archives) -> None:
        row = board.row("arm", split, archives, logs)
        torque = board.cut(split, logs).predicted.torque
        floor = 0.3 * np.sqrt(torque.size) / np.linalg.norm(torque)
        for name in ("hil", "plain"):
            error = row[name]
            joints = row[f"{name}_joints"]
            assert 0.9 * floor < error < 1.5 * floor
            squares = np.square(joints) @ np.square(np.linalg.norm(torque, axis=0))
            assert error == pytest.approx(np.sqrt(squares) / np.linalg.norm(torque))
        assert row["ratio"] == row["hil"] / row["plain"]
        # The URDF has neither friction nor rotors, and its bodies are the true ones.
        assert row["nominal"] > 3.0 * floor
        assert 0.9 * floor < row["nominal + friction"] < 2.0 * floor
        assert 0.9 * floor < row["plain + prior"] < 2.0 * floor
        assert (row["inside"] is None) == split.in_sample
        assert row["inside"] is None or row["inside"] > 0.9

    def test_the_line_of_json(self, logs: Logs, archives: Archives) -> None:
        split = Split(fitted="one", predicted="other")
        rows = [board.row("arm", split, archives, logs)] * 2
        summary = json.loads(json.dumps(board.summary(rows, [])))
        assert summary.keys() == {
            "rows", "worst_ratio", "mean_ratio", "worst_row", "above_plain",
            "above_nominal_friction", "above_nominal_scale",
        }  # fmt: skip
        assert summary["rows"][0].keys() == {
            "data", "split", "hil", "plain", "ratio", "plain + prior", "nominal",
            "nominal + friction", "nominal + scale", "hil_joints", "plain_joints", "seconds",
            "inside", "white_inside",
        }  # fmt: skip
        assert summary["worst_ratio"] == pytest.approx(summary["mean_ratio"])

    def test_the_summary_names_the_rows_that_lost(self) -> None:
        """A ratio of 1.03 is not above it; a row without masses is not above their model."""

        def row(split: str, hil: float, nominal_friction: float | None) -> board.Row:
            ratios = {"plain": 0.1, "ratio": hil / 0.1, "nominal + friction": nominal_friction}
            scaled = None if nominal_friction is None else 0.9 * nominal_friction
            return {"data": "arm", "split": split, "hil": hil, "nominal + scale": scaled, **ratios}

        rows = [row("near", 0.103, 0.2), row("far", 0.104, 0.1), row("bare", 0.05, None)]
        figures = board.summary(rows, [])
        assert figures["above_plain"] == ["arm, far"]
        assert figures["above_nominal_friction"] == ["arm, far"]
        assert figures["mean_ratio"] == pytest.approx((1.03 * 1.04 * 0.5) ** (1 / 3))
        assert "\n".join(board.summary_lines(figures)).splitlines() == [
            "hil / plain: geometric mean 0.812, worst 1.040 (arm, far)",
            "above 1.03 of plain: 1 of 3 rows; arm, far",
            "above nominal + friction: 1 of 3 rows; arm, far",
            "above nominal + scale: 1 of 3 rows; arm, far",
        ]

    def test_a_choice_is_judged_by_the_other_robots(self) -> None:
        """Each robot counts once; a choice that makes others worse would be left out."""
        none = dict.fromkeys(CHOICES, 1.0)
        rows = [
            {"data": name, "without": {**none, "rows": ratio}}
            for name, ratio in (("a", 1.2), ("a", 1.2), ("b", 0.9), ("c", 0.95))
        ]
        judged = judged_by_others(rows)
        assert judged["rows"]["mean"] == pytest.approx((1.2 * 0.9 * 0.95) ** (1 / 3), abs=1e-4)
        assert judged["rows"]["dropped_by"] == ["a"]
        assert judged["rows"]["left_to_others"] == pytest.approx(1.2 ** (1 / 3), abs=1e-4)
        assert judged["bandwidth"]["dropped_by"] == []

    def test_a_choice_that_is_left_out_keeps_its_first_candidate(self) -> None:
        trial = SettingsTrial(MODEL, lambda *_: [])
        candidates = [Settings(Preprocessing(rigid_bandwidth=width)) for width in (14.0, 7.0)]
        with without("bandwidth"):
            decision = trial.decide(BANDWIDTH, candidates)
        assert decision.settings is candidates[0]
        assert decision.choice.chosen == 0

    @pytest.mark.parametrize(("better", "made"), [(7.0, {"bandwidth"}), (14.0, set())])
    def test_choices_of_a_first_candidate_are_not_left_out(
        self, better: float, made: set[str], monkeypatch: pytest.MonkeyPatch
    ) -> None:
        def errors(_: SettingsTrial, settings: Settings, __: str = "all") -> Errors:
            size = 0.1 if settings.preprocessing.rigid_bandwidth == better else 0.2
            return Errors(np.full((5, 2), size**2), np.ones((5, 2)))

        monkeypatch.setattr(SettingsTrial, "errors", errors)
        candidates = [Settings(Preprocessing(rigid_bandwidth=width)) for width in (14.0, 7.0)]
        with taken() as found:
            SettingsTrial(MODEL, lambda *_: []).decide(BANDWIDTH, candidates)
        assert found == made

    def test_the_fields_of_a_degraded_one(
        self, logs: Logs, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        some = {name: board.DEGRADATIONS[name] for name in ("lost rows", "payload in half")}
        monkeypatch.setattr(board, "DEGRADATIONS", some)
        split = Split(fitted="one", predicted="other")
        lost, loaded = board.degraded_rows("arm", split, logs)
        assert lost.keys() == {
            "data", "case", "hil", "undegraded", "ratio", "named", "words", "expected", "right",
            "left_open",
        }  # fmt: skip
        assert lost["ratio"] < 1.05 < loaded["ratio"]
        assert lost["right"]
        assert board.summary([], [])["rows"] == []

    @pytest.mark.parametrize(
        ("case", "ratio", "named", "right"),
        [
            ("delayed torque", 2.0, ["delay", "error on unseen motion"], True),
            ("delayed torque", 2.0, ["delay", "direction of axes"], False),
            ("delayed torque", 1.0, [], False),
            ("12 bits", 1.02, [], True),
            ("12 bits", 1.5, [], False),
            ("12 bits", 1.02, ["position jumps"], False),
        ],
    )
    def test_the_cause_is_named_and_no_other(
        self, case: str, ratio: float, named: list[str], right: bool
    ) -> None:
        assert board.is_right(case, ratio, named) == right

    def test_an_error_that_is_left_open_shows_no_harm(self) -> None:
        assert board.is_right("12 bits", 1.5, [], left_open=True)
        assert not board.is_right("12 bits", 1.5, ["position jumps"], left_open=True)
        assert not board.is_right("delayed torque", 1.5, [], left_open=True)


class TestConfiguration:
    @pytest.mark.parametrize("name", known())
    def test_its_splits_are_of_its_logs(self, name: str) -> None:
        published = Published.named(name)
        for split in published.splits:
            assert {split.fitted, split.predicted or split.fitted} <= published.logs.keys()
        assert any(not split.in_sample for split in published.splits)

    def test_perturbed_splits_are_of_logs_that_belong_together(self) -> None:
        """Pairs that splits join, by a third log as well; halves; shorter and thinner ones."""
        published = Published.named("psm")
        splits = published.perturbed_splits({"f1": 25.0, "f2": 15.0, "f3": 8.0})
        assert [str(split) for split in splits] == [
            "f2 to f1", "f2 to f3", "f3 to f1", "f3 to f2",
            "f1: first 50 % to last 50 %", "f1: last 50 % to first 50 %",
            "f2: first 50 % to last 50 %", "f2: last 50 % to first 50 %",
            "f1 to f2, 10 s", "f1 to f2, 20 s", "f1 to f2, 1 row in 2",
        ]  # fmt: skip
        assert not set(splits) & set(published.splits)

    def test_sensors_and_currents_of_one_motion_are_no_pair(self) -> None:
        published = Published.named("gen3")
        names = {
            str(split) for split in published.perturbed_splits(dict.fromkeys(published.logs, 4.0))
        }
        assert names == {
            "b_sensor to a_sensor", "b_current to a_current", "a_sensor to b_sensor, 1 row in 2",
        }  # fmt: skip


class TestDegradations:
    """Each copy of a log has the one fault that it is named after."""

    CLEAN = two_joint_log(1, noise=0.0)

    def test_every_fault_has_an_expected_cause(self) -> None:
        assert DEGRADATIONS.keys() == EXPECTED.keys() >= FITTED_ONLY

    def test_torques(self, logs: Logs) -> None:
        torque = logs["one"].torque
        three = replace(logs["one"], torque=np.column_stack([torque, torque[:, 0]]))
        exchanged = degradations.exchanged_joints(three).torque
        assert np.array_equal(exchanged, three.torque[:, [0, 2, 1]])
        assert np.array_equal(degradations.turned_sign(three).torque, three.torque * [1, 1, -1])
        assert degradations.delayed_torque(three).torque[1:] == pytest.approx(three.torque[:-1])

    def test_the_payload_is_there_in_the_second_half_only(self) -> None:
        """Its weight, at rest and with the arm stretched out level, on the elbow."""
        zeros = np.zeros_like(self.CLEAN.position)
        still = replace(self.CLEAN, position=zeros, velocity=zeros)
        added = degradations.payload_in_second_half(still).torque - still.torque
        assert not added[:500].any()
        # 0.5 kg straight above the elbow, which is 0.45 m of level way from the shoulder.
        assert added[500:, 1] == pytest.approx(0.0, abs=1e-9)
        assert np.abs(added[500:, 0]) == pytest.approx(0.5 * 9.81 * 0.45)


ROBOT = plain_fit.robot_from_urdf(URDF.read_text())


def planted() -> np.ndarray:
    """Parameters of the two links, their rotors and their friction."""
    links = [ROBOT.inertias[joint].toDynamicParameters() for joint in (1, 2)]
    return np.concatenate([*links, ROTOR, COULOMB, VISCOUS, np.zeros(2)])


def of_the_regressor(cutoff: float, seed: int) -> Measured:
    """A log whose torque is that of the planted parameters after a filter of this cut-off."""
    measured = two_joint_log(seed, noise=0.0).measured._replace(velocity=None)
    rough = 1e-4 * np.random.default_rng(2).standard_normal(measured.position.shape)
    measured = measured._replace(position=measured.position + rough)
    torque = plain_fit.regressor(ROBOT, measured, cutoff) @ planted()
    return measured._replace(torque=torque)


class TestPlainFit:
    @pytest.mark.parametrize("cutoff", [5.0, 12.0])
    def test_noise_free_data_are_predicted_exactly(self, cutoff: float) -> None:
        """A torque that the model can make is predicted to rounding, by the cut-off it has."""
        fitted_rows, other = (of_the_regressor(cutoff, seed) for seed in (1, 2))
        fitted = plain_fit.fit(ROBOT, fitted_rows)
        assert fitted.cutoff == cutoff
        for measured in (fitted_rows, other):
            predicted = fitted.predicted_torque(measured)
            assert plain_fit.relative_error(measured.torque, predicted) < 1e-8

    def test_friction_of_a_nominal_model_is_found_exactly(self) -> None:
        fitted = plain_fit.fit_friction(ROBOT, of_the_regressor(5.0, 1))
        assert fitted.parameters == pytest.approx(planted(), abs=1e-8)

    def test_scales_of_a_nominal_model_are_found_exactly(self) -> None:
        """The torque of the bodies times the scale of each joint; drives are not scaled."""
        measured = of_the_regressor(5.0, 1)
        table = plain_fit.regressor(ROBOT, measured, 5.0)
        scale = np.array([1.2, 0.8])
        bodies = table[..., :20] @ planted()[:20]
        drives = table[..., 20:] @ planted()[20:]
        fitted = plain_fit.fit_friction_and_scale(
            ROBOT, measured._replace(torque=scale * bodies + drives)
        )
        assert fitted.parameters[-2:] == pytest.approx(scale, abs=1e-8)
        assert fitted.parameters[20:-2] == pytest.approx(planted()[20:], abs=1e-8)

    def test_a_prior_hardly_moves_what_a_motion_determines(self) -> None:
        """Prediction moves by less than the noise of the fitted torque, and less if rows count."""
        fitted_part, other = (of_the_regressor(12.0, seed) for seed in (1, 2))
        noise = 0.3 * np.random.default_rng(3).standard_normal(fitted_part.torque.shape)
        fitted_part = fitted_part._replace(torque=fitted_part.torque + noise)
        free = plain_fit.fit(ROBOT, fitted_part)
        assert free.cutoff == 12.0
        moved = []
        for share in (0.1, 1.0):
            held = plain_fit.fit_with_prior(ROBOT, fitted_part, 12.0, share)
            difference = held.predicted_torque(other) - free.predicted_torque(other)
            moved.append(np.sqrt(np.mean(difference**2)))
        assert moved[1] < 0.5 * moved[0] < moved[0] < 0.3

    def test_a_prior_keeps_what_a_motion_does_not_determine(self) -> None:
        """The second joint stands: its rotor and its viscous friction stay at their mean, zero."""
        measured = of_the_regressor(plain_fit.PRIOR_CUTOFF, 1)
        position = measured.position * [1.0, 0.0]
        fit = plain_fit.fit_with_prior(ROBOT, measured._replace(position=position))
        rotor, viscous = fit.parameters[[21, 25]]
        assert abs(rotor) < 1e-6
        assert abs(viscous) < 1e-6

    def test_the_prior_of_a_body(self) -> None:
        """Shares of the mass, times the way to the next joint and its square."""
        prior = plain_fit.body_prior(ROBOT, two_joint_log(1).measured)
        mass = ROBOT.inertias[1].mass
        length = np.linalg.norm(ROBOT.jointPlacements[2].translation)
        assert prior.mean[:20] == pytest.approx(planted()[:20])
        assert prior.deviation[:10] == pytest.approx(
            0.3 * mass * length ** np.array([0, 1, 1, 1, 2, 2, 2, 2, 2, 2])
        )

    def test_placeholders_are_no_masses(self) -> None:
        """All bodies of one kilogram, one of them fixed to another; or none at all."""
        bodies = re.compile(r'<mass value="[^"]*"')
        for mass in ("1.0", "0.0"):
            urdf = bodies.sub(f'<mass value="{mass}"', URDF.read_text())
            robot = plain_fit.robot_from_urdf(urdf)
            assert not plain_fit.has_masses(robot)
            prior = plain_fit.body_prior(robot, two_joint_log(1).measured)
            assert not prior.mean.any()
            assert prior.deviation[0] == plain_fit.UNKNOWN_MASS
            with pytest.raises(ValueError, match="placeholders"):
                plain_fit.fit_friction(robot, two_joint_log(1).measured)
        assert plain_fit.has_masses(ROBOT)

    def test_gravity_and_locked_joints_are_those_that_are_named(self) -> None:
        locked = plain_fit.robot_from_urdf(URDF.read_text(), (0.0, 9.81, 0.0), {"elbow": 0.5})
        assert locked.nv == 1
        whole = pin.buildModelFromUrdf(str(URDF))
        whole.gravity.linear = np.array([0.0, 9.81, 0.0])
        alone = pin.rnea(locked, locked.createData(), np.ones(1), np.zeros(1), np.zeros(1))
        both = pin.rnea(whole, whole.createData(), np.array([1.0, 0.5]), np.zeros(2), np.zeros(2))
        assert alone[0] == pytest.approx(both[0])
