"""Which laws a simulated campaign breaks."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

from tests.simulate.gaps import gaps, piles
from tests.simulate.laws import LAWS as OTHERS
from tests.simulate.observed import Broken, Law, Observed
from tests.simulate.script import DISTURBS_THE_ARM, kind_of

_FOR_A_PERSON: Final = frozenset({"RepetitionsRejectedError", "ArmChangedError"})


def completion(seen: Observed) -> Iterator[Broken]:
    """Once nothing goes wrong any more, the campaign completes and can be identified.

    But where something disturbed the arm, its repetitions may be unlike each other for good: the
    run then says that a person has to look.
    """
    if seen.complete:
        if seen.found is None:
            yield Broken("completion", f"complete, and not identified: {seen.unidentified}")
        return
    disturbed = any(kind_of(line) in {*DISTURBS_THE_ARM, "corrupt"} for line in seen.struck)
    looked_for = disturbed and type(seen.runs[-1].error).__name__ in _FOR_A_PERSON
    if not looked_for:
        yield Broken("completion", f"after {len(seen.runs)} runs it ended {seen.ended}")


LAWS: Final[dict[str, Law]] = {"completion": completion, "gaps": gaps, "piles": piles, **OTHERS}


def judged(seen: Observed) -> list[Broken]:
    """What is broken; a law that fails itself is a failure of its own name."""
    found: list[Broken] = []
    for name, law in LAWS.items():
        try:
            found += law(seen)
        except Exception as error:  # an observation that a law cannot read must be looked at
            found.append(Broken(f"{name} (cannot judge)", f"{type(error).__name__}: {error}"))
    return found
