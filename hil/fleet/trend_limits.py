"""Limits of a trend, as a user writes them."""

from __future__ import annotations

import re
from typing import NamedTuple

from hil.base.errors import InputError
from hil.fleet.quantities import QUANTITIES, QuantityName


class TrendLimit(NamedTuple):
    """A change of a quantity that is not to be exceeded, as a share: 0.5 is +50 %."""

    quantity: QuantityName
    share: float

    @classmethod
    def parse(cls, text: str) -> TrendLimit:
        """Parse a limit such as ``friction +50 %``.

        Raises:
            InputError: it is none.
        """
        match = re.fullmatch(r"\s*([a-z ]+?)\s*([+-]\d+(?:\.\d+)?)\s*%\s*", text)
        if match is None or match[1] not in QUANTITIES or float(match[2]) == 0.0:
            names = ", ".join(QUANTITIES)
            remedy = (
                f"give a quantity and a change such as 'friction +50 %'; quantities are {names}"
            )
            raise InputError(None, f"{text!r} is not a limit", field="--limit", remedy=remedy)
        return cls(match[1], 0.01 * float(match[2]))
