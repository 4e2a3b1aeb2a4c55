"""From archives to a result: reads archives and nothing else."""

from .options import Options
from .run import Identification, identify_archives, identify_campaign

__all__ = ["Identification", "Options", "identify_archives", "identify_campaign"]
