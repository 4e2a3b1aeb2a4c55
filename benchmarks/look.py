"""Twelve meanings planted in real recordings, and what `hil look` says of them.

Run with ``python -m benchmarks.look --data DIR [--arm NAME]``, where DIR has ``ur10_unisa``,
``kr300``, ``lwr4`` and ``gen3``, whose torques are of the joint side. Each recording
is read as it is and with one meaning planted; *right*: the meaning is named, alone or as one of two
readings that fit alike; *wrong*: a row that is called sure says something else of any aspect.
"""

from __future__ import annotations

import re
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import scipy
from numpy.typing import NDArray

from benchmarks import parser_of, show
from benchmarks.arms import urdf as arm_urdf
from benchmarks.plain_fit import causally_low_passed
from hil.archive import open_archive
from hil.base.errors import HilError
from hil.importers.conclusions import Certainty
from hil.importers.imported_robot import Robot
from hil.importers.recording_import import ImportOptions, RobotOf, import_recording
from hil.look import Look, look_at
from hil.look.messages import choice_text, row_text, worded
from hil.look.readings import Fact
from hil.pipeline.sources import cell_of, source_of
from identification.estimators.prior import body_prior, fit_posterior
from identification.factor.factor import Factor
from identification.model.motion import Motion
from identification.model.robot import RobotModel
from identification.signals.recording import Recording
from identification.signals.samples import Preprocessing, prepare

Array = NDArray[np.float64]

_SEED: Final = 20261126
_CUT: Final = 3.0  # Hz
_NEAR: Final = 10.0  # deg
_LATE: Final = 0.03  # s
_AHEAD: Final = 0.025  # s
_EXPECTED: Final = {
    aspect: worded(fact)
    for aspect, fact in {
        "order": Fact.ORDER_OF_URDF,
        "signs": Fact.SIGNS_OF_URDF,
        "angle unit": Fact.UNIT_AS_READ,
        "zero": Fact.ZERO_OF_URDF,
        "coupling": Fact.UNCOUPLED,
        "gravity": Fact.WITH_GRAVITY,
        "mounting": Fact.STATED_MOUNTING,
        "side": Fact.JOINT_SIDE,
    }.items()
}
"""What a certain row says of a recording as it is."""


@dataclass(frozen=True, eq=False)
class Arm:
    """A recording of the joint side, and its robot."""

    name: str
    log: Path
    robot_of: RobotOf
    recording: Recording
    weight: Array  #: torque of gravity by a fit (m, n) [N·m]


@dataclass(frozen=True, eq=False)
class Planted:
    """Arrays of a log with one meaning planted.

    `aspect` is that of the row that must name it, and `words` what the row or a choice contains.
    """

    meaning: str
    aspect: str
    words: tuple[str, ...]
    time: Array
    position: Array
    velocity: Array | None
    torque: Array


def arms(data: Path, folder: Path, only: str | None = None) -> Iterator[Arm]:
    """Yield the arms whose recordings are in a folder."""
    logs: Mapping[str, tuple[Path, Path]] = {
        "ur10": (
            data / "ur10_unisa/ur10_exciting_trajectory.db3",
            arm_urdf("ur_description/urdf/ur10_robot.urdf"),
        ),
        "kr300": (data / "kr300/Abal.csv", data / "kr300/robot.urdf"),
        "lwr4": (data / "lwr4/measurements_1.npz", data / "lwr4/kuka_lwr4.urdf"),
        "gen3": (data / "gen3/a_sensor.csv", data / "gen3/robot.urdf"),
    }
    for name, (log, urdf) in logs.items():
        if not log.exists() or only not in (None, name):
            continue

        def robot_of(_: object, urdf: Path = urdf) -> Robot:
            return Robot.from_urdf(urdf)

        path = folder / f"{name}.mcap"
        import_recording(log, path, robot_of, ImportOptions(outside_limits=True))
        archive = open_archive(path)
        cell = cell_of(archive)
        recording = source_of(archive, cell).recording
        yield Arm(name, log, robot_of, recording, _weight(recording, cell.model))


