"""Values that a person has still to fill in: `"?"` in the place of a number.

`hil new` writes them where neither the URDF nor the controller says anything. A cell file that
still has one cannot be used: nothing is assumed in its place.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Final

from pydantic import BaseModel

from .errors import CellError, described

UNKNOWN: Final = "?"

WHERE: Final[Mapping[str, str]] = {
    "cell.mesh_folders": "find the folder in which the package:// paths of the URDF's meshes begin",
    "limits.lower_deg": "data sheet, or the controller's stroke ends ($STRK_END_N)",
    "limits.upper_deg": "data sheet, or the controller's stroke ends ($STRK_END_P)",
    "limits.velocity_deg": "data sheet, largest joint speeds",
    "limits.acceleration_deg": "data sheet or the maker; rarely published. Full speed in 0.3 s is "
    "a fair start, and then an assumption: name the field in cell.assumed",
    "limits.jerk_deg": "the maker; rarely published. Full acceleration in 0.1 s is a fair start, "
    "and then an assumption: name the field in cell.assumed",
    "nominal.rotor_inertia": "the motors' data sheet, times the square of the gear ratio",
    "nominal.coulomb": "the maker; without a figure 5 to 10 % of the joint's largest torque, and "
    "then an assumption: name the field in cell.assumed",
    "nominal.viscous": "the maker; without a figure what adds as much again at full speed as "
    "Coulomb friction, and then an assumption: name the field in cell.assumed",
    "drive_train.gear_ratio": "the controller's init packet (hil new --from-controller)",
    "drive_train.calibration": "the controller's init packet (hil new --from-controller)",
    "drive_train.k54": "the controller's init packet; 0.0 where motors do not turn together",
    "drive_train.k64": "the controller's init packet; 0.0 where motors do not turn together",
    "drive_train.k65": "the controller's init packet; 0.0 where motors do not turn together",
    "drive_train.joint_sign": "jog each joint by a few degrees: 1 where the pendant's angle grows "
    "while the arm turns about the URDF's axis by the right-hand rule, else -1",
    "drive_train.joint_offset_deg": "put the arm where all angles of the URDF are zero and read "
    "the pendant",
    "drive_train.torque_constant": "the motors' plates or data sheets; or hil gains, with a known "
    "load",
    "drive_train.current_limit": "the controller's init packet (hil new --from-controller)",
    "drive_train.following_error": "the controller's init packet (hil new --from-controller)",
    "drive_train.encoder_counts_per_revolution": "the motors' data sheets",
    "controller.cycle_ms": "what the controller's Open option was set to",
    "controller.host": "the address of the controller's board that sends, 10.2.12.150 as delivered",
    "workspace.floor": "height of the floor over the robot's base frame, negative on a pedestal",
    "workspace.walls": "measure all that the arm can reach; [] where there is nothing",
    "campaign.home_deg": "a posture with room in all directions",
}
"""Where each figure is found, by field."""


class UnknownFieldsError(CellError):
    """A cell file in which values are still to be filled in.

    Attributes:
        fields: their dotted names.
    """

    def __init__(self, path: Path, fields: Mapping[str, str]) -> None:
        self.fields = tuple(fields)
        lines = "".join(f"\n  {name}: {text}" for name, text in fields.items())
        count = f"{len(fields)} fields" if len(fields) > 1 else "one field"
        super().__init__(
            path, "", None, f'{count} still unknown ("{UNKNOWN}")', f"fill in what is true:{lines}"
        )


def require_known(path: Path, raw: Mapping[str, Any], schema: type[BaseModel]) -> None:
    """Refuse a file in which a value is `"?"`, by the names of all such fields at once.

    Raises:
        UnknownFieldsError: each field with what it must be and where that is found.
    """
    fields: dict[str, str] = {}
    for location, places in _unknown(raw, ()):
        name = ".".join(location)
        which = f" (entry {', '.join(map(str, places))})" if places else ""
        where = f"; {WHERE[name]}" if name in WHERE else ""
        fields[name + which] = described(schema, list(location)) + where
    if fields:
        raise UnknownFieldsError(path, fields)


def _unknown(
    table: Mapping[str, Any], above: tuple[str, ...]
) -> Iterator[tuple[tuple[str, ...], list[int]]]:
    """Fields that are unknown, each with the entries of its list that are, from 1; [] for all."""
    for key, value in table.items():
        if isinstance(value, Mapping):
            yield from _unknown(value, (*above, key))
        elif value == UNKNOWN:
            yield (*above, key), []
        elif isinstance(value, list):
            places = [place for place, entry in enumerate(value, 1) if entry == UNKNOWN]
            if places:
                yield (*above, key), [] if len(places) == len(value) else places
