"""Laws of all simulated campaigns, one family per module, with those of `tests.laws`.

The input of a law is an `Observed`: wire, archives and manifest are decoded here independently of
the product, from the documentation.
"""

from __future__ import annotations

from tests.simulate.observed import Law

from .archives import archives
from .estimated import estimate
from .folders import folder
from .guarded import guard
from .replies import replies
from .rest import rest
from .resumed import resume
from .whole import completion, gaps, piles

LAWS: dict[str, Law] = {
    "completion": completion,
    "gaps": gaps,
    "piles": piles,
    "replies": replies,
    "guard": guard,
    "rest": rest,
    "archives": archives,
    "folder": folder,
    "resume": resume,
    "estimate": estimate,
}
"""Name of the family to the law."""
