"""What holds in every simulated campaign, whatever befell it; one family of laws per module.

A law sees an `Observed` and nothing else of the product: the wire, the archives and the manifest
are decoded here a second time, from the documents.
"""

from __future__ import annotations

from tests.simulate.observed import Law

from .archives import archives
from .estimated import estimate
from .folders import folder
from .guarded import guard
from .judged import judge
from .replies import replies
from .rest import rest
from .resumed import resume

LAWS: dict[str, Law] = {
    "replies": replies,
    "judge": judge,
    "guard": guard,
    "rest": rest,
    "archives": archives,
    "folder": folder,
    "resume": resume,
    "estimate": estimate,
}
"""Name of the family to the law."""
