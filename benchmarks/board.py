"""Identification with default settings and an ordinary fit, on real and on degraded recordings.

Run with ``python -m benchmarks.board [--data FOLDER] [--only NAME] [--splits WHICH]
[--degraded] [--choices] [--averaging] [--json] [--page FILE]``, where FOLDER holds the folders of
recordings that `benchmarks/recordings` describes. ``--fetch [FROM ...]`` collects these in FOLDER
instead (`benchmarks.fetch`); ``--page docs/board.md`` writes the page (`benchmarks.board_page`),
with ``--rows FILE`` from a saved line of JSON instead of measuring. With ``--splits short`` the
first and the last 40 % of each log are fitted and its rest is predicted; with ``--splits
perturbed`` other pairs of motions, halves of logs, their first 10, 20 and 30 s, and one row in two,
which show what becomes of other recordings of these robots.

Errors are ||tau - tau_hat|| / ||tau|| over all joints and every row of what is predicted, of the
torque as it was recorded. *hil* imports a recording and identifies from the archive as `hil
identify` does with default settings; `plain` is `benchmarks.plain_fit` on the same rows, *plain +
prior* the same with a Gaussian prior about the URDF's bodies, *nominal* the URDF's model as it is,
*nominal + friction* that with rotor inertia, friction and offset fitted, and *nominal + scale* that
with the scale of each joint's torque as well; these three are missing where the URDF has no masses.
A ratio below 1 is better than `plain`. *Inside* is the share of hil's held-out means of torque
inside their 95 % intervals. A summary follows the rows: the geometric mean of the ratios, the
worst, and which rows are above 1.03 of `plain` or above a nominal model.

With ``--choices``, each row is repeated without each automatic choice in turn
(`benchmarks.choices`): the error over that with all of them, and in the summary whether the other
robots would keep the choice. With ``--averaging``, each row has what averaged answers would be
worth (`benchmarks.averaging`), and the summary whether the other robots would average.

With ``--degraded``, the first held-out split of each robot and of the simulated cell is repeated
with copies of the logs, each with one fault (`benchmarks.degradations`): the error, that of the
copy without a fault, and the causes that the verdict names only with the fault. A verdict is
*right* if it names the fault, or nothing if the fault is harmless, and no other cause. Where the
verdicts with and without a fault say that models of the same fit predict the held-out motion apart,
its error does not show harm.
"""

from __future__ import annotations

import json
import tempfile
import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, Literal, NamedTuple, get_args

import numpy as np

from benchmarks import parser_of, plain_fit, show
from benchmarks.averaging import ratios_of, watched
from benchmarks.board_page import commit, write_page
from benchmarks.choices import CHOICES, judged_by_others, taken, without
from benchmarks.degradations import CAUSES, DEGRADATIONS, EXPECTED, FITTED_ONLY, HARMLESS
from benchmarks.fetch import FETCHED, fetch, show_fetched
from benchmarks.identification_study import recorded, study
from benchmarks.joint_log import JointLog
from benchmarks.published import FITTED_SHARE, Published, Split, known
from hil.base.errors import HilError
from hil.base.progress import Silent
from hil.importers.imported_robot import Robot
from hil.pipeline.identification import identify_archives
from hil.pipeline.options import Options
from hil.results.results import Results
from identification.errors import IdentificationError
from identification.validation.finding_messages import LEFT_OPEN, WordedFinding

DATA: Final = Path(__file__).resolve().parents[2] / "shared" / "data"
SIMULATED: Final = "simulated"
ABOVE_PLAIN: Final = 1.03  # ratio from which a row counts as worse than the ordinary fit
RIVALS: Final[Mapping[str, Callable[[Any, plain_fit.Measured], plain_fit.PlainFit]]] = {
    "plain": plain_fit.fit,
    "plain + prior": plain_fit.fit_with_prior,
    "nominal": lambda robot, _: plain_fit.nominal(robot),
    "nominal + friction": plain_fit.fit_friction,
    "nominal + scale": plain_fit.fit_friction_and_scale,
}
"""Columns of the board beside hil's."""
NEED_MASSES: Final = ("nominal", "nominal + friction", "nominal + scale")
_SHOWN: Final = 5e-4  # change of an error by a choice that is printed
_RATED_PAYLOAD: Final = 16.0  # kg, of the NS 16
_VALIDATION_SEED: Final = 1_000_000  # noise of its own


