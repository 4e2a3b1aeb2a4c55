"""Reading a controller's init packet: every packet is answered safely, and nothing can move."""

from __future__ import annotations

import time

import numpy as np

from drivers.drive_train import DriveTrain
from drivers.errors import DriverError
from drivers.exchange import ExchangeProcess, ExchangeSettings
from drivers.guard import GuardLimits
from drivers.packets import InitPacket
from drivers.transports.base import TransportSpec
from hil.campaign import Stop
from hil.campaign.exchange_view import ExchangeView
from hil.campaign.motion_link import END_TIMEOUT
from hil.errors import ControllerFault, OperatorStopError

_POLL = 0.05
_PLACEHOLDER_PERIOD = 0.002


def read_init(
    spec: TransportSpec, n_joints: int, *, arm: int, wait: float, stop: Stop
) -> InitPacket:
    """Wait for a controller to begin a session, take its init packet and leave.

    The process that answers has no arm: a drive train of ones, which no controller announces,
    so that its session is unusable for motion, and no archive, without which none is accepted.
    After the init packet answers go on until the axes are closed.

    Args:
        spec: the link.
        n_joints: axes that are expected.
        arm: of the controller, from 1.
        wait: s that the controller is waited for.
        stop: ends the waiting.

    Raises:
        ControllerFault: the link cannot be opened, or no controller began a session in time.
        OperatorStopError: stopped before it did.
    """
    try:
        exchange = ExchangeProcess.start(_nothing_moves(spec, n_joints, arm))
    except (DriverError, OSError) as error:
        raise ControllerFault(f"the controller cannot be listened to: {error}") from error
    try:
        return _waited_for(ExchangeView(exchange), wait, stop)
    finally:
        exchange.finish()
        exchange.wait(END_TIMEOUT)
        exchange.close()


def _waited_for(view: ExchangeView, wait: float, stop: Stop) -> InitPacket:
    deadline = time.monotonic() + wait
    while view.connection.init is None:
        view.exchange.beat()
        view.look()
        if (failure := view.failure()) is not None:
            raise ControllerFault(failure)
        if stop.requested:
            raise OperatorStopError("ended before the controller came; no file was written.")
        if time.monotonic() > deadline:
            heard = view.status.answered or view.status.malformed or view.status.stale
            raise ControllerFault(
                f"no init packet came within {wait:g} s"
                + (", though packets did: a session was running already" if heard else "")
                + (f"; {view.not_understood}" if view.not_understood else "")
                + "; start this command first, then the controller's Open program"
                + (
                    f" ({view.status.foreign} packets came from elsewhere)"
                    * bool(view.status.foreign)
                )
            )
        time.sleep(_POLL)
    return view.connection.init


def _nothing_moves(spec: TransportSpec, n_joints: int, arm: int) -> ExchangeSettings:
    ones, zeros = np.ones(n_joints), np.zeros(n_joints)
    return ExchangeSettings(
        transport=spec,
        drive_train=DriveTrain(
            gear_ratio=ones, calibration=zeros, k54=0.0, k64=0.0, k65=0.0,
            joint_sign=ones, joint_offset=zeros, torque_constant=ones, current_limit=ones,
        ),
        guard_limits=GuardLimits(
            lower=-ones, upper=ones, velocity=ones, acceleration=ones, jerk=ones,
            following_error=ones, current=ones,
        ),
        period=_PLACEHOLDER_PERIOD,
        session={"arm": arm},
    )  # fmt: skip
