"""Choosing motions that excite the parameters: criteria and designs."""

from identification.excitation.criteria import (
    condition_number,
    correlation,
    coupling_index,
    coupling_index_max,
    fitness_eq7,
    information,
    log10_det,
)

__all__ = [
    "condition_number",
    "correlation",
    "coupling_index",
    "coupling_index_max",
    "fitness_eq7",
    "information",
    "log10_det",
]
