"""The other end of a session, as the controller's init packet describes it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from drivers.drive_train import ArmWire, DriveTrain
from drivers.errors import PacketError
from drivers.events import InitReceived
from drivers.guard import Guard
from drivers.init_check import verify_controller
from drivers.open_mode import SetPointGenerator
from drivers.packets import InitPacket, OpenAxis
from drivers.safe_reply import PacketClassifier, ReplyBuilder


@dataclass(frozen=True, eq=False)
class Controller:
    """The other end of one session, as its init packet describes it.

    Attributes:
        init: the init packet.
        received: its comparison with the cell; says why the arm cannot be moved, if it cannot.
        classifier: of the packets.
        builder: of the replies.
        wire: joints and slots; None if the arm cannot be moved.
        open_mode: replies in open mode; None likewise.
    """

    init: InitPacket
    received: InitReceived
    classifier: PacketClassifier
    builder: ReplyBuilder
    wire: ArmWire | None
    open_mode: SetPointGenerator | None


def connect(
    init: InitPacket,
    *,
    drive_train: DriveTrain,
    guard: Guard,
    arm: int,
    mode: int,
    other_axes: frozenset[tuple[int, int]],
    max_gap: int,
    only_axis: int | None,
) -> Controller:
    """Return the controller that sent an init packet; the others are arguments of `Session`.

    The guard is narrowed to the controller's own limits on following error and current.
    """
    received = verify_controller(drive_train, guard.period, init, arm, other_axes)
    axes: Sequence[OpenAxis] | None
    try:
        axes = init.open_axes()
    except PacketError:
        axes = None
    arms = None if axes is None else tuple(axis.arm for axis in axes)
    builder = ReplyBuilder(init.n_axes, arm, axes or ())
    if received.unusable is not None:
        # Any axis of the arm that is open; any axis at all if the map is invalid.
        slots = range(init.n_axes) if axes is None else [a.slot for a in axes if a.arm == arm]
        classifier = PacketClassifier(np.array(slots, np.intp), arms, arm, mode)
        return Controller(init, received, classifier, builder, None, None)
    wire = ArmWire(drive_train, init, arm, only_axis)
    classifier = PacketClassifier(wire.joint_slots, arms, arm, mode, wire.opened)
    open_mode = SetPointGenerator(guard, wire, builder, mode, max_gap)
    joints = slice(0, drive_train.n_joints)
    guard.narrow(
        init.following_error[arm - 1, joints].astype(np.float64),
        np.fmin(init.current_limit[arm - 1, joints], drive_train.current_limit),
    )
    return Controller(init, received, classifier, builder, wire, open_mode)
