"""The result of a search for an excitation."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from identification.excitation.criteria import Criteria
from identification.excitation.excitation import Excitation
from identification.excitation.searches.front import Front
from identification.excitation.searches.scale import Scale
from identification.excitation.searches.settings import SearchSettings

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Design:
    """The motion that a search chose, and what it chose from.

    Attributes:
        settings: of the search.
        genes: (n_genes,) of the chosen motion.
        excitation: the motion, with its criteria at 1 ms.
        front: the best compromises of everything that the search itself scored, with measures at
            the search's own period. A polish looks for one motion, not for compromises, and is
            left out.
        chosen: which motion of the front it is; None where the polish found a better one.
        origin: which motion of the front it is or, polished, grew from.
        origin_criteria: those of that motion, at 1 ms as well. The chosen motion is not worse: in
            its fitness, with the method "front" in neither measure. A polished one that is, at
            1 ms and against what the search saw at its own period, is not chosen.
        history: (g, 3) after each generation: fitness, log10 det and coupling index of the best
            motion so far, nan before there is one. With the method "front" the fitness is nan
            and the measures are the best of either, of different motions.
        evaluated: how many motions were scored.
        infeasible: how many of them broke a constraint, by kind; one may count for several.
        complete: whether the search ran to its end.
        exhausted: whether that end came before its last generation, as mating brought nothing new.
        scale: units of the balanced fitness and of the knee; None where they play no part.
    """

    settings: SearchSettings
    genes: Array
    excitation: Excitation
    front: Front
    chosen: int | None
    origin: int
    origin_criteria: Criteria
    history: Array
    evaluated: int
    infeasible: Mapping[str, int]
    complete: bool
    exhausted: bool
    scale: Scale | None