Which = Literal["configured", "short", "perturbed"]
"""Of the splits of each robot."""
Row = dict[str, Any]
"""Of the line of JSON: `data` and `split` or `case`, and what was found."""


class Parts(NamedTuple):
    """The rows that are fitted, and those that are predicted."""

    fitted: JointLog
    predicted: JointLog


class Identified(NamedTuple):
    """Error over all joints and every row, and by joint; and all results."""

    error: float
    joints: list[float]
    results: Results


def cut(split: Split, logs: Mapping[str, JointLog]) -> Parts:
    """The parts of a split, of logs by name."""
    parts = _parts(split, logs)
    fitted, predicted = (part.rows(slice(None, None, split.every)) for part in parts)
    if split.seconds is not None:
        fitted = fitted.rows(fitted.time < fitted.time[0] + split.seconds)
    return Parts(fitted, predicted)


def _parts(split: Split, logs: Mapping[str, JointLog]) -> Parts:
    whole = logs[split.fitted]
    if split.predicted is not None:
        return Parts(whole, logs[split.predicted])
    share = round(split.share * whole.n_rows)
    if split.part == "first":
        return Parts(whole.rows(slice(0, share)), whole.rows(slice(share, None)))
    if split.part == "last":
        begin = whole.n_rows - share
        return Parts(whole.rows(slice(begin, None)), whole.rows(slice(0, begin)))
    return Parts(whole, whole)


def identified(
    fitted: Path, predicted: Sequence[Path] = (), *, in_sample: bool = False
) -> Identified:
    """Identify from an archive as `hil identify` does, by default settings."""
    options = Options(split=FITTED_SHARE, in_sample=in_sample)
    results = identify_archives([fitted], Silent(), options, predict=predicted).results
    prediction = results.fitted if in_sample else results.validation[0]
    assert prediction is not None
    return Identified(prediction.all_rows_relative_error, prediction.all_rows_joint_errors, results)


def identified_split(split: Split, archives: Mapping[str, Path], parts: Parts) -> Identified:
    """Identify what a split asks for, from whole archives where the options can say it."""
    fitted = archives[split.fitted]
    if split.seconds is not None or split.every != 1:
        return identified_parts(parts, fitted.parent)
    if split.predicted is not None:
        return identified(fitted, [archives[split.predicted]])
    if split.part == "last" or split.share != FITTED_SHARE:
        return identified_parts(parts, fitted.parent)
    return identified(fitted, in_sample=split.in_sample)


def identified_parts(parts: Parts, folder: Path) -> Identified:
    """Import both parts from files of their own, and identify one to predict the other."""
    with tempfile.TemporaryDirectory(dir=folder) as scratch:
        fitted = parts.fitted.imported(Path(scratch) / "fitted.mcap")
        predicted = parts.predicted.imported(Path(scratch) / "predicted.mcap")
        return identified(fitted, [predicted])


def rival_errors(name: str, parts: Parts) -> tuple[float, list[float]] | None:
    """Errors of a rival over all joints, and by joint; None if it needs masses that are unknown."""
    robot = parts.fitted.pinocchio_model()
    if name in NEED_MASSES and not plain_fit.has_masses(robot):
        return None
    fitted = RIVALS[name](robot, parts.fitted.measured)
    torque = parts.predicted.torque
    predicted = fitted.predicted_torque(parts.predicted.measured)
    joints = [
        plain_fit.relative_error(torque[:, joint], predicted[:, joint])
        for joint in range(torque.shape[1])
    ]
    return plain_fit.relative_error(torque, predicted), joints


def fit_errors(parts: Parts) -> tuple[float, list[float]]:
    """Errors of the ordinary fit over all joints, and by joint."""
    errors = rival_errors("plain", parts)
    assert errors is not None
    return errors


