"""Choosing motions that excite the parameters: criteria, constraints, designs."""

from identification.excitation.collision import CollisionChecker, Contact
from identification.excitation.constraints import (
    CurrentModel,
    MotionCheck,
    Violation,
    check_motion,
)
from identification.excitation.criteria import (
    condition_number,
    correlation,
    coupling_index,
    coupling_index_max,
    fitness_eq7,
    information,
    log10_det,
)
from identification.excitation.design import (
    Criteria,
    Drawing,
    Excitation,
    random_search,
    random_validation_motions,
)
from identification.excitation.drawn import DrawnMotion
from identification.excitation.errors import (
    CollisionModelError,
    DesignError,
    NoFeasibleMotionError,
    WorkspaceError,
)
from identification.excitation.workspace import Box, Wall, Workspace

__all__ = [
    # criteria
    "condition_number",
    "correlation",
    "coupling_index",
    "coupling_index_max",
    "fitness_eq7",
    "information",
    "log10_det",
    # constraints
    "Box",
    "Wall",
    "Workspace",
    "CollisionChecker",
    "Contact",
    "CurrentModel",
    "MotionCheck",
    "Violation",
    "check_motion",
    # designs
    "Criteria",
    "Drawing",
    "DrawnMotion",
    "Excitation",
    "random_search",
    "random_validation_motions",
    # errors
    "CollisionModelError",
    "DesignError",
    "NoFeasibleMotionError",
    "WorkspaceError",
]
