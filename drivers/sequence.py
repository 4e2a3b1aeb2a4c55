"""Sequence numbers: which packet is new, which came twice, which is too old."""

from __future__ import annotations

from drivers.packets import LAST_NUMBER


class Sequence:
    """Follows the controller's numbers (1..0x7FFF, then 1 again) from the last one answered.

    A number at most `window` ahead is new; the window is what can be missed before silence ends
    the session, so a number further ahead cannot be a later packet of the same session.

    Attributes:
        last: number of the last packet answered.
        cycle: the controller's cycles since its init packet, missed ones counted in.
        broken: after a silence no number is expected; whatever comes next is new.
    """

    def __init__(self) -> None:
        self.last = 0
        self.cycle = 0
        self.broken = False
        self._window = LAST_NUMBER // 2

    def restart(self, number: int, window: float) -> None:
        """Count from this number on, accepting at most `window` cycles ahead."""
        self.last = number
        self.cycle = 0
        self.broken = False
        # Beyond half of all numbers, ahead could not be distinguished from behind.
        self._window = max(1, min(int(window), LAST_NUMBER // 2))

    def distance(self, number: int) -> int:
        """Cycles from the last packet answered to this one, 0..0x7FFE."""
        return (number - self.last) % LAST_NUMBER

    def is_duplicate(self, number: int) -> bool:
        """Whether this is the last packet once more."""
        return number == self.last and not self.broken

    def is_stale(self, number: int) -> bool:
        """Whether this cannot be a later packet of the same session."""
        return not self.broken and not 1 <= self.distance(number) <= self._window

    def leads_to(self, number: int, missed: int) -> bool:
        """Whether this number comes after the last, at most so many missed, or after none."""
        return self.broken or self.last == 0 or self.distance(number) <= missed + 1

    def accept(self, number: int) -> int:
        """Go on to this number; returns how many packets were missed before it."""
        ahead = self.distance(number)
        if not 1 <= ahead <= self._window:
            ahead = 1  # after a silence: how long it was, the numbers cannot tell
        self.last = number
        self.cycle += ahead
        self.broken = False
        return ahead - 1
