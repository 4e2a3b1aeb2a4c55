"""The paper's study: excitations of its methods and of the default, executed and compared."""

from .results import StudyResults
from .settings import FULL_STUDY, QUICK_STUDY, StudySettings, study_settings
from .study import run_study

__all__ = [
    "FULL_STUDY",
    "QUICK_STUDY",
    "StudyResults",
    "StudySettings",
    "run_study",
    "study_settings",
]
