"""`hil import`: foreign recordings into archives."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from hil.archive import open_archive
from hil.cli.arguments import (
    ConventionOption,
    DhOption,
    JsonOption,
    exactly_one,
    figures,
    print_json,
    with_options,
)
from hil.errors import InputError
from hil.identify.options import FRICTION_TERMS, friction_from
from hil.importers import (
    STANDARD_GRAVITY,
    ColumnMap,
    Effort,
    Robot,
    Use,
    convention_of,
    import_log,
    import_rosbag2,
    recorded_joints,
)
from hil.progress import say
from hil.terminal_text import printable
from identification import FrictionLaw

app = typer.Typer(
    help="Turn other people's recordings into archives that `hil identify` reads.",
    no_args_is_help=True,
)

Source = Annotated[Path, typer.Argument(help="The recording.")]
Output = Annotated[Path, typer.Option("--output", "-o", help="The archive to write (*.mcap).")]
Held = Annotated[
    list[str] | None,
    typer.Option(help="A joint known to have stood still; may be repeated."),
]
Kind = Annotated[
    Use,
    typer.Option(
        help="What it is for: excitation (to be fitted), validation (only predicted) or standstill "
        "(the noise of the positions)."
    ),
]


@dataclass(frozen=True)
class Described:
    """What describes the robot of a recording, as it is typed."""

    urdf: Annotated[Path | None, typer.Option(help="URDF of the robot.")] = None
    cell: Annotated[
        Path | None, typer.Option(help="A cell file instead of --urdf and --friction.")
    ] = None
    dh: DhOption = None
    convention: ConventionOption = None
    gravity: Annotated[
        tuple[float, float, float] | None,
        typer.Option(
            metavar="X Y Z",
            help="Gravity in the robot's base frame, m/s², for an arm on a wall, a ceiling or a "
            "slope: 0 0 9.81 for one that hangs upside down; 0 0 0 if the torques are without "
            "gravity already. As of an upright arm, or as the cell says, if left out.",
        ),
    ] = None
    friction: Annotated[
        str,
        typer.Option(help=f"Friction law: some of {FRICTION_TERMS}, with commas between them."),
    ] = "coulomb,viscous,offset"
    standstill: Annotated[
        float, typer.Option(min=0.0, help="Speed in rad/s below which a joint's row is not fitted.")
    ] = 0.01
    locked: Annotated[
        list[str] | None,
        typer.Option(
            help="A joint of the URDF that was not recorded, NAME or NAME=POSITION (rad or m), "
            "held there (at 0); may be repeated."
        ),
    ] = None
    lock_others: Annotated[
        bool,
        typer.Option(
            help="Lock every joint of the URDF that was not recorded, at 0 or at the middle of a "
            "range without 0; the command says which. A log names those that were recorded in "
            "`joints` of its map."
        ),
    ] = False

    def robot(self, recorded: Callable[[], tuple[str, ...] | None]) -> Robot:
        """The robot of a cell file, a URDF or a DH table; `recorded` gives joints of a recording.

        Raises:
            InputError: not exactly one of these was named, or a figure cannot be used.
        """
        exactly_one(urdf=self.urdf, cell=self.cell, dh=self.dh)
        if self.gravity is not None and not all(map(math.isfinite, self.gravity)):
            problem, remedy = f"{self.gravity} is no vector", "give m/s², as in 0 0 -9.81"
            raise InputError(None, problem, field="--gravity", remedy=remedy)
        if not math.isfinite(self.standstill):
            problem, remedy = f"{self.standstill} is no speed", "give rad/s, as in 0.01"
            raise InputError(None, problem, field="--standstill", remedy=remedy)
        law = FrictionLaw.from_table(
            {**friction_from(self.friction), "standstill": self.standstill}
        )
        at = figures(self.locked or [], "--locked", "--locked joint_7=0.3 (rad or m)")
        joints = recorded() if self.lock_others else None
        if self.cell is not None:
            return Robot.from_cell(self.cell, gravity=self.gravity, locked=at, recorded=joints)
        path = self.urdf or self.dh
        assert path is not None
        return Robot.from_urdf(
            path,
            convention=None if self.dh is None else convention_of(self.convention),
            friction=law,
            gravity=self.gravity or STANDARD_GRAVITY,
            locked=at,
            recorded=joints,
        )


@app.command("rosbag2")
@with_options(Described, "arm")
def rosbag2(
    source: Source,
    output: Output,
    *,
    arm: Described,
    topic: str | None = None,
    effort: Effort = "torque",
    rename: Annotated[list[str] | None, typer.Option(metavar="RECORDED=URDF")] = None,
    held: Held = None,
    kind: Kind = "excitation",
    json: JsonOption = False,
) -> None:
    """Import sensor_msgs/JointState from a rosbag2, or from any MCAP file; joints go by name.

    A bag's folder, its .db3 or .mcap file, compressed or not. Messages of other types in an MCAP
    file are imported by `hil import log` with a column map. Of a URDF with more joints than were
    recorded, --locked or --lock-others leaves those out of the model.

    **Example:** `hil import rosbag2 bag --urdf arm.urdf --lock-others --gravity 0 0 9.81 -o a.mcap`

    Options:
        topic: Topic of the joint states, if there is more than one.
        effort: What the effort field holds: torque (N·m), motor_current (A) or ignore.
        rename: A joint that the bag calls by another name than the URDF; may be repeated.
    """
    names = _names(rename or [])
    path = import_rosbag2(
        source,
        output,
        robot=arm.robot(lambda: recorded_joints(source, topic, names)),
        topic=topic,
        effort=effort,
        joint_names=names,
        held_joints=held or (),
        use=kind,
    )
    _tell(path, json=json)


@with_options(Described, "arm")
def log(
    source: Source,
    output: Output,
    columns: Annotated[Path, typer.Option("--map")],
    *,
    arm: Described,
    held: Held = None,
    kind: Kind = "excitation",
    uncoupled: bool = False,
    json: JsonOption = False,
) -> None:
    """Import a log of numbers: CSV, text matrices, .npz, .npy, .mat, MATLAB text or .mcap.

    A column map names its columns or arrays, their units and sides: `docs/archive-format.md`. It
    also says where a quantity has a file of its own, or one per joint; the recording may then be a
    folder. What looks like a slip of the map is said in warnings: two readings, and their errors.

    **Example:** `hil import log log.csv --map map.toml --urdf arm.urdf -o log.mcap`, with
    `map.toml` of `[time] column = "t"`, `[position] columns = "q{}"`, `[torque] columns = "tau{}"`

    Options:
        columns: TOML file that says which columns or arrays hold what.
        uncoupled: Leave the inertias and the friction of coupled motors out of the model, to see
            what they explain; angles and torques stay those of the map.
    """

    def recorded() -> tuple[str, ...]:
        joints = ColumnMap.load(columns).joints
        if joints is None:
            problem = "does not say which joints were recorded"
            remedy = "--lock-others needs joints = [...], the URDF's joint of each column"
            raise InputError(columns, problem, field="joints", remedy=remedy)
        return joints

    path = import_log(
        source,
        output,
        robot=arm.robot(recorded),
        columns=ColumnMap.load(columns),
        held_joints=held or (),
        use=kind,
        coupled=not uncoupled,
    )
    _tell(path, json=json)


app.command("log")(log)
# Under the names that people look for.
app.command("mcap", hidden=True)(rosbag2)
for _name in ("csv", "npz"):
    app.command(_name, hidden=True)(log)


def _tell(path: Path, *, json: bool) -> None:
    """What was read, as the archive keeps it."""
    found = open_archive(path).header.findings
    if json:
        print_json({"archive": str(path), "found": found.lines, "warnings": found.warnings})
        return
    for line in found.lines:
        say(line)
    for warning in found.warnings:
        typer.secho(printable(f"warning: {warning}"), fg=typer.colors.YELLOW)
    say(f"wrote {path}")


def _names(renamed: list[str]) -> dict[str, str]:
    """Name in the URDF by name in the bag."""
    names = dict(text.partition("=")[::2] for text in renamed)
    for recorded, name in names.items():
        if not (recorded and name):
            problem = f"{recorded or '=' + name!r} is no pair"
            raise InputError(None, problem, field="--rename", remedy="give RECORDED=URDF")
    return names
