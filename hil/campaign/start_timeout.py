"""How long a motion that was asked for is waited for."""

from __future__ import annotations

from typing import Final

from drivers.states import State

BEGIN_TIMEOUT: Final = 60.0
"""s within which a motion that was accepted must have begun."""
OFF_TIMEOUT: Final = 2.0
"""s with the drive off after which a motion that was accepted does not begin any more."""
_WITHOUT_DRIVE: Final = frozenset(
    (State.SYNC, State.INIT, State.DRIVE_OFF, State.FAULTED, State.ENDED)
)


class Beginning:
    """Whether a motion that was accepted may still begin.

    Args:
        now: when it was asked for [s of any monotonic clock].
    """

    def __init__(self, now: float) -> None:
        self._asked = self._driven = now

    def hopeless(self, state: State, now: float) -> str | None:
        """Why a motion that has not begun will not begin any more, in words; None while it may."""
        if state not in _WITHOUT_DRIVE:
            self._driven = now
        if now - self._driven > OFF_TIMEOUT and state is State.FAULTED:
            return "a refusal came before the motion began"
        if now - self._driven > OFF_TIMEOUT:
            return "the drive went off before the motion began"
        if now - self._asked > BEGIN_TIMEOUT:
            return f"the motion did not begin within {BEGIN_TIMEOUT:g} s ({state.name})"
        return None