def row(
    name: str,
    split: Split,
    archives: Mapping[str, Path],
    logs: Mapping[str, JointLog],
    *,
    choices: bool = False,
    averaging: bool = False,
) -> Row:
    """All errors on one split of logs, which the archives hold, and the seconds that two took.

    With `choices`, `without` has the error without each choice over that with all; with
    `averaging`, `averaged` has the error with averaged answers over that as it is.

    `inside` is None in sample; `white_inside`: of the intervals that white residuals would have.
    Seconds are of the processor.
    """
    parts = cut(split, logs)
    start = time.process_time()
    with taken() as made, watched() as seen:
        ours = identified_split(split, archives, parts)
    middle = time.process_time()
    fit, fit_joints = fit_errors(parts)
    seconds = {"hil": middle - start, "plain": time.process_time() - middle}
    others = {rival: rival_errors(rival, parts) for rival in RIVALS if rival != "plain"}
    calibration = ours.results.calibration
    left_out = {}
    for choice in CHOICES if choices else ():
        left_out[choice] = 1.0
        if choice in made:
            with without(choice):
                left_out[choice] = identified_split(split, archives, parts).error / ours.error
    return {
        "data": name,
        "split": str(split),
        "hil": ours.error,
        "plain": fit,
        "ratio": ours.error / fit,
        **{rival: None if errors is None else errors[0] for rival, errors in others.items()},
        "hil_joints": ours.joints,
        "plain_joints": fit_joints,
        "seconds": seconds,
        "inside": None if calibration is None else calibration.inside,
        "white_inside": None if calibration is None else calibration.white_inside,
        **({"without": left_out} if choices else {}),
        **({"averaged": seen.ratios()} if averaging else {}),
    }


def rows_of(
    name: str,
    data: Path,
    which: Which = "configured",
    *,
    choices: bool = False,
    averaging: bool = False,
) -> Iterator[Row]:
    """Every split of a configuration, or every other one, in the folder of all recordings."""
    published = Published.named(name)
    with tempfile.TemporaryDirectory() as scratch:
        archives = import_all(published, data / (published.folder or name), Path(scratch))
        logs = {log: JointLog.read(path, published.rated_payload) for log, path in archives.items()}
        splits = published.short_splits if which == "short" else published.splits
        if which == "perturbed":
            seconds = {log: float(np.ptp(values.time)) for log, values in logs.items()}
            splits = published.perturbed_splits(seconds)
        for split in splits:
            yield row(name, split, archives, logs, choices=choices, averaging=averaging)


def import_all(published: Published, data: Path, folder: Path) -> dict[str, Path]:
    """Archives of all logs of a robot, by their names.

    Raises:
        SystemExit: the folder of its recordings is not there.
    """
    if not data.is_dir():
        raise SystemExit(f"there are no recordings in {data}: name the folder of all with --data")
    return {log: published.imported(log, data, folder / f"{log}.mcap") for log in published.logs}


def degraded_rows(name: str, split: Split, logs: Mapping[str, JointLog]) -> Iterator[Row]:
    """One split with each fault in turn."""
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        whole = identified_parts(cut(split, logs), folder)
        for case, degrade in DEGRADATIONS.items():
            if case in FITTED_ONLY:
                parts = cut(split, logs)
                parts = parts._replace(fitted=degrade(parts.fitted))
            else:
                parts = cut(split, {log: degrade(values) for log, values in logs.items()})
            outcome: Identified | str
            try:
                outcome = identified_parts(parts, folder)
            except (HilError, IdentificationError) as error:
                outcome = f"refused: {error}"
            yield degraded_row(name, case, whole, outcome)


def degraded_row(name: str, case: str, whole: Identified, outcome: Identified | str) -> Row:
    """What became of a fault, beside the identification without it; words where it was refused.

    `named` are checks that the verdict calls wrong or suspicious; of those that it calls so without
    the fault as well only what is `expected`.
    """
    expected = EXPECTED[case].checks
    error = None
    ratio = None
    named = list[str]()
    left_open = False
    if isinstance(outcome, str):
        sentences = [outcome]
    else:
        before = {finding.check for finding in suspicious(whole.results)} - expected
        findings = [
            finding for finding in suspicious(outcome.results) if finding.check not in before
        ]
        error = outcome.error
        ratio = outcome.error / whole.error
        named = list(dict.fromkeys(finding.check for finding in findings))
        sentences = [f"{finding.check}: {finding.words}" for finding in findings]
        left_open = leaves_open(whole.results) and leaves_open(outcome.results)
    return {
        "data": name,
        "case": case,
        "hil": error,
        "undegraded": whole.error,
        "ratio": ratio,
        "named": named,
        "words": sentences,
        "expected": sorted(expected),
        "left_open": left_open,
        "right": ratio is not None and is_right(case, ratio, named, left_open=left_open),
    }


