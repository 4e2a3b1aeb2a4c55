"""How the joint states of a bag were read, as a file with which they are read so again."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from pydantic import BaseModel, ConfigDict, ValidationError

from hil.base.errors import SourceError
from hil.base.safe_input import parse_toml
from hil.base.toml_text import to_text
from hil.cell.arms import Links
from hil.cell.errors import first_error
from hil.importers.column_map import map_text
from hil.importers.rosbag2 import CommandStamps, Effort

_COMMENT: Final = "How hil read the joint states of the bag; joints by their names"
_DOCUMENTATION: Final = "docs/logs.md"


class BagMap(BaseModel):
    """The table ``[bag]`` of a map, in place of the quantities of a column map.

    Attributes:
        topic: of the joint states; None where the bag has only one.
        clock: stamps that were used: of the ``header`` of the messages, or of the ``bag``.
        effort: content of the effort field.
        command_topic: of the commanded positions, ``none`` for none; None to find it.
        rename: joint in the URDF by name in the bag, where they differ.
        outside_limits: whether positions outside the limits of the URDF are accepted.
        arm: links between which the recorded arm lies; a table of its own, as of a column map.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", defer_build=True)

    topic: str | None = None
    clock: CommandStamps = "auto"
    effort: Effort = "torque"
    command_topic: str | None = None
    rename: Mapping[str, str] = {}
    outside_limits: bool = False
    arm: Links = Links()

    @property
    def text(self) -> str:
        """The map, TOML."""
        bag = self.model_dump(exclude_defaults=True, exclude={"arm"})
        arm = self.arm.model_dump(exclude_none=True)
        return to_text({"bag": bag, **({"arm": arm} if arm else {})}, {"": _COMMENT})

    @classmethod
    def of(cls, tables: Mapping[str, Any]) -> BagMap | None:
        """Return the table of a parsed map; None if the map has none.

        Raises:
            ValidationError: it is not valid.
        """
        if "bag" not in tables:
            return None
        return cls.model_validate({**tables["bag"], "arm": tables.get("arm", {})})

    @classmethod
    def load(cls, path: Path) -> BagMap | None:
        """Read the table of a map; None if the map has none.

        Raises:
            SourceError: it is not valid.
        """
        try:
            return cls.of(parse_toml(map_text(path)))
        except ValidationError as error:
            wrong = first_error(path, error, cls, documentation=_DOCUMENTATION)
            field = f"bag.{wrong.field}"
            raise SourceError(path, wrong.problem, field=field, remedy=wrong.remedy) from error
        except (OSError, ValueError):
            return None  # the column map says what is wrong with the file
