"""Design of an excitation for a cell: settings, search, result file."""

from identification.excitation import METHODS, Method

from .design import run_search
from .problem import problem_of, search_settings
from .result import DesignResult, load_design
from .settings import DesignSettings, SettingsError, load_settings, preset

__all__ = [
    "METHODS",
    "DesignResult",
    "DesignSettings",
    "Method",
    "SettingsError",
    "load_design",
    "load_settings",
    "preset",
    "problem_of",
    "run_search",
    "search_settings",
]