def suspicious(results: Results) -> list[WordedFinding]:
    """Findings that are neither good nor mere information."""
    return [
        finding
        for finding in results.judgement.findings
        if finding.level not in ("good", "information")
    ]


def leaves_open(results: Results) -> bool:
    """Whether a verdict says that models of the same fit predict the held-out motion apart."""
    return any(finding.check == LEFT_OPEN for finding in suspicious(results))


def is_right(case: str, ratio: float, named: Collection[str], *, left_open: bool = False) -> bool:
    """Whether a verdict explains a fault, by the ratio of errors with and without it.

    The ratio does not show harm where both verdicts say that it is `left_open`.
    """
    expected = EXPECTED[case]
    blamed = CAUSES.intersection(named)
    if blamed - expected.checks:
        return False
    return bool(blamed) or (expected.silence and (ratio <= HARMLESS or left_open))


def split_logs(name: str, data: Path) -> tuple[Split, dict[str, JointLog]]:
    """The first held-out split of a robot, and its logs."""
    if name == SIMULATED:
        return simulated_logs()
    published = Published.named(name)
    split = next(split for split in published.splits if not split.in_sample)
    with tempfile.TemporaryDirectory() as scratch:
        archives = import_all(published, data / (published.folder or name), Path(scratch))
        logs = {log: JointLog.read(path, published.rated_payload) for log, path in archives.items()}
    return split, {log: logs[log] for log in (split.fitted, split.predicted) if log is not None}


def simulated_logs() -> tuple[Split, dict[str, JointLog]]:
    """Excitation and first validation motion of the simulated cell, without unmodelled effects."""
    cell = study()[0]
    parts = {
        "excitation": recorded(0).training[0].recording,
        "validation": recorded(_VALIDATION_SEED, validation=True).held_out[0].recording,
    }
    robot = Robot(cell.text, cell.urdf, cell.joint_names)
    logs = {}
    for name, part in parts.items():
        assert part.torque is not None
        logs[name] = JointLog(robot, part.time, part.position, None, part.torque, _RATED_PAYLOAD)
    return Split(fitted="excitation", predicted="validation"), logs


def summary(rows: Sequence[Row], degraded: Sequence[Row]) -> dict[str, Any]:
    """What the line of JSON holds."""
    figures: dict[str, Any] = {"rows": list(rows)}
    if rows:
        ratios = np.array([row["ratio"] for row in rows])
        mean = float(np.exp(np.log(ratios).mean()))
        figures |= {"worst_ratio": float(ratios.max()), "mean_ratio": mean}
        figures["worst_row"] = row_name(rows[int(ratios.argmax())])
        figures["above_plain"] = [row_name(row) for row in rows if row["ratio"] > ABOVE_PLAIN]
        for rival in ("nominal + friction", "nominal + scale"):
            figures[f"above_{rival.replace(' + ', '_')}"] = [
                row_name(row) for row in rows if row[rival] is not None and row["hil"] > row[rival]
            ]
        if "without" in rows[0]:
            figures["choices"] = judged_by_others(rows)
        if "averaged" in rows[0]:
            figures["averaging"] = judged_by_others(rows, "averaged")
            figures["averaged_ratios"] = ratios_of(rows, averaged=True)._asdict()
    if degraded:
        figures |= {"degraded": list(degraded), "right": sum(row["right"] for row in degraded)}
    return figures


def row_name(row: Row) -> str:
    """Robot and split of a row."""
    return f"{row['data']}, {row['split']}"


