"""What a recording contains, and what it can determine, before an identification."""

from hil.look.result import Look, ParameterGroup, Row, TiedReading
from hil.look.run import look_at

__all__ = ["TiedReading", "ParameterGroup", "Look", "Row", "look_at"]
