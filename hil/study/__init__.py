"""The paper's study: design, execution, identification and comparison of methods A and B."""

from .results import StudyResults
from .run import run_study
from .settings import FULL, QUICK, StudySettings, study_settings

__all__ = ["FULL", "QUICK", "StudyResults", "StudySettings", "run_study", "study_settings"]
