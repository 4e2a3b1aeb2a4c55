"""`hil import`: convert recordings of other formats to archives."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from hil.base.errors import InputError, SourceError
from hil.base.files import write_output
from hil.base.progress import say
from hil.base.terminal_text import printable
from hil.cell.arms import Links
from hil.cli.arguments import (
    ARM,
    CHANNELS,
    ConventionOption,
    DhOption,
    JsonOption,
    at_most_one,
    exactly_one,
    figures,
    print_json,
    with_options,
)
from hil.importers.bag_map import BagMap
from hil.importers.channels import CHANNEL_NAMES
from hil.importers.column_map import ready_map, ready_maps
from hil.importers.dh import convention_of
from hil.importers.imported_robot import Robot
from hil.importers.lerobot import EpisodeUnit
from hil.importers.messages import sentence
from hil.importers.recording_content import Use
from hil.importers.recording_import import (
    ImportedRecording,
    ImportOptions,
    import_recording,
)
from hil.importers.rosbag2 import CommandStamps, Effort
from hil.look.before_identification import Asking
from hil.pipeline.options import friction_from
from identification.model.friction import FrictionLaw
from identification.model.kinematics import MAX_MOVING_JOINTS
from identification.model.robot import STANDARD_GRAVITY

app = typer.Typer(
    help="Convert recordings of other formats to archives that `hil identify` reads.",
    no_args_is_help=True,
)

Source = Annotated[Path, typer.Argument(help="The recording.")]
Output = Annotated[Path, typer.Option("--output", "-o", help="The archive to write (*.mcap).")]
Held = Annotated[
    list[str] | None,
    typer.Option(help="Joint that did not move during the recording (repeatable)."),
]
Kind = Annotated[
    Use,
    typer.Option(
        metavar="USE", help="excitation (fitted), validation (predicted) or standstill (noise)."
    ),
]
ForceOption = Annotated[
    bool, typer.Option("--force", help="Replace an archive that exists already.")
]
OutsideOption = Annotated[
    bool,
    typer.Option(
        "--outside-limits",
        help="Accept positions outside the limits of the URDF.",
        rich_help_panel=CHANNELS,
    ),
]


@dataclass(frozen=True)
class Described:
    """Options that describe the robot of a recording."""

    urdf: Annotated[Path | None, typer.Option(help="URDF of the robot.", rich_help_panel=ARM)] = (
        None
    )
    cell: Annotated[
        Path | None,
        typer.Option(help="Cell file, in place of --urdf and --friction.", rich_help_panel=ARM),
    ] = None
    dh: DhOption = None
    convention: ConventionOption = None
    gravity: Annotated[
        tuple[float, float, float] | None,
        typer.Option(
            metavar="X Y Z",
            help="Gravity in the base frame, m/s²: 0 0 9.81 upside down, 0 0 0 for torques without "
            "it. Default: as in the cell.",
            rich_help_panel=ARM,
        ),
    ] = None
    friction: Annotated[
        str,
        typer.Option(
            metavar="TERMS", help="Friction law, terms separated by commas.", rich_help_panel=ARM
        ),
    ] = "coulomb,viscous,offset"
    standstill_speed: Annotated[
        float,
        typer.Option(
            metavar="RAD/S",
            min=0.0,
            help="Joint speed below which rows are not fitted, rad/s.",
            rich_help_panel=ARM,
        ),
    ] = 0.01
    locked: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME[=POSITION]",
            help="Joint that was not recorded, at 0 or a position (repeatable).",
            rich_help_panel=ARM,
        ),
    ] = None
    lock_others: Annotated[
        bool,
        typer.Option(
            help="Fix and list all joints that were not recorded.",
            rich_help_panel=ARM,
        ),
    ] = False

    base: Annotated[
        str | None,
        typer.Option(
            metavar="LINK",
            help="First link of the recorded arm, of a robot with several.",
            rich_help_panel=ARM,
        ),
    ] = None
    tip: Annotated[
        str | None,
        typer.Option(metavar="LINK", help="Last link of the recorded arm.", rich_help_panel=ARM),
    ] = None

    @property
    def is_given(self) -> bool:
        """Whether an option names a description of the robot."""
        return any((self.urdf, self.cell, self.dh))

    def robot(self, recorded: Callable[[], tuple[str, ...] | None]) -> Robot:
        """Return the robot of a cell file, URDF or DH table; `recorded` reads the joint names."""
        exactly_one(
            "there is no description of the robot",
            "add --urdf arm.urdf, --cell cell.toml, or --dh table.csv with --convention",
            urdf=self.urdf,
            cell=self.cell,
            dh=self.dh,
        )
        law = FrictionLaw.from_table(
            {**friction_from(self.friction), "standstill": self.standstill_speed}
        )
        at = figures(self.locked or [], "--locked", "--locked joint_7=0.3 (rad or m)")
        joints = recorded() if self.lock_others else None
        links = Links(base=self.base, tip=self.tip)
        if self.cell is not None:
            return Robot.from_cell(
                self.cell, gravity=self.gravity, locked=at, recorded=joints, links=links
            )
        path = self.urdf or self.dh
        assert path is not None
        return Robot.from_urdf(
            path,
            convention=None if self.dh is None else convention_of(self.convention),
            friction=law,
            gravity=self.gravity or STANDARD_GRAVITY,
            locked=at,
            recorded=joints,
            links=links,
        )


RARE = (
    "command_topic",
    "commands",
    "calibration",
    "units",
    "outside_limits",
    "drop_missing",
)
"""Options of `Reading` that are entries of a map; `hil look` and `hil import` list them."""


@dataclass(frozen=True)
class Reading:
    """Options that state what the channels of a recording are, where that cannot be inferred."""

    columns: Annotated[
        Path | None,
        typer.Option(
            "--map",
            help="Column map: a TOML file (`hil look -o` writes one), or the name of a ready one "
            "(`hil import maps`). Default: inferred.",
            rich_help_panel=CHANNELS,
        ),
    ] = None
    channels: Annotated[
        list[str] | None,
        typer.Option(
            "--columns",
            metavar="QUANTITY=NAME",
            help="Channels of a quantity, such as torque=tau{} with {} for the joint, or "
            "torque=a,b, with *FACTOR after them (repeatable).",
            rich_help_panel=CHANNELS,
        ),
    ] = None
    sample_rate: Annotated[
        float | None,
        typer.Option(
            metavar="HZ",
            help="Sampling rate of a log without a time.",
            rich_help_panel=CHANNELS,
        ),
    ] = None
    topic: Annotated[
        str | None,
        typer.Option(
            help="Topic of the joint states, of a bag with several.",
            rich_help_panel=CHANNELS,
        ),
    ] = None
    command_topic: Annotated[
        str | None,
        typer.Option(
            metavar="TOPIC",
            help="Topic of the commanded positions of a bag, or none. Default: the topic that "
            "the positions follow.",
            rich_help_panel=CHANNELS,
        ),
    ] = None
    rename: Annotated[
        list[str] | None,
        typer.Option(
            metavar="RECORDED=URDF",
            help="Joints of a bag under their URDF names (repeatable), such as "
            "fer_joint{}=panda_joint{}.",
            rich_help_panel=CHANNELS,
        ),
    ] = None
    commands: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="File with the commanded positions of a log.",
            rich_help_panel=CHANNELS,
        ),
    ] = None
    calibration: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="LeRobot's calibration of a data set (JSON).",
            rich_help_panel=CHANNELS,
        ),
    ] = None
    units: Annotated[
        EpisodeUnit | None,
        typer.Option(
            metavar="UNIT",
            help="Unit of a LeRobot data set: deg, rad, or range for -100 to 100.",
            rich_help_panel=CHANNELS,
        ),
    ] = None
    outside_limits: OutsideOption = False
    drop_missing: Annotated[
        bool,
        typer.Option(
            "--drop-missing",
            help="Drop rows of a log in which a number is missing.",
            rich_help_panel=CHANNELS,
        ),
    ] = False

    @property
    def options(self) -> ImportOptions:
        """How recordings are read; InputError for an option that is not understood."""
        at_most_one(map=self.columns, columns=self.channels)
        at_most_one(map=self.columns, sample_rate=self.sample_rate)
        if self.columns is not None and self.drop_missing:
            remedy = 'write [format] missing = "drop" into the map'
            problem = "is for logs without a map"
            raise InputError(None, problem, field="--drop-missing", remedy=remedy)
        if self.sample_rate is not None and not 0.0 < self.sample_rate < math.inf:
            remedy = "give a rate above 0 Hz"
            raise InputError(None, "is not a rate", field="--sample-rate", remedy=remedy)
        return ImportOptions(
            self.columns,
            _chosen(self.channels or []),
            self.sample_rate,
            self.topic,
            _names(self.rename or []),
            self.outside_limits,
            self.drop_missing,
            self.command_topic,
            self.commands,
            self.calibration,
            self.units,
        )

    def refuse_without_robot(self) -> None:
        """Raise InputError if an option is given that archives do not need."""
        given = {
            "--map": self.columns,
            "--columns": self.channels,
            "--sample-rate": self.sample_rate,
            "--topic": self.topic,
            "--command-topic": self.command_topic,
            "--rename": self.rename,
            "--commands": self.commands,
            "--calibration": self.calibration,
            "--units": self.units,
            "--outside-limits": self.outside_limits,
            "--drop-missing": self.drop_missing,
        }
        for option, value in given.items():
            if value:
                problem = "is for logs and bags, which need the description of their arm"
                raise InputError(None, problem, field=option, remedy="add --urdf ARM.urdf")


@app.command("rosbag2")
@with_options(Described, "arm")
def rosbag2(
    source: Source,
    output: Output,
    *,
    arm: Described,
    topic: str | None = None,
    effort: Annotated[Effort, typer.Option(metavar="QUANTITY")] = "torque",
    clock: Annotated[CommandStamps, typer.Option(metavar="STAMPS")] = "auto",
    command_topic: Annotated[str | None, typer.Option(metavar="TOPIC")] = None,
    rename: Annotated[list[str] | None, typer.Option(metavar="RECORDED=URDF")] = None,
    held: Held = None,
    kind: Kind = "excitation",
    force: ForceOption = False,
    outside_limits: OutsideOption = False,
    json: JsonOption = False,
) -> None:
    """Import sensor_msgs/JointState messages from a bag of ROS 1 or 2, or an MCAP file.

    The source is a bag folder or its .db3, .mcap or .bag file, compressed or not. Joints are
    matched by name. For MCAP files with other message types use `hil import log` with a column map.
    Joints of the URDF that were not recorded are fixed if they are of a gripper or of another arm;
    others with --locked or --lock-others.

    **Example:** `hil import rosbag2 bag --urdf arm.urdf --lock-others --gravity 0 0 9.81 -o a.mcap`

    Options:
        topic: Topic of the joint states; needed if the bag has several.
        effort: Content of the effort field: torque, motor_current or ignore.
        clock: Stamps to use: header (of the messages), bag (time of receipt) or auto.
        command_topic: Topic of the commanded positions, or none; by default the state of a
            controller, else a topic of commands that the positions follow.
        rename: Joint whose name in the bag differs from the URDF (repeatable); {} is its number:
            fer_joint{}=panda_joint{}.
    """
    names = _names(rename or [])
    options = ImportOptions(outside_limits=outside_limits)
    asking = Asking(source, arm.robot, options)
    recording = import_recording(
        source,
        output,
        arm.robot,
        options,
        bag=BagMap(
            topic=topic, effort=effort, clock=clock, command_topic=command_topic, rename=names
        ),
        held_joints=held or (),
        use=kind,
        force=force,
        asked=asking,
    )
    _print(recording, asking.refusal, json=json)


@with_options(Described, "arm")
@with_options(Reading, "reading")
def log(
    source: Source,
    output: Annotated[
        Path | None,
        typer.Option(
            "--output", "-o", help="The archive to write (*.mcap). Default: next to the log."
        ),
    ] = None,
    *,
    arm: Described,
    reading: Reading,
    held: Held = None,
    kind: Kind = "excitation",
    force: ForceOption = False,
    uncoupled: bool = False,
    json: JsonOption = False,
) -> None:
    """Import a numeric log: CSV, text matrices, .npz, .npy, .mat, MATLAB text or .mcap.

    A column map names columns or arrays, their units and sides: `docs/logs.md`. It can
    also name a separate file per quantity or per joint; the source is then a folder. Without --map
    it is inferred from the names and units of the channels, printed, and written next to the
    archive. Warnings report probable errors of the map, with the errors of both interpretations.

    **Example:** `hil import log log.csv --urdf arm.urdf -o log.mcap`, with `--map map.toml` of
    `[time] column = "t"`, `[position] columns = "q{}"`, `[torque] columns = "tau{}"`

    Options:
        uncoupled: Leave the inertia and friction of coupled motors out of the model, to measure
            what they contribute.
    """
    options = reading.options
    asking = Asking(source, arm.robot, options)
    recording = import_recording(
        source,
        output or source.with_suffix(".mcap"),
        arm.robot,
        options,
        held_joints=held or (),
        use=kind,
        coupled=not uncoupled,
        force=force,
        asked=asking,
    )
    proposed = not recording.is_stated and recording.text is not None
    if proposed:
        write_output(recording.archive.path.with_suffix(".map.toml"), recording.text or "")
    _print(recording, asking.refusal, json=json)
    if proposed and not json:
        say(f"wrote {recording.archive.path.with_suffix('.map.toml')}")


app.command("log")(log)


@app.command("maps")
def maps(
    name: Annotated[str | None, typer.Argument(help="The map to print.")] = None,
    json: JsonOption = False,
) -> None:
    """List the ready column maps of common logs, or print one as a start for another.

    **Example:** `hil import maps ur_rtde > map.toml`
    """
    purposes = ready_maps()
    if name is not None and name not in purposes:
        remedy = f"there are {', '.join(purposes)}"
        raise InputError(None, f"no ready map is called {name!r}", remedy=remedy)
    if json:
        print_json(purposes if name is None else {"name": name, "map": ready_map(name)})
    elif name is not None:
        typer.echo(ready_map(name), nl=False)
    else:
        for map_name, purpose in purposes.items():
            say(f"{map_name:<18} {purpose}")


def _print(recording: ImportedRecording, refusal: SourceError | None, *, json: bool) -> None:
    """Print what was inferred, what was found, and why an identification would refuse it."""
    found = [*map(sentence, recording.concluded), *map(sentence, recording.examined.found)]
    warnings = [*map(sentence, recording.examined.warnings)]
    warnings += [] if refusal is None else [str(refusal)]
    if json:
        print_json({"archive": str(recording.archive.path), "found": found, "warnings": warnings})
        return
    for line in found:
        say(line)
    for warning in warnings:
        typer.secho(printable(f"warning: {warning}"), fg=typer.colors.YELLOW)
    say(f"wrote {recording.archive.path}")


def _names(renamed: list[str]) -> dict[str, str]:
    """Parse RECORDED=URDF pairs; {} is a number in both."""
    names: dict[str, str] = {}
    for text in renamed:
        recorded, _, name = text.partition("=")
        if not (recorded and name) or recorded.count("{}") != name.count("{}"):
            problem = f"{text!r} is not a pair"
            remedy = "give RECORDED=URDF, or a {} for the number in both: fer_joint{}=panda_joint{}"
            raise InputError(None, problem, field="--rename", remedy=remedy)
        numbers = range(MAX_MOVING_JOINTS + 1) if "{}" in recorded else (0,)
        names |= {_numbered(recorded, k): _numbered(name, k) for k in numbers}
    return names


def _numbered(name: str, number: int) -> str:
    return name.replace("{}", str(number))


def _chosen(texts: Sequence[str]) -> dict[str, str]:
    """Parse QUANTITY=NAME pairs."""
    chosen = {}
    for text in texts:
        kind, _, name = text.partition("=")
        if kind not in CHANNEL_NAMES or not name.strip():
            remedy = f"give QUANTITY=NAME, with a quantity of {', '.join(CHANNEL_NAMES)}"
            raise InputError(None, f"{text!r} is not a pair", field="--columns", remedy=remedy)
        chosen[kind] = name.strip()
    return chosen
