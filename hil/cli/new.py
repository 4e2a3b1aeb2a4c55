"""`hil new`: write a commented cell file for an arm."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated, Literal

import typer

from drivers.transports.udp import UdpSpec
from drivers.ur.transport import RtdeSpec
from hil.base.errors import InputError
from hil.base.files import convert_write_errors, write_atomically
from hil.base.one_screen import wrapped
from hil.base.progress import say
from hil.base.safe_input import parse_port
from hil.base.terminal_text import typed
from hil.cell.schema import LINKS, RtdeTable
from hil.cli.arguments import (
    ARM,
    ConventionOption,
    DhOption,
    JsonOption,
    at_most_one,
    exactly_one,
    figures,
    print_json,
)
from hil.control.motion_watch import stop_on_interrupt
from hil.importers.dh import convention_of
from hil.new import (
    CellValues,
    NewCell,
    ask_arm,
    cell_of_arm,
    cell_of_dh,
    cell_of_urdf,
    from_archive,
    from_init,
    read_init,
)
from hil.new.messages import note_lines

PORT = 1000
"""Default UDP port of C4G Open."""


def new(
    urdf: Annotated[Path | None, typer.Option(rich_help_panel=ARM)] = None,
    dh: DhOption = None,
    convention: ConventionOption = None,
    output: Annotated[Path, typer.Option("--output", "-o")] = Path("cell.toml"),
    from_controller: Annotated[str | None, typer.Option(metavar="HOST[:PORT]")] = None,
    from_archive_file: Annotated[
        Path | None, typer.Option("--from-archive", metavar="ARCHIVE")
    ] = None,
    controller: Annotated[Literal["ur"] | None, typer.Option(metavar="ur")] = None,
    host: Annotated[str | None, typer.Option(metavar="HOST[:PORT]")] = None,
    bind: str = "0.0.0.0",
    arm: Annotated[int, typer.Option(min=1, max=4)] = 1,
    wait: Annotated[float, typer.Option(min=0.0)] = 300.0,
    base: Annotated[str | None, typer.Option(metavar="LINK")] = None,
    tip: Annotated[str | None, typer.Option(metavar="LINK")] = None,
    fix: Annotated[list[str] | None, typer.Option(metavar="JOINT[=POSITION]")] = None,
    design_only: bool = False,
    force: bool = False,
    json: JsonOption = False,
) -> None:
    """Write a commented cell file for an arm, with "?" for each unknown value.

    Limits come from the URDF if it states them. With --from-controller this PC waits for the Open
    program of the controller, replies without moving anything and reads the init packet: start this
    command first, then that program. With --from-archive the values come from an archive. A file
    with a "?" is refused with a list of all unknown values and where to find each of them. For an
    arm with known Denavit-Hartenberg parameters and no URDF use --dh.

    With --controller ur --host HOST, a Universal Robots arm gives its type, serial number,
    calibration, limits, payload and torque constants; nothing moves, and hil takes no control.
    Without --urdf its own kinematics are used, without masses.

    **Examples:** `hil new --urdf robot.urdf --from-controller 10.2.12.150 -o cell.toml`, `hil new
    --dh table.csv --convention modified -o cell.toml`, `hil new --design-only --urdf robot.urdf -o
    cell.toml`

    Options:
        urdf: URDF of the arm.
        output: The cell file to write.
        from_controller: Read drive train, limits and cycle from the init packet of the controller
            at HOST; this PC listens on PORT (1000).
        from_archive_file: Read the cell and the init packet of an archive of this arm.
        controller: Ask an arm for its values: ur (Universal Robots, over RTDE).
        host: Address of that arm; its RTDE port is 30004.
        bind: Local address to listen on; 0.0.0.0 for all.
        arm: Arm number of the controller.
        wait: Time to wait for the controller, s.
        base: Link from which the arm starts, of a robot with several arms; joints outside it are
            fixed. Default: the root of the URDF.
        tip: Last link of the arm, such as the flange before a gripper. Default: all ends.
        fix: Joint to fix, at a position in rad or m (default 0; repeatable). Prismatic joints are
            fixed, except along gravity in a cell for recordings.
        design_only: For an arm moved by another controller: no drive train and no link; values that
            a design needs beyond the URDF are assumed and listed.
        force: Replace an earlier file.
    """
    if controller is None or (urdf and dh):
        remedy = "add --urdf arm.urdf, or --dh table.csv with --convention"
        exactly_one("there is no description of the arm", remedy, urdf=urdf, dh=dh)
    at_most_one(
        design_only=design_only, from_controller=from_controller,
        from_archive=from_archive_file, controller=controller,
    )  # fmt: skip
    if urdf is None and (base or tip):
        problem = "are links of a URDF"
        remedy = "omit them with --dh"
        raise InputError(None, problem, field="--base and --tip", remedy=remedy)
    _require_free(output, force=force)
    fixed = figures(fix or [], "--fix", "--fix finger=0.02 (rad or m)")
    described: NewCell | None = None
    if urdf is not None:
        sources = (from_controller, from_archive_file, controller)
        moved = design_only or any(source is not None for source in sources)
        described = cell_of_urdf(urdf, fixed, base=base, tip=tip, moved=moved)
    elif dh is not None:
        described = cell_of_dh(dh, convention_of(convention), fixed)
    made = _of_arm(host, described) if controller is not None else described
    assert made is not None, "one of --urdf and --dh is given"
    if made.urdf is not None:
        _require_free(made.urdf_beside(output), force=force, urdf_read=made.urdf_path)
    values = made.values
    if from_controller is not None:
        values |= _asked(from_controller, bind, len(made.joint_names), arm, wait, quiet=json)
    if from_archive_file is not None:
        stated = from_archive(from_archive_file, made.joint_names)
        # Limits belong together, with their frame.
        values = (values.without("limits") if "limits.frame" in stated.values else values) | stated
    made = replace(made, values=values)
    made = made.for_design() if design_only else made
    text, unknown = made.text(output)
    notes = note_lines(made.values.notes)
    with convert_write_errors(output):
        output.parent.mkdir(parents=True, exist_ok=True)
        if made.urdf is not None:
            write_atomically(made.urdf_beside(output), made.urdf)
        write_atomically(output, text)
    if json:
        summary = {"joints": made.joint_names, "unknown": unknown, "notes": notes}
        print_json({"cell": str(output), **summary})
        return
    for note in notes:
        say(wrapped(f"note: {note}"))
    say(wrapped(f"{output}: {len(made.joint_names)} joints ({', '.join(made.joint_names)})"))
    if unknown:
        say(wrapped(f'unknown, marked "?": {", ".join(unknown)}'))
        after = "design" if design_only else "doctor"
        say(f"fill them in, then `hil {after} {typed(output)}`, which lists what is still missing")
    elif controller is not None:
        say(f"check it, above all what is assumed, then `hil record {typed(output)} -o archives`")
    elif made.lifting:
        say(f"then `hil import log LOG --cell {typed(output)} --map MAP.toml`")
    elif design_only:
        say(f"check the assumed values in it, then `hil design {typed(output)}`")


def _of_arm(address: str | None, described: NewCell | None) -> NewCell:
    """Return the cell of the Universal Robots arm at HOST[:PORT]."""
    fields = None if address is None else LINKS["rtde"].parse(address)
    if fields is None:
        problem = "is missing" if address is None else f"{address!r} is not HOST or HOST:PORT"
        raise InputError(None, problem, field="--host", remedy="e.g. --host 192.168.0.10")
    ports = RtdeTable(**fields["rtde"])
    arm = ask_arm(
        RtdeSpec(fields["host"], ports.port),
        ports,
        waits=lambda most: say(
            f"the arm moves: waiting up to {most:g} s for a second at rest", err=True
        ),
    )
    return cell_of_arm(arm, described)


def _asked(
    address: str, bind: str, n_joints: int, arm: int, wait: float, *, quiet: bool
) -> CellValues:
    """Read the init packet of the controller at HOST[:PORT]."""
    host, _, port_text = address.partition(":")
    port = parse_port(port_text or str(PORT))
    if not host or port is None:
        remedy = "e.g. 10.2.12.150:1000"
        raise InputError(None, f"{address!r} is not HOST or HOST:PORT", remedy=remedy)
    if not quiet:
        say(
            f"listening on {bind}:{port} for {wait:g} s, Ctrl-C to stop; nothing moves.\n"
            f"Now start the Open program of the controller at {host}"
        )
    with stop_on_interrupt() as stop:
        init = read_init(UdpSpec(host, port, bind), n_joints, arm=arm, wait=wait, stop=stop)
    link = {"controller.transport": "udp", "controller.host": host, "controller.port": port}
    if bind != "0.0.0.0":
        link["controller.bind"] = bind
    return from_init(init, n_joints, arm) | CellValues.of_origin("as given to hil new", link)


def _require_free(path: Path, *, force: bool, urdf_read: Path | None = None) -> None:
    """Refuse to replace a file without --force, and the URDF that is read."""
    if urdf_read is not None and path.resolve() == urdf_read.resolve():
        problem = "is the URDF to read"
        raise InputError(path, problem, remedy="choose another --output")
    if path.exists() and not force:
        raise InputError(path, "exists already", remedy="choose another --output, or add --force")