def _weight(recording: Recording, model: RobotModel) -> Array:
    samples = prepare(recording, model, options=Preprocessing(14.0, exclude_rows="rests"))
    factor = Factor.by_time(model, samples)
    values = fit_posterior(model, factor, body_prior(model, factor).gaussian).estimate.values
    rigid = np.where(model.friction_columns, 0.0, values)
    return np.asarray(model.torque(rigid, Motion.at_rest(recording.position)))


def plants(arm: Arm) -> Iterator[Planted]:
    """Yield the recording as it is and with each meaning."""
    recording = arm.recording
    rng = np.random.default_rng(_SEED)
    names = recording.joint_names
    n = recording.n_joints
    t = recording.time
    q = recording.position
    v = recording.velocity
    tau = recording.torque
    assert tau is not None

    def of(meaning: str, aspect: str, *expected: str, **arrays: Array | None) -> Planted:
        usual: dict[str, Array | None] = {"time": t, "position": q, "velocity": v, "torque": tau}
        return Planted(meaning, aspect, expected, **{**usual, **arrays})  # type: ignore[arg-type]

    yield of("as it is", "gravity", "with gravity")
    yield of("gravity removed", "gravity", "without gravity", torque=tau - arm.weight)
    yield of("motor side", "side", "motor", torque=tau / rng.uniform(50.0, 160.0, n))
    yield of("current", "side", "current", torque=tau / rng.uniform(8.0, 60.0, n))
    yield of("negated", "signs", "torque negated: all", torque=-tau)
    yield from _signs(of, names, q, v, tau)
    order = rng.permutation(n)
    while np.any(order == np.arange(n)):
        order = rng.permutation(n)
    listing = ", ".join(names[k] for k in order)
    yield of(
        "torques permuted", "order", f"torque columns belong to {listing}", torque=tau[:, order]
    )
    yield of(
        "joints permuted", "order", listing,
        position=q[:, order], velocity=None if v is None else v[:, order], torque=tau[:, order],
    )  # fmt: skip
    degrees = None if v is None else np.degrees(v)
    yield of("degrees", "position, angle unit", "deg", position=np.degrees(q), velocity=degrees)
    yield of("low-passed", "low-pass", "low-passed at", torque=causally_low_passed(t, tau, _CUT))
    yield of("delayed", "delay", "lags", torque=_shifted(t, tau, -_LATE))
    smooth = _shifted(t, _without_lag(t, q), _AHEAD)
    yield of("commanded", "positions", "commanded", position=smooth)
    yield of("wrapped", "wraps", "wrapped", position=_wrapped(q))
    third = 2 if n == 6 else 3  # the next parallel axis
    relative = np.eye(n)
    relative[third, 1] = 1.0
    yield of(
        "coupled", "coupling", f"recorded {names[third]} is {names[third]} plus {names[1]}",
        position=q @ relative.T, velocity=None if v is None else v @ relative.T,
    )  # fmt: skip
    for joint, angle in ((1, 0.6), (2, -0.6), (3, np.pi / 2.0)):
        zero = np.zeros(n)
        zero[joint] = angle
        yield of(
            f"zero of joint {joint + 1}", "zero", f"{np.degrees(-angle):.0f} deg: {names[joint]}",
            position=q + zero,
        )  # fmt: skip


def _wrapped(q: Array) -> Array:
    """Return angles of which each jumps by a turn at the middle of its range."""
    middle = 0.5 * (q.max(axis=0) + q.min(axis=0))
    return np.asarray(np.mod(q - middle, 2.0 * np.pi) + middle)


def _signs(
    of: Callable[..., Planted], names: tuple[str, ...], q: Array, v: Array | None, tau: Array
) -> Iterator[Planted]:
    for joint in (1, len(names) - 2):
        sign = np.ones(len(names))
        sign[joint] = -1.0
        expected = f"torque negated: {names[joint]}"
        yield of(f"torque {joint + 1} negated", "signs", expected, torque=tau * sign)
        yield of(
            f"position {joint + 1} negated", "signs", f"position negated: {names[joint]}",
            position=q * sign, velocity=None if v is None else v * sign,
        )  # fmt: skip


