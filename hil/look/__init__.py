"""What a recording contains, and what it can determine, before an identification.

Names are imported on first use.
"""

from typing import TYPE_CHECKING

from hil.base.first_use import on_first_use

if TYPE_CHECKING:
    from hil.look.look import look_at
    from hil.look.result import Look, ParameterGroup, Row, TiedReading

__all__ = ["TiedReading", "ParameterGroup", "Look", "Row", "look_at"]

if not TYPE_CHECKING:
    __getattr__, __dir__ = on_first_use(
        __name__,
        {
            "hil.look.look": ("look_at",),
            "hil.look.result": (
                "Look",
                "ParameterGroup",
                "Row",
                "TiedReading",
            ),
        },
    )
