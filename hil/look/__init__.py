"""What a recording contains, and what it can determine, before an identification."""

from hil.look.result import Choice, Group, Look, Row
from hil.look.run import look_at

__all__ = ["Choice", "Group", "Look", "Row", "look_at"]