def _without_lag(t: Array, values: Array) -> Array:
    """Return values through a low-pass forth and back."""
    rate = 1.0 / float(np.median(np.diff(t)))
    sections = scipy.signal.butter(2, 2.0 * _CUT, fs=rate, output="sos")
    return np.asarray(scipy.signal.sosfiltfilt(sections, values, axis=0))


def _shifted(t: Array, values: Array, ahead: float) -> Array:
    return np.column_stack([np.interp(t + ahead, t, column) for column in values.T])


def judged(arm: Arm, planted: Planted, folder: Path) -> dict[str, object]:
    """Return what is said of a planted log."""
    path = folder / "planted.npz"
    arrays = {"t": planted.time, "q": planted.position, "tau": planted.torque}
    if planted.velocity is not None:
        arrays["v"] = planted.velocity
    np.savez(path, **arrays)  # type: ignore[arg-type]
    begin = time.process_time()
    row: dict[str, object] = {"arm": arm.name, "planted": planted.meaning}
    try:
        look = look_at(path, arm.robot_of, ImportOptions())
    except HilError as error:
        return {**row, "right": False, "wrong": "", "said": f"refused: {error}"}
    said = _said(look, planted.aspect)
    right = all(any(_says(text, word) for text in said) for word in planted.words)
    return {
        **row,
        "right": right,
        "wrong": _wrong(look, planted),
        "seconds": round(time.process_time() - begin, 1),
        "said": " | ".join(said),
    }


def _says(text: str, phrase: str) -> bool:
    """Return whether a text contains words; the angle of a zero to `_NEAR`.

    That the torque does not show the zero of the joint is right as well.
    """
    angle, _, joint = phrase.partition(" deg: ")
    if not joint:
        return phrase in text
    if joint in text.partition("unseen in ")[2].split(" (")[0].split(", "):
        return True
    said = [
        float(size) for size, name in re.findall(r"(-?\d+) deg: ([\w.-]+)", text) if name == joint
    ]
    return any(abs((size - float(angle) + 180.0) % 360.0 - 180.0) <= _NEAR for size in said)


def _said(look: Look, aspect: str) -> list[str]:
    """Return what a look says of an aspect, all readings of a doubt included."""
    rows = [
        f"{row_text(row).reading} ({row.certainty})"
        for row in look.rows
        if row.aspect in aspect.split(", ")
    ]
    return rows + [
        choice_text(choice)
        for choices in look.questions
        for choice in choices
        if choice.aspect == aspect
    ]


def _wrong(look: Look, planted: Planted) -> str:
    """Return the aspects of which a sure row says something else than what is there."""
    wrong = []
    for row in look.rows:
        if row.certainty is not Certainty.CERTAIN or row.aspect not in _EXPECTED:
            continue
        right = [_EXPECTED[row.aspect]]
        if row.aspect in planted.aspect and planted.meaning != "as it is":
            right = [*planted.words, *(right if row.aspect == "angle unit" else ())]
        if not any(_says(row_text(row).reading, word) for word in right):
            wrong.append(row.aspect)
    return ", ".join(wrong)


def measure(data: Path, only: str | None = None, meaning: str = "") -> Iterator[dict[str, object]]:
    """Yield a row for each arm and meaning."""
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        for arm in arms(data, place, only):
            for planted in plants(arm):
                if meaning in planted.meaning:
                    yield judged(arm, planted, place)


def main() -> None:
    """Print the table and its shares."""
    parser = parser_of(__doc__)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--arm", help="one of ur10, kr300, lwr4, gen3")
    parser.add_argument("--meaning", default="", help="part of the name of a meaning")
    options = parser.parse_args()
    rows = []
    for row in measure(options.data, options.arm, options.meaning):
        rows.append(row)
        if not options.json:
            print(
                f"{row['arm']:6} {row['planted']:20} {'right' if row['right'] else 'NOT':5} "
                f"{row['wrong'] or '-':12} {row.get('seconds', 0)!s:>5} s  {row['said']}",
                flush=True,
            )
    count = max(1, len(rows))
    result = {
        "right": sum(bool(row["right"]) for row in rows) / count,
        "wrong": sum(bool(row["wrong"]) for row in rows) / count,
    }
    show({"readings": len(rows), **result}, only_json=options.json)


if __name__ == "__main__":
    main()
