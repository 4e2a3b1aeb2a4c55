"""A controller's side of a session, as far as packets show it, that can be told to misbehave."""

from __future__ import annotations

import numpy as np

from tests.drivers import oracle
from tests.drivers.judge import POSITION_MODES


class Controller:
    """Status, modes and axis data of the packets to come.

    Args:
        train: of the arm.
        start: where it stands at first.
        arm: its number, from 1.
        n_axes: slots of a packet.
        slots: slot of each joint.
    """

    def __init__(self, train, start, *, arm: int, n_axes: int, slots) -> None:
        self._train = train
        self._arm, self._n_axes, self._slots = arm, n_axes, slots
        self.number = 0
        self.status = [0, 0, 0, 0]
        self.status[arm - 1] = oracle.DRIVE_ON
        self.modes = [0] * n_axes
        self.d = np.zeros((n_axes, 8), np.float32)
        self.put_arm_at(start)
        self.exit_asked = False

    def put_arm_at(self, q) -> None:
        motor = self._train.motor_revolutions(q)
        for slot, value in zip(self._slots, motor, strict=True):
            self.d[slot, [0, 2]] = value
            self.d[slot, [1, 3, 4]] = 0.0, 0.0, 0.5

    def wanted(self, mode: int) -> None:
        """All axes of the arm in a mode."""
        for slot in self._slots:
            self.modes[slot] = mode

    def packet(self) -> bytes:
        self.number = oracle.answer_number(self.number)
        axes = tuple(
            oracle.Axis(mode, tuple(bytes(word) for word in row.view("V4")))
            for mode, row in zip(self.modes, self.d, strict=True)
        )
        return oracle.build(oracle.Packet(self.number, bytes(self.status), bytes(4), axes))

    def obey(self, reply: bytes, mode: int) -> None:
        """Go where the answer says; close the axes if it asks for that."""
        answer = oracle.parse(reply, self._n_axes)
        refused = any(axis.mode in (505, 508) for axis in answer.axes)
        if refused or answer.status[self._arm - 1] == 1:
            self.wanted(0)
            self.d[:, [1, 3]] = 0.0
        elif mode in POSITION_MODES:
            for slot in self._slots:
                if self.modes[slot] == mode:
                    position, step = answer.axes[slot].floats[:2]
                    self.d[slot, :4] = position, step, position, step
