"""The paper's study: excitations of its methods and of the default, executed and compared."""

from .results import StudyResults
from .run import run_study
from .settings import FULL, QUICK, StudySettings, study_settings

__all__ = ["FULL", "QUICK", "StudyResults", "StudySettings", "run_study", "study_settings"]
