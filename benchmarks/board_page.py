"""The page of all real arms, `docs/board.md`, from the rows of `benchmarks.board` and a table.

Arms whose recordings are not here are in `benchmarks/elsewhere.toml`, with the figures that others
measured.
"""

from __future__ import annotations

import subprocess
import textwrap
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from pydantic import BaseModel, ConfigDict

from benchmarks.averaging import ratios_of
from benchmarks.choices import judged_by_others
from benchmarks.published import Published

ELSEWHERE: Final = Path(__file__).with_name("elsewhere.toml")
_SEEN: Final = 0.005  # difference of a ratio from one that is shown
BEHIND: Final = 1.0  # ratio to an ordinary fit from which a row is a loss
_HEAD: Final = (
    "| arm, source | split | ordinary | nominal | hil | ratio | inside | s |\n"
    "|---|---|---|---|---|---|---|---|"
)


class Line(BaseModel):
    """A row of the page; errors are shares of the torque, over all joints and every row.

    Attributes:
        arm: name, axes, rate, kind of torque.
        source: repository and licence.
        split: what is fitted and what is predicted.
        plain: error of an ordinary fit.
        nominal: of the URDF's model as it is; None if it has no masses, or was not measured.
        nominal_friction: the same with rotor inertia, friction and offset fitted.
        nominal_scale: the same with the scale of each joint's torque fitted as well.
        hil: by default settings.
        inside: share of held-out means inside their 95 % intervals, or words for it.
        seconds: of the processor, or words for it.
        commit: at which it was measured elsewhere; None: here.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    arm: str
    source: str
    split: str
    plain: float
    nominal: float | None = None
    nominal_friction: float | None = None
    nominal_scale: float | None = None
    hil: float
    inside: float | str | None = None
    seconds: float | str | None = None
    commit: str | None = None

    @property
    def ratio(self) -> float:
        """Error over that of an ordinary fit."""
        return self.hil / self.plain

    @property
    def nominals(self) -> list[float]:
        """Errors of the nominal model as it is, and with what was fitted, as far as measured."""
        errors = self.nominal, self.nominal_friction, self.nominal_scale
        return [error for error in errors if error is not None]

    @property
    def is_loss(self) -> bool:
        """Whether an ordinary fit, or the nominal model with or without friction, was better."""
        return self.ratio > BEHIND or any(self.hil > error for error in self.nominals)

    def text(self) -> str:
        """The row in Markdown."""
        nominal = [_percent(error) for error in self.nominals]
        mark = "" if self.commit is None else f" (measured elsewhere, {self.commit})"
        inside = _percent(self.inside) if isinstance(self.inside, float) else self.inside
        seconds = f"{self.seconds:.0f}" if isinstance(self.seconds, float) else self.seconds
        cells = (
            f"{self.arm}; {self.source}{mark}",
            self.split,
            _percent(self.plain),
            " / ".join(nominal) or "-",
            _percent(self.hil),
            f"{self.ratio:.2f}",
            inside or "-",
            seconds or "-",
        )
        return f"| {' | '.join(cells)} |"


def line_of(row: Mapping[str, Any]) -> Line:
    """The line of a row of the board."""
    source = Published.named(row["data"]).source
    return Line(
        arm=source.arm,
        source=f"{source.repository}, {source.licence}",
        split=row["split"],
        plain=row["plain"],
        nominal=row["nominal"],
        nominal_friction=row["nominal + friction"],
        nominal_scale=row["nominal + scale"],
        hil=row["hil"],
        inside=row["inside"],
        seconds=row["seconds"]["hil"],
    )


def elsewhere() -> list[Line]:
    """The lines of arms that others measured."""
    table = tomllib.loads(ELSEWHERE.read_text("utf-8"))
    return [Line(**{"commit": table["commit"], **entry}) for entry in table["row"]]


def page_text(rows: Sequence[Mapping[str, Any]], commit: str) -> str:
    """The page, of rows that were measured at a commit."""
    here = [line_of(row) for row in rows]
    every = sorted([*here, *elsewhere()], key=lambda line: -line.ratio)
    losses = [line for line in every if line.is_loss]
    others = [line for line in every if not line.is_loss]
    return "\n".join(
        [
            *_introduction(here, losses, commit),
            *_tables(losses, others),
            *_choices(rows),
            *_averaging(rows),
        ]
    )


_TEXT: Final = """\
All recordings of real arms that were ever tried, losses first. Errors are ‖τ - τ̂‖ / ‖τ‖ of the
recorded torque, over all joints and all predicted rows.

*hil* uses its default settings. *Ordinary* is an ordinary fit (`benchmarks/plain_fit.py`) of base
parameters, Coulomb and viscous friction, offset and rotor inertia, with a cut-off frequency
chosen on the fitted part. *Nominal* is the URDF's model: first unchanged, after the first slash
with fitted rotor inertia and friction, after the second slash with a fitted torque scale of each
joint as well. *Ratio* is hil over ordinary: above 1, hil is worse. *Inside* is the fraction of
held-out torque means within their 95 % intervals, and *s* is the processor time in seconds.

Measured at {commit} on {splits} splits of real arms ({arms} arms): the geometric mean of the
ratios is {mean:.2f}, and {behind} of {splits} are worse than an ordinary fit or the nominal
model. These commands collect the recordings and renew the page:
"""
_AFTER: Final = """\
`--fetch` collects what the named folders and the package index offer, checked by SHA-256
(`benchmarks/recordings/*.toml`), and names the repository of each file that it cannot find. The
index offers only URDFs (`example-robot-data`); recordings come from a folder.