def summary_lines(figures: Mapping[str, Any]) -> Iterator[str]:
    """Lines to print below the rows, of what `summary` found."""
    if figures["rows"]:
        yield (
            f"hil / plain: geometric mean {figures['mean_ratio']:.3f}, worst"
            f" {figures['worst_ratio']:.3f} ({figures['worst_row']})"
        )
        for title, key in (
            (f"above {ABOVE_PLAIN:g} of plain", "above_plain"),
            ("above nominal + friction", "above_nominal_friction"),
            ("above nominal + scale", "above_nominal_scale"),
        ):
            names = figures[key]
            yield f"{title}: {len(names)} of {len(figures['rows'])} rows" + "".join(
                f"; {name}" for name in names
            )
    for choice, judged in figures.get("choices", {}).items():
        yield (
            f"without {choice}: {judged['mean']:.3f} ({judged['best']:.2f} to"
            f" {judged['worst']:.2f}); left out by the others of"
            f" {', '.join(judged['dropped_by']) or 'none'}"
        )
    for answers, judged in figures.get("averaging", {}).items():
        yield (
            f"with averaged answers, {answers}: {judged['mean']:.3f} ({judged['best']:.2f} to"
            f" {judged['worst']:.2f}); averaged by the others of"
            f" {', '.join(judged['dropped_by']) or 'none'}"
        )
    if "averaged_ratios" in figures:
        averaged = figures["averaged_ratios"]
        yield (
            f"with averaged answers, hil / plain: geometric mean {averaged['mean']:.3f}, worst"
            f" {averaged['worst']:.3f}, above 1 in {averaged['losses']} rows"
        )
    if "right" in figures:
        yield f"right verdicts: {figures['right']} of {len(figures['degraded'])}"


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure, and print each row as it comes, then the line of JSON."""
    parser = parser_of(__doc__)
    parser.add_argument("--data", type=Path, help="folder of recordings")
    parser.add_argument(
        "--only", action="append", choices=[*known(), SIMULATED], help="may be repeated"
    )
    parser.add_argument(
        "--splits",
        choices=get_args(Which),
        default="configured",
        help="short: fit 40 %% of a log, predict the rest; perturbed: other pairs of motions,"
        " halves, 10 to 30 s, one row in two",
    )
    parser.add_argument("--choices", action="store_true", help="without each choice as well")
    parser.add_argument("--averaging", action="store_true", help="averaged answers as well")
    parser.add_argument("--degraded", action="store_true", help="spoilt copies as well")
    parser.add_argument(
        "--fetch", nargs="*", type=Path, metavar="FROM",
        help="collect the recordings in the folder of --data, from these folders and packages",
    )  # fmt: skip
    parser.add_argument("--page", type=Path, help="write the page of all arms to this file")
    parser.add_argument("--rows", type=Path, help="with --page: a saved line of JSON")
    options = parser.parse_args(arguments)
    if options.rows is not None:
        if options.page is None:
            parser.error("--rows needs --page FILE")
        write_page(options.page, json.loads(options.rows.read_text("utf-8")))
        return
    wanted = options.only or [*known(), SIMULATED]
    if options.fetch is not None:
        names = [name for name in wanted if name != SIMULATED]
        show_fetched(fetch(names, options.fetch, options.data or FETCHED), options.json)
        return
    options.data = options.data or (DATA if DATA.is_dir() else FETCHED)
    rows: list[Row] = []
    degraded: list[Row] = []
    for name in wanted:
        measured = rows_of(
            name,
            options.data,
            options.splits,
            choices=options.choices,
            averaging=options.averaging,
        )
        for row in () if name == SIMULATED else measured:
            rows.append(row)
            if not options.json:
                print(_line(row), flush=True)
    for name in wanted if options.degraded else ():
        for row in degraded_rows(name, *split_logs(name, options.data)):
            degraded.append(row)
            if not options.json:
                print(_line(row), flush=True)
    figures = summary(rows, degraded) | {"commit": commit()}
    if not options.json:
        print("\n".join(summary_lines(figures)))
    if options.page is not None:
        write_page(options.page, figures)
    show(figures, only_json=True)


def _line(row: Row) -> str:
    """Return names, errors and remarks of a row."""
    shown = [f"{row['data']:11} {row.get('split') or row['case']:30}"]
    errors = [key for key in ("hil", *RIVALS, "undegraded") if row.get(key) is not None]
    shown += [f"{key} {row[key]:.2%}" for key in errors]
    shown += [f"{key} {row[key]:.2f}" for key in ("ratio", "inside") if row.get(key) is not None]
    shown += [
        f"without {choice} {ratio:.3f}"
        for choice, ratio in row.get("without", {}).items()
        if abs(ratio - 1.0) > _SHOWN
    ]
    if "right" in row:
        shown += ["right" if row["right"] else "not right", *row["words"]]
    return "  ".join(shown)


if __name__ == "__main__":
    main()
