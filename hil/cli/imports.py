"""`hil import`: foreign recordings into archives."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated

import typer

from hil.archive import open_archive
from hil.cli.arguments import ConventionOption, DhOption, JsonOption, figures, print_json
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

FRICTION = "coulomb,viscous,offset"

app = typer.Typer(
    help="Turn other people's recordings into archives that `hil identify` reads.",
    no_args_is_help=True,
)

Source = Annotated[Path, typer.Argument(help="The recording.", show_default=False)]
Output = Annotated[
    Path, typer.Option("--output", "-o", help="The archive to write (*.mcap).", show_default=False)
]
Urdf = Annotated[Path | None, typer.Option(help="URDF of the robot.", show_default=False)]
CellFile = Annotated[
    Path | None,
    typer.Option(help="A cell file instead of --urdf and --friction.", show_default=False),
]
Gravity = Annotated[
    tuple[float, float, float] | None,
    typer.Option(
        metavar="X Y Z",
        help="Gravity in the robot's base frame, m/s², for an arm on a wall, a ceiling or a slope: "
        "0 0 9.81 for one that hangs upside down; 0 0 0 if the torques are without gravity "
        "already. As of an upright arm, or as the cell says, if left out.",
        show_default=False,
    ),
]
Friction = Annotated[
    str,
    typer.Option(help=f"Friction law: some of {FRICTION_TERMS}, with commas between them."),
]
Standstill = Annotated[
    float,
    typer.Option(min=0.0, help="Speed in rad/s below which a joint's row is not fitted."),
]
Locked = Annotated[
    list[str] | None,
    typer.Option(
        "--locked",
        help="A joint of the URDF that was not recorded, NAME or NAME=POSITION (rad or m), held "
        "there (at 0); may be repeated.",
        show_default=False,
    ),
]
LockOthers = Annotated[
    bool,
    typer.Option(
        "--lock-others",
        help="Lock every joint of the URDF that was not recorded, at 0 or at the middle of a "
        "range without 0; the command says which. A log names those that were recorded in `joints` "
        "of its map.",
    ),
]
Held = Annotated[
    list[str] | None,
    typer.Option(
        "--held", help="A joint known to have stood still; may be repeated.", show_default=False
    ),
]
Kind = Annotated[
    Use,
    typer.Option(
        help="What it is for: excitation (to be fitted), validation (only predicted) or standstill "
        "(the noise of the positions)."
    ),
]


@app.command("rosbag2")
def rosbag2(
    source: Source,
    output: Output,
    urdf: Urdf = None,
    cell: CellFile = None,
    dh: DhOption = None,
    convention: ConventionOption = None,
    gravity: Gravity = None,
    friction: Friction = FRICTION,
    standstill: Standstill = 0.01,
    topic: Annotated[
        str | None, typer.Option(help="Topic of the joint states, if there is more than one.")
    ] = None,
    effort: Annotated[
        Effort,
        typer.Option(
            help="What the effort field holds: torque (N·m), motor_current (A) or ignore."
        ),
    ] = "torque",
    rename: Annotated[
        list[str] | None,
        typer.Option(
            metavar="RECORDED=URDF",
            help="A joint that the bag calls by another name than the URDF; may be repeated.",
            show_default=False,
        ),
    ] = None,
    locked: Locked = None,
    lock_others: LockOthers = False,
    held: Held = None,
    kind: Kind = "excitation",
    json: JsonOption = False,
) -> None:
    """Import sensor_msgs/JointState from a rosbag2, or from any MCAP file; joints go by name.

    A bag's folder, its .db3 or .mcap file, compressed or not. Messages of other types in an MCAP
    file are imported by `hil import log` with a column map. Of a URDF with more joints than were
    recorded, --locked or --lock-others leaves those out of the model.

    **Example:** `hil import rosbag2 bag --urdf arm.urdf --lock-others --gravity 0 0 9.81 -o a.mcap`
    """
    _require_one_robot(urdf, cell, dh)
    names = _names(rename or [])
    path = import_rosbag2(
        source,
        output,
        robot=_robot(
            urdf,
            cell,
            dh,
            convention,
            gravity,
            _law(friction, standstill),
            figures(locked or [], "--locked", "--locked joint_7=0.3 (rad or m)"),
            recorded_joints(source, topic, names) if lock_others else None,
        ),
        topic=topic,
        effort=effort,
        joint_names=names,
        held_joints=held or (),
        use=kind,
    )
    _tell(path, json=json)


def log(
    source: Source,
    output: Output,
    columns: Annotated[
        Path,
        typer.Option(
            "--map",
            help="TOML file that says which columns or arrays hold what.",
            show_default=False,
        ),
    ],
    urdf: Urdf = None,
    cell: CellFile = None,
    dh: DhOption = None,
    convention: ConventionOption = None,
    gravity: Gravity = None,
    friction: Friction = FRICTION,
    standstill: Standstill = 0.01,
    locked: Locked = None,
    lock_others: LockOthers = False,
    held: Held = None,
    kind: Kind = "excitation",
    uncoupled: Annotated[
        bool,
        typer.Option(
            "--uncoupled",
            help="Leave the inertias and the friction of coupled motors out of the model, to see "
            "what they explain; angles and torques stay those of the map.",
        ),
    ] = False,
    json: JsonOption = False,
) -> None:
    """Import a log of numbers: CSV, text matrices, .npz, .npy, .mat, MATLAB text or .mcap.

    A column map names its columns or arrays, their units and sides: `docs/archive-format.md`. It
    also says where a quantity has a file of its own, or one per joint; the recording may then be a
    folder. What looks like a slip of the map is said in warnings: two readings, and their errors.

    **Example:** `hil import log log.csv --map map.toml --urdf arm.urdf -o log.mcap`, with
    `map.toml` of `[time] column = "t"`, `[position] columns = "q{}"`, `[torque] columns = "tau{}"`
    """
    _require_one_robot(urdf, cell, dh)
    found = ColumnMap.load(columns)
    if lock_others and found.joints is None:
        raise InputError(
            columns,
            "does not say which joints were recorded",
            field="joints",
            remedy="--lock-others needs joints = [...], the URDF's joint of each column",
        )
    path = import_log(
        source,
        output,
        robot=_robot(
            urdf,
            cell,
            dh,
            convention,
            gravity,
            _law(friction, standstill),
            figures(locked or [], "--locked", "--locked joint_7=0.3 (rad or m)"),
            found.joints if lock_others else None,
        ),
        columns=found,
        held_joints=held or (),
        use=kind,
        coupled=not uncoupled,
    )
    _tell(path, json=json)


app.command("log")(log)
# One importer under the names that people look for.
app.command("mcap", hidden=True)(rosbag2)
for _name in ("csv", "npz"):
    app.command(_name, hidden=True)(log)


def _tell(path: Path, *, json: bool) -> None:
    """What was read, as the archive keeps it."""
    found = open_archive(path).header.findings
    if json:
        summary = {"archive": str(path), "found": found.lines, "warnings": found.warnings}
        print_json(summary)
        return
    for line in found.lines:
        say(line)
    for warning in found.warnings:
        typer.secho(printable(f"warning: {warning}"), fg=typer.colors.YELLOW)
    say(f"wrote {path}")


def _require_one_robot(urdf: Path | None, cell: Path | None, dh: Path | None) -> None:
    given = [name for name, path in (("--urdf", urdf), ("--cell", cell), ("--dh", dh)) if path]
    if len(given) != 1:
        raise InputError(
            None,
            "both describe the robot" if given else "whose recording is it?",
            field=" and ".join(given) or "--urdf",
            remedy="leave out one of them (a cell file names its own URDF)"
            if given
            else "give --urdf, --cell or --dh",
        )


def _robot(
    urdf: Path | None,
    cell: Path | None,
    dh: Path | None,
    convention: str | None,
    gravity: tuple[float, float, float] | None,
    law: FrictionLaw,
    locked: dict[str, float],
    recorded: tuple[str, ...] | None,
) -> Robot:
    if gravity is not None and not all(math.isfinite(one) for one in gravity):
        raise InputError(
            None, f"{gravity} is no vector", field="--gravity", remedy="give m/s², as in 0 0 -9.81"
        )
    if cell is not None:
        return Robot.from_cell(cell, gravity=gravity, locked=locked, recorded=recorded)
    down = STANDARD_GRAVITY if gravity is None else gravity
    table = None if dh is None else convention_of(convention)
    path = urdf or dh
    assert path is not None
    return Robot.from_urdf(
        path, convention=table, friction=law, gravity=down, locked=locked, recorded=recorded
    )


def _names(renamed: list[str]) -> dict[str, str]:
    """Name in the URDF by name in the bag."""
    names = {}
    for text in renamed:
        recorded, _, name = text.partition("=")
        if not (recorded and name):
            raise InputError(
                None, f"{text!r} is no pair", field="--rename", remedy="give RECORDED=URDF"
            )
        names[recorded] = name
    return names


def _law(terms: str, standstill: float) -> FrictionLaw:
    if not math.isfinite(standstill):
        raise InputError(
            None, f"{standstill} is no speed", field="--standstill", remedy="give rad/s, as in 0.01"
        )
    return FrictionLaw.from_table({**friction_from(terms), "standstill": standstill})
