"""The simulated Universal Robots controller and arm of a cell file, served on its ports."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from drivers.transports.simulated import SimulatedTransport
from drivers.ur.description import UrDescription
from drivers.ur.identity import MODELS, REQUESTS, ArmIdentity, with_replies, with_state
from drivers.ur.outputs import N_JOINTS
from drivers.ur.registers import INPUTS
from drivers.ur.rtde import ControllerVersion, OutputRecipe
from drivers.ur.wire import OPTIONAL, REQUIRED
from hil.base.errors import InputError
from hil.cell import Cell
from hil.control.planted_arm import planted_truth, unmodelled_effects
from hil.control.virtual_link import VirtualLink
from sim_fixtures.settings import SettingError, SimulationError
from sim_fixtures.ur import (
    SimulatedUr,
    UrArmTruth,
    UrFault,
    UrProgram,
    UrServer,
    UrSettings,
    wire,
)
from sim_fixtures.ur.controller import UrPayload, parse_ur_fault
from sim_fixtures.ur.server import PRIMARY_PORT, REALTIME_PORT, dashboard_reply, state_of

_CB3_VERSION = (3, 15, 8, 0)
_USED_RANGE_SHARE = 0.9
"""Share of the distance to the limits that the program's motion uses."""


class UrPeer:
    """A simulated controller and arm as the peer of a session, in virtual time.

    The first packet is what the controller states of itself; then each cycle is a frame of its
    outputs, and the reply a frame of inputs with, at times, a program behind it. All bytes of both
    directions are the same as on a real link.
    """

    def __init__(self, controller: SimulatedUr) -> None:
        self.controller = controller
        self.ended = False
        self._introduced = False
        self._data = wire.DataPackages(1, (*REQUIRED, *OPTIONAL))
        self._inputs = wire.InputRecipe(1, INPUTS)

    @property
    def period(self) -> float:
        """Cycle [s]."""
        return self.controller.period

    def finish(self) -> None:
        """End the session, as its operator would."""
        self.ended = True

    def next_packet(self) -> bytes | None:
        """See `drivers.transports.simulated.Peer`."""
        controller = self.controller
        if not self._introduced:
            self._introduced = True
            return self._introduction()
        if self.ended:
            return None
        controller.step()
        controller.said.clear()
        return self._data.package(controller.outputs())

    def accept(self, reply: bytes | None) -> None:
        """See `drivers.transports.simulated.Peer`."""
        if not reply:
            return
        received = bytearray(reply)
        length = int.from_bytes(received[:2], "big")
        program = bytes(received[length:])
        frame = bytearray(received[:length])
        for kind, payload in wire.packages(frame):
            if kind == "U":
                self.controller.write_inputs(self._inputs.values(payload))
        if program:
            self.controller.upload(program.decode())

    def _introduction(self) -> bytes:
        settings = self.controller.settings
        identity = with_state(ArmIdentity(), state_of(settings)[5:])
        identity = with_replies(
            identity, {name: dashboard_reply(self.controller, name) for name in REQUESTS}
        )
        names = (*REQUIRED, *OPTIONAL)
        recipe = OutputRecipe(1, names, tuple(wire.TYPES[name] for name in names))
        version = ControllerVersion(*settings.version)
        return UrDescription(identity, version, settings.frequency, recipe, 1).encode()


def ur_link(cell: Cell, *, session: int = 0, effects: bool = False) -> VirtualLink:
    """Return a link in virtual time to the simulated controller and arm of a cell."""
    peer = UrPeer(simulated_ur(cell, session=session, effects=effects))
    return VirtualLink.over(SimulatedTransport(peer), cell, finish=peer.finish)


def simulated_ur(
    cell: Cell,
    *,
    faults: Sequence[UrFault] = (),
    seed: int | None = None,
    session: int = 0,
    truth: UrArmTruth | None = None,
    effects: bool = False,
) -> SimulatedUr:
    """Return controller and arm of a cell, at rest at its initial posture.

    Args:
        cell: with the true parameters in `[simulation]`.
        faults: of the controller.
        seed: of the noise, that of the cell by default.
        session: number of earlier sessions; each has noise of its own.
        truth: true parameters of the arm; default: the cell's.
        effects: whether to simulate unmodelled effects, with the sizes of the cell.
    """
    return SimulatedUr(
        replace(_settings(cell), remote_control=True, payload=_payload(cell)),
        at=cell.initial,
        truth=truth or arm_truth(cell),
        faults=faults,
        seed=(cell.simulation.seed if seed is None else seed) + 1000 * session,
        urdf=cell.urdf,
        effects=unmodelled_effects(cell) if effects else None,
    )


