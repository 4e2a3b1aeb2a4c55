"""What every section of `results.json` has in common."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict


class Frozen(BaseModel):
    """Checked, unchangeable, without unknown fields; infinite and missing values as words."""

    model_config = ConfigDict(frozen=True, extra="forbid", ser_json_inf_nan="strings")

    def to_json(self) -> str:
        """As indented JSON, the text of a file."""
        return self.model_dump_json(indent=1) + "\n"
