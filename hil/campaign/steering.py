"""Passing on what the person requests of a motion."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, Protocol

from drivers.errors import RequestError
from drivers.motion_source import MotionSource
from hil.errors import ControllerFault

from .motion_watch import MotionWatch
from .stop import Stop

NOT_BEGUN: Final = "it had not begun"
"""Why a motion ends that was stopped before it was asked for."""
ASKED_EVERY: Final = 0.02
"""s between two questions for a request where nothing else is to be done."""


class Steered(Protocol):
    """A motion that can be messages to go slower, to rest and to go on: `Session`, the exchange."""

    def override(self, fraction: float) -> None:
        """Go on at this fraction of the speed."""
        ...

    def hold(self) -> None:
        """Rest on the path."""
        ...

    def resume(self) -> None:
        """Go on."""
        ...


class Steering:
    """Takes the requests of one motion's watch to the motion.

    Args:
        watch: has the requests.
        most: largest fraction of the planned speed, whatever is requested.

    Attributes:
        fraction: asked of the motion last.
        held: whether it was asked to rest.

    Raises:
        ValueError: `most` is not one of 0..1.
    """

    def __init__(self, watch: MotionWatch, most: float) -> None:
        if not 0.0 < most <= 1.0:
            raise ValueError(f"an override of {most!r} is not above 0 and at most 1")
        self._watch, self._most = watch, most
        self.fraction, self.held = most, False

    def begin(
        self, source: MotionSource, stop: Stop, meanwhile: Callable[[], object] = lambda: None
    ) -> bool:
        """Have a motion begin at the speed requested; waits while a hold is requested.

        Args:
            source: the motion.
            stop: ends the waiting.
            meanwhile: called again and again while it waits.

        Returns:
            Whether it may be asked for now; False once a stop is asked for.

        Raises:
            ControllerFault: it is to be slower than planned and knows no override.
        """
        request = self._watch.request()
        while request.held and not stop.requested:
            meanwhile()
            time.sleep(ASKED_EVERY)
            request = self._watch.request()
        if stop.requested:
            return False
        self.fraction = min(self._most, request.override)
        change = getattr(source, "override", None)
        if callable(change):
            change(self.fraction)
        elif self.fraction < 1.0:
            raise ControllerFault(
                f"a {type(source).__name__} knows no override and cannot be run at "
                f"{100.0 * self.fraction:.0f} %; nothing was sent"
            )
        return True

    def unchanged(self, stop: Stop) -> bool:
        """Whether a motion may begin as `begin` left it; not if it is to be slower or to rest."""
        request = self._watch.request()
        return not (stop.requested or request.held or request.override < self.fraction)

    def follow(self, motion: Steered) -> None:
        """Pass on what is requested now. A motion held before it began begins at rest."""
        request = self._watch.request()
        fraction = min(self._most, request.override)
        if fraction != self.fraction:
            self.fraction = fraction
            motion.override(fraction)
        if request.held is not self.held:
            self.held = request.held
            if request.held:
                motion.hold()
            else:
                motion.resume()


@dataclass
class Polite:
    """A `Steered` whose refusals become messages, as in the exchange process.

    Attributes:
        motion: what is steered.
        messages: takes the refusals in words.
    """

    motion: Steered
    messages: deque[str]

    def override(self, fraction: float) -> None:
        """Go on at this fraction of the speed."""
        try:
            self.motion.override(fraction)
        except RequestError as error:
            self.messages.append(str(error))

    def hold(self) -> None:
        """Rest on the path."""
        try:
            self.motion.hold()
        except RequestError as error:
            self.messages.append(str(error))

    def resume(self) -> None:
        """Go on."""
        try:
            self.motion.resume()
        except RequestError as error:
            self.messages.append(str(error))