def _payload(cell: Cell) -> UrPayload:
    """Return the payload of the cell as it is entered at the controller."""
    expected = cell.expected_arm
    return UrPayload(expected.payload, expected.centre or (0.0, 0.0, 0.0))


def served_arm(
    cell: Cell,
    *,
    own_speed: float | None = None,
    faults: Sequence[str] = (),
    seed: int | None = None,
    cycle_extension: float = 0.0,
) -> UrServer:
    """Return a server of the arm of a cell at its address; it listens already.

    Args:
        cell: with the true parameters in `[simulation]`, and transport "rtde".
        own_speed: share of the velocity limits at which its own program moves it; None for rest.
        faults: KIND@CYCLE[xCOUNT], see `UrFault`.
        seed: of the noise, that of the cell by default.
        cycle_extension: longest extension of a cycle to wait for a set-point [s].

    Raises:
        InputError: another number of joints, an invalid fault, or a port that cannot be opened.
    """
    if len(cell.joint_names) != N_JOINTS:
        problem = f"has {len(cell.joint_names)} joints; an arm on RTDE has {N_JOINTS}"
        raise cell.error("cell.urdf", cell.file.cell.urdf, problem, "give a cell of six joints")
    table = cell.controller
    try:
        settings = replace(_settings(cell), payload=_payload(cell))
        robot = SimulatedUr(
            # An arm that runs its own program is one that its operator works with.
            replace(settings, remote_control=own_speed is None),
            _program(cell, own_speed),
            at=cell.initial,
            truth=arm_truth(cell),
            faults=[parse_ur_fault(text) for text in faults],
            seed=cell.simulation.seed if seed is None else seed,
            repeats=True,
            urdf=cell.urdf,
        )
        return UrServer(
            robot,
            table.host,
            rtde=table.rtde.port,
            primary=table.rtde.primary_port,
            dashboard=table.rtde.dashboard_port,
            # At the maker's ports programs of others find it, which send theirs to this one.
            realtime=REALTIME_PORT if table.rtde.primary_port == PRIMARY_PORT else None,
            cycle_extension=cycle_extension,
        )
    except (SettingError, SimulationError) as error:
        raise InputError(None, str(error)) from error


def _settings(cell: Cell) -> UrSettings:
    table = cell.controller.rtde
    base = table.model.removesuffix("e")
    kind = next((number for number, name in MODELS.items() if name == base), 1)
    default = UrSettings()
    return UrSettings(
        version=_CB3_VERSION if cell.controller.cycle_ms == round(1e3 / 125) else default.version,
        serial_number=cell.file.cell.serial_number or default.serial_number,
        model=base or default.model,
        kind=kind,
    )


def arm_truth(cell: Cell, *, exact: bool = False) -> UrArmTruth:
    """Return the planted arm: its torque constants differ from the cell's as a UR5e's do.

    With `exact` it has the torque constants of the cell.
    """
    default = UrArmTruth()
    drives = cell.drive_train
    stated = drives.torque_constant * np.abs(np.diag(drives.motor_from_joint))
    factor = default.torque_constant / default.stated_constant
    if exact:
        factor = np.ones(N_JOINTS)
    nominal = cell.nominal
    return UrArmTruth(
        plant=planted_truth(cell),
        torque_constant=stated * factor,
        stated_constant=stated,
        coulomb=np.array(nominal.coulomb),
        viscous=np.array(nominal.viscous),
        quadratic=np.zeros(N_JOINTS),
        current_noise=cell.simulation.current_noise,
    )


def _program(cell: Cell, own_speed: float | None) -> UrProgram | None:
    """Return a motion about the initial posture, within limits and a share of the speeds."""
    if own_speed is None:
        return None
    limits = cell.joint_limits
    pattern = UrProgram()
    order = np.arange(1, pattern.amplitude.shape[1] + 1)
    reach = np.abs(pattern.amplitude).sum(axis=1)
    speed = np.abs(pattern.amplitude) @ (2.0 * np.pi / pattern.period * order)
    room = np.minimum(limits.upper - cell.initial, cell.initial - limits.lower)
    factor = np.minimum(own_speed * limits.velocity / speed, _USED_RANGE_SHARE * room / reach)
    return UrProgram(cell.initial, pattern.amplitude * np.clip(factor, 0.0, None)[:, None])
