"""`hil import`: foreign recordings into archives."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from hil.errors import InputError
from hil.importers import ColumnMap, Robot, import_csv, import_rosbag2
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
        "(v³), offset."
    ),
]
Standstill = Annotated[
    float,
    typer.Option(min=0.0, help="Speed in rad/s below which a joint's row is not fitted."),
]
Fixed = Annotated[
    list[str] | None,
    typer.Option("--fixed", help="A joint of the URDF to hold at zero; may be repeated."),
]
Held = Annotated[
    list[str] | None,
    typer.Option("--held", help="A joint known to have stood still; may be repeated."),
]


@app.command("rosbag2")
def rosbag2(
    source: Source,
    output: Output,
    urdf: Urdf = None,
    cell: CellFile = None,
    friction: Friction = "coulomb,viscous,offset",
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
    fixed: Fixed = None,
    held: Held = None,
) -> None:
    """Import sensor_msgs/JointState from a rosbag2 (sqlite3) recording; joints go by name."""
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
        robot=_robot(urdf, cell, friction, standstill, fixed),
        topic=topic,
        effort=kinds[effort],
        held_joints=held or (),
    )
    typer.echo(f"wrote {path}")


@app.command("csv")
def csv(
    source: Source,
    output: Output,
    columns: Annotated[
        Path,
        typer.Option(
            "--map", help="TOML file that says which columns hold what.", show_default=False
        ),
    ],
    urdf: Urdf = None,
    cell: CellFile = None,
    friction: Friction = "coulomb,viscous,offset",
    standstill: Standstill = 0.01,
    fixed: Fixed = None,
    held: Held = None,
) -> None:
    """Import a CSV log; a column map names its columns, units and sides."""
    path = import_csv(
        source,
        output,
        robot=_robot(urdf, cell, friction, standstill, fixed),
        columns=ColumnMap.load(columns),
        held_joints=held or (),
    )
    typer.echo(f"wrote {path}")


def _robot(
    urdf: Path | None, cell: Path | None, friction: str, standstill: float, fixed: list[str] | None
) -> Robot:
    if (urdf is None) == (cell is None):
        raise InputError(
            None, "whose recording is it?", field="--urdf", remedy="give --urdf or --cell"
        )
    if cell is not None:
        return Robot.from_cell(cell, fixed_joints=fixed or ())
    assert urdf is not None
    return Robot.from_urdf(urdf, friction=_law(friction, standstill), fixed_joints=fixed or ())


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
    return FrictionLaw(
        coulomb="coulomb" in wanted,
        viscous="viscous" in wanted,
        third="quadratic" if "quadratic" in wanted else "cubic" if "cubic" in wanted else None,
        offset="offset" in wanted,
        standstill=standstill,
    )
