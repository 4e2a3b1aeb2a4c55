"""`hil import`: foreign recordings into archives."""

from __future__ import annotations

import json as json_format
import math
from pathlib import Path
from typing import Annotated, Literal

import typer

from hil.archive import open_archive
from hil.errors import InputError
from hil.importers import ColumnMap, Findings, Robot, Use, import_log, import_rosbag2
from hil.lines import say
from hil.printable import printable
from identification import FrictionLaw

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
Friction = Annotated[
    str,
    typer.Option(
        help="Friction terms, comma separated: coulomb, viscous, quadratic (sgn(v) v²) or cubic "
        "(v³), offset. A cell file can say more."
    ),
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
Held = Annotated[
    list[str] | None,
    typer.Option(
        "--held", help="A joint known to have stood still; may be repeated.", show_default=False
    ),
]
Kind = Annotated[
    str,
    typer.Option(
        help="What it is for: excitation (to be fitted), validation (only predicted) or standstill "
        "(the noise of the positions)."
    ),
]
Json = Annotated[bool, typer.Option("--json", help="Print what was found as JSON.")]


@app.command("rosbag2")
def rosbag2(
    source: Source,
    output: Output,
    urdf: Urdf = None,
    cell: CellFile = None,
    friction: Friction = "coulomb,viscous,quadratic,offset",
    standstill: Standstill = 0.01,
    topic: Annotated[
        str | None, typer.Option(help="Topic of the joint states, if there is more than one.")
    ] = None,
    effort: Annotated[
        str,
        typer.Option(
            help="What the effort field holds: torque (N·m), motor_current (A) or ignore."
        ),
    ] = "torque",
    locked: Locked = None,
    held: Held = None,
    kind: Kind = "excitation",
    json: Json = False,
) -> None:
    """Import sensor_msgs/JointState from a rosbag2, or from any MCAP file; joints go by name.

    A bag's folder, its .db3 or .mcap file, compressed or not. Messages of other types in an MCAP
    file are imported by `hil import log` with a column map.
    """
    kinds: dict[str, Literal["torque", "motor_current", "ignore"]] = {
        "torque": "torque",
        "motor_current": "motor_current",
        "ignore": "ignore",
    }
    if effort not in kinds:
        raise InputError(
            None, f"{effort!r} is unknown", field="--effort", remedy=f"use {', '.join(kinds)}"
        )
    path = import_rosbag2(
        source,
        output,
        robot=_robot(urdf, cell, friction, standstill, locked),
        topic=topic,
        effort=kinds[effort],
        held_joints=held or (),
        use=_use(kind),
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
    friction: Friction = "coulomb,viscous,quadratic,offset",
    standstill: Standstill = 0.01,
    locked: Locked = None,
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
    json: Json = False,
) -> None:
    """Import a log of numbers: CSV, text matrices, .npz, .npy, .mat, MATLAB text or .mcap.

    A column map names its columns or arrays, their units and sides: `docs/archive-format.md`.
    """
    path = import_log(
        source,
        output,
        robot=_robot(urdf, cell, friction, standstill, locked),
        columns=ColumnMap.load(columns),
        held_joints=held or (),
        use=_use(kind),
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
    found = Findings.of(open_archive(path).metadata)
    if json:
        told = {"archive": str(path), "found": found.lines, "doubts": found.doubts}
        typer.echo(json_format.dumps(told))
        return
    for line in found.lines:
        say(line)
    for doubt in found.doubts:
        typer.secho(printable(f"doubtful: {doubt}"), fg=typer.colors.YELLOW)
    say(f"wrote {path}")


def _use(kind: str) -> Use:
    kinds: dict[str, Use] = {
        "excitation": "excitation",
        "validation": "validation",
        "standstill": "standstill",
    }
    if kind not in kinds:
        raise InputError(
            None, f"{kind!r} is unknown", field="--kind", remedy=f"use {', '.join(kinds)}"
        )
    return kinds[kind]


def _robot(
    urdf: Path | None, cell: Path | None, friction: str, standstill: float, locked: list[str] | None
) -> Robot:
    if urdf is not None and cell is not None:
        raise InputError(
            None,
            "a cell file names its own URDF",
            field="--urdf",
            remedy="leave out one of --urdf and --cell",
        )
    if urdf is None and cell is None:
        raise InputError(
            None, "whose recording is it?", field="--urdf", remedy="give --urdf or --cell"
        )
    positions = _positions(locked or [])
    if cell is not None:
        return Robot.from_cell(cell, locked=positions)
    assert urdf is not None
    return Robot.from_urdf(urdf, friction=_law(friction, standstill), locked=positions)


def _positions(locked: list[str]) -> dict[str, float]:
    """Positions of locked joints from NAME or NAME=POSITION."""
    positions = {}
    for text in locked:
        name, _, position = text.partition("=")
        try:
            positions[name] = float(position) if position else 0.0
        except ValueError as error:
            raise InputError(
                None,
                f"{position!r} is no position",
                field=f"--locked {text}",
                remedy="give rad or m, as in --locked joint_7=0.3",
            ) from error
    return positions


def _law(terms: str, standstill: float) -> FrictionLaw:
    wanted = {term.strip() for term in terms.split(",") if term.strip()}
    known = {"coulomb", "viscous", "quadratic", "cubic", "offset"}
    if wanted - known or {"quadratic", "cubic"} <= wanted:
        raise InputError(
            None,
            f"{terms!r} is no friction law",
            field="--friction",
            remedy=f"use some of {', '.join(sorted(known))}, not both quadratic and cubic",
        )
    if not math.isfinite(standstill):
        raise InputError(
            None, f"{standstill} is no speed", field="--standstill", remedy="give rad/s, as in 0.01"
        )
    return FrictionLaw(
        coulomb="coulomb" in wanted,
        viscous="viscous" in wanted,
        third="quadratic" if "quadratic" in wanted else "cubic" if "cubic" in wanted else None,
        offset="offset" in wanted,
        standstill=standstill,
    )
