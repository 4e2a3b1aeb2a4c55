"""What a recording contains, and what it can determine, before an identification."""

from hil.look.look import look_at
from hil.look.result import Look, ParameterGroup, Row, TiedReading

__all__ = ["TiedReading", "ParameterGroup", "Look", "Row", "look_at"]
