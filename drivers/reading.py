"""What a cyclic packet says apart from its numbers: worked out once per change of modes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drivers.packets import DRIVE_ON
from drivers.replies import SafeAnswer, Words, safe_answer
from drivers.states import CLOSED_MODES, HOLDABLE, KNOWN_MODES, OPEN_MODES, Input, read_input


@dataclass(frozen=True, eq=False)
class Reading:
    """Status bytes and modes of a packet, understood.

    Attributes:
        input: what it is to the state machine.
        answer: the safe answer.
        status: status byte of the arm.
        modes: (n,) mode of each joint.
        ready: (n,) joints in the mode wanted; closed ones where they are to stay closed.
        held: (n,) joints in an open mode whose safe answer is the target received.
        powered: some wanted axis is in an open mode and the drive is on.
        any_open: some wanted axis is in an open mode.
        strayed: first joint in an open mode that is not wanted of it, or None.
        others: slots given back their target in an open mode that are no joint of the arm.
    """

    input: Input
    answer: SafeAnswer
    status: int
    modes: NDArray[np.int32]
    ready: NDArray[np.bool_]
    held: NDArray[np.bool_]
    powered: bool
    any_open: bool
    strayed: int | None
    others: tuple[int, ...]

    @property
    def faulty(self) -> tuple[int, int, bool]:
        """Joint, mode and whether that is known: the first unknown mode, else the first open."""
        known = np.isin(self.modes, list(KNOWN_MODES))
        joint = int(np.argmax(np.isin(self.modes, list(OPEN_MODES)) if known.all() else ~known))
        return joint, int(self.modes[joint]), bool(known.all())


class Reader:
    """Reads packets of one session; remembers the last, because modes rarely change.

    Args:
        slots: (n,) slot of each wanted axis; none if the arm has no open axis.
        arms: arm of each slot, from 1; None if unknown: any drive that is on counts.
        arm: the arm that is moved, from 1.
        mode: the open mode wanted.
        opened: (n,) which axes are to be open; None for all.
    """

    def __init__(
        self,
        slots: NDArray[np.intp],
        arms: tuple[int, ...] | None,
        arm: int,
        mode: int,
        opened: NDArray[np.bool_] | None = None,
    ) -> None:
        self._slots = slots
        self._opened = np.ones(len(slots), dtype=np.bool_) if opened is None else opened
        self._arms = arms
        self._arm = arm
        self._mode = mode
        self._key: tuple[bytes, bytes] | None = None
        self._last: Reading | None = None

    def read(self, status: bytes, modes: Words) -> Reading:
        """Understand 4 status bytes and the modes of all slots."""
        key = (status, modes.tobytes())
        if self._last is None or key != self._key:
            self._key = key
            self._last = self._understand(status, modes.copy())
        return self._last

    def _understand(self, status: bytes, modes: Words) -> Reading:
        wanted = modes[self._slots]
        drive_on = (DRIVE_ON in status) if self._arms is None else status[self._arm - 1] == DRIVE_ON
        is_open = np.isin(wanted, list(OPEN_MODES))
        closed = ~self._opened & np.isin(wanted, list(CLOSED_MODES))
        ready = closed | (self._opened & (wanted == self._mode))
        strayed = np.flatnonzero(is_open & ~ready)
        answer = safe_answer(status, modes, self._arms)
        joints = set(self._slots.tolist())
        return Reading(
            input=read_input(drive_on, modes.tolist(), wanted[~closed].tolist(), self._mode),
            answer=answer,
            status=status[self._arm - 1],
            modes=wanted,
            ready=ready,
            held=np.isin(wanted, list(HOLDABLE)),
            powered=drive_on and bool(is_open.any()),
            any_open=bool(is_open.any()),
            strayed=int(strayed[0]) if strayed.size else None,
            others=tuple(slot for slot in answer.held if slot not in joints),
        )
