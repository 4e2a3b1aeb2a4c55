"""Which laws a simulated campaign breaks."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Final

from hil.errors import HilError
from tests.simulate.disk import Killed
from tests.simulate.gaps import gaps, piles
from tests.simulate.laws import LAWS as OTHERS
from tests.simulate.observed import Broken, Law, Observed
from tests.simulate.script import kind_of


def documented_errors(seen: Observed) -> Iterator[Broken]:
    """A run ends with one of the errors that `Campaign.run` documents, or by a person's hand."""
    for number, life in enumerate(seen.runs, start=1):
        error = life.error
        if error is not None and not isinstance(error, (HilError, Killed, KeyboardInterrupt)):
            yield Broken("documented errors", f"run {number}: {type(error).__name__}: {error}")


_DISTURBS_THE_ARM: Final = frozenset({"push", "saturate", "following-error", "corrupt"})
_FOR_A_PERSON: Final = frozenset({"RepetitionsRejectedError", "ArmChangedError"})


def completion(seen: Observed) -> Iterator[Broken]:
    """Once nothing goes wrong any more, the campaign completes and can be identified.

    But where something disturbed the arm, its repetitions may be unlike each other for good, and
    where it was stopped in mid-motion there may be no way on from there: the run then says that a
    person has to look, or to jog the arm.
    """
    if seen.complete:
        if seen.found is None:
            yield Broken("completion", f"complete, and not identified: {seen.unidentified}")
        return
    disturbed = any(kind_of(line) in _DISTURBS_THE_ARM for line in seen.struck)
    stopped_in_the_way = "jog the arm" in seen.ended and len(seen.runs) > 1
    looked_for = disturbed and type(seen.runs[-1].error).__name__ in _FOR_A_PERSON
    if not (looked_for or stopped_in_the_way):
        yield Broken("completion", f"after {len(seen.runs)} runs it ended {seen.ended}")


LAWS: Final[dict[str, Law]] = {
    "documented errors": documented_errors,
    "completion": completion,
    "gaps": gaps,
    "piles": piles,
    **OTHERS,
}


def judged(seen: Observed, laws: Iterable[str] = tuple(LAWS)) -> list[Broken]:
    """What is broken; a law that fails itself is a failure of its own name."""
    found: list[Broken] = []
    for name in laws:
        try:
            found += LAWS[name](seen)
        except Exception as error:  # an observation that a law cannot read must be looked at
            found.append(Broken(f"{name} (cannot judge)", f"{type(error).__name__}: {error}"))
    return found