Rows *measured elsewhere* are arms whose recordings are reserved for acceptance and not available
here. Their figures were reported for the commit in the row (`benchmarks/elsewhere.toml`), which
predates heavy rotors and the test of low-passes, and were not measured again. A range covers a
group of rows. The report does not name the sources marked *not named*.
"""
_COMMANDS: Final = """\
```text
python -m benchmarks.board --fetch FROM --data DIR   # collects the recordings
python -m benchmarks.board --data DIR --choices --averaging --page docs/board.md
```"""
_WIDTH: Final = 110


def _introduction(here: Sequence[Line], losses: Sequence[Line], commit: str) -> Iterator[str]:
    yield "# All real arms"
    yield ""
    yield from _wrapped(
        _TEXT.format(
            commit=commit,
            arms=len({line.arm for line in here}),
            splits=len(here),
            mean=float(np.exp(np.mean([np.log(line.ratio) for line in here]))),
            behind=sum(line.commit is None for line in losses),
        )
    )
    yield _COMMANDS
    yield ""
    yield from _wrapped(_AFTER)


def _wrapped(text: str) -> Iterator[str]:
    for paragraph in text.strip().split("\n\n"):
        yield textwrap.fill(paragraph, _WIDTH, break_on_hyphens=False)
        yield ""


def _tables(losses: Sequence[Line], others: Sequence[Line]) -> Iterator[str]:
    for title, lines in (
        ("## Worse than an ordinary fit or the nominal model", losses),
        ("## At least as good", others),
    ):
        yield title
        yield ""
        if lines:
            yield _HEAD
            yield from (line.text() for line in lines)
        else:
            yield "None."
        yield ""


_CHOICES: Final = """\
Each cell is the error without a choice divided by the error with all choices: above 1 the choice
helps, below 1 it hurts; differences within 0.5 % are left empty. A choice that is left out has
its first candidate. *Mean* is the geometric mean over robots. *Others* is the mean if each robot
follows the preference of the other robots (leave-one-robot-out): at 1 no robot would drop the
choice. *Reversal* is for logs of simulators, whose friction reverses smoothly: without it, `hil`
takes the torque of a simulator with tanh(v / 0.05 rad/s) for a filtered one
(`tests/hil/identified/test_clean_logs.py`).
"""

_AVERAGING: Final = """\
Each cell is the error with averaged answers (`benchmarks/averaging.py`) divided by the present
error: below 1 averaging helps, above 1 it hurts; differences within 0.5 % are left empty. *Mean*
is the geometric mean over robots. *Others* is the mean if each robot averages when that is better
for the other robots: at 1 no robot would.

If all answers except those about the prior are averaged, each question by itself, the error
relative to an ordinary fit has a geometric mean of {averaged.mean:.3f} and a maximum of
{averaged.worst:.3f}, and exceeds 1 in {averaged.losses} of {averaged.rows} rows. At present these
figures are {now.mean:.3f}, {now.worst:.3f} and {now.losses}.
"""


def _choices(rows: Sequence[Mapping[str, Any]]) -> Iterator[str]:
    """Yield what each row has without each choice, and whether the other robots keep it."""
    if rows and all("without" in row for row in rows):
        yield from _judged("Without each choice", _CHOICES, rows, "without")


def _averaging(rows: Sequence[Mapping[str, Any]]) -> Iterator[str]:
    """Yield what each row has with averaged answers, and whether the other robots average."""
    if rows and all("averaged" in row for row in rows):
        text = _AVERAGING.format(averaged=ratios_of(rows, averaged=True), now=ratios_of(rows))
        yield from _judged("With averaged answers", text, rows, "averaged")


def _judged(title: str, text: str, rows: Sequence[Mapping[str, Any]], key: str) -> Iterator[str]:
    judged = judged_by_others(rows, key)
    used = [name for name in judged if any(abs(row[key][name] - 1.0) > _SEEN for row in rows)]
    yield f"## {title}"
    yield ""
    yield from _wrapped(text)
    yield f"| row | {' | '.join(used)} |"
    yield f"|---|{'---|' * len(used)}"
    for row in rows:
        yield f"| {row['data']}, {row['split']} | {' | '.join(_cells(row[key], used))} |"
    for name_of_row, figure in (("mean", "mean"), ("others", "left_to_others")):
        cells = " | ".join(f"{judged[name][figure]:.3f}" for name in used)
        yield f"| *{name_of_row}* | {cells} |"
    yield ""
    unused = ", ".join(name for name in judged if name not in used)
    if unused:
        yield f"No effect on any row: {unused}."
        yield ""


def _cells(ratios: Mapping[str, float], used: Sequence[str]) -> Iterator[str]:
    for name in used:
        yield f"{ratios[name]:.2f}" if abs(ratios[name] - 1.0) > _SEEN else ""


def _percent(share: float) -> str:
    percent = 100.0 * share
    return f"{percent:.3g} %" if percent < 1e4 else f"{percent:.0e} %"


def write_page(path: Path, figures: Mapping[str, Any]) -> None:
    """Write the page of what the line of JSON holds."""
    path.write_text(page_text(figures["rows"], figures["commit"]), encoding="utf-8")


def commit() -> str:
    """The commit of this checkout, with + if files differ from it."""
    command = ["git", "describe", "--always", "--dirty=+", "--exclude=*"]
    done = subprocess.run(
        command, capture_output=True, text=True, cwd=Path(__file__).parent, check=False
    )
    return done.stdout.strip() or "an unknown commit"
