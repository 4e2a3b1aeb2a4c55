"""Design of exciting motions: criteria, constraints, searches."""

# ruff: noqa: F401
import types

from identification.errors import WorkspaceError
from identification.excitation.collision import CollisionChecker, Proximity
from identification.excitation.constraints import (
    SAMPLE_PERIOD,
    Constraints,
    CurrentModel,
    check_motion,
    midpoints,
    sampled,
)
from identification.excitation.criteria import (
    CRITERIA,
    Criteria,
    Given,
    Objective,
    condition_number,
    correlation,
    coupling_index,
    coupling_index_max,
    fitness_eq7,
    friction_of_excitation,
    information,
    log10_det,
)
from identification.excitation.errors import (
    CollisionModelError,
    DesignError,
    JournalError,
    MissingMeshError,
    NoFeasibleMotionError,
)
from identification.excitation.excitation import Excitation, ViaPointMotion
from identification.excitation.genomes import Genome, SineGenome, ViaPointGenome
from identification.excitation.motion_precision import LoadQuantities, Precision, Quantities
from identification.excitation.searches.journal import Journal
from identification.excitation.searches.methods import METHODS, Method, SearchMethod
from identification.excitation.searches.population import (
    Front,
    Population,
    Problem,
    Scores,
    SearchSettings,
)
from identification.excitation.searches.search import (
    RESCORE_PERIOD,
    Design,
    SearchProgress,
    most_evaluations,
    search,
)
from identification.excitation.validation_motions import random_validation_motions
from identification.excitation.violation import KINDS, Violation
from identification.model.workspace import Box, Workspace

__all__ = [
    name
    for name, member in globals().items()
    if not (name.startswith("_") or isinstance(member, types.ModuleType))
]
