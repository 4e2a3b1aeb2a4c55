"""Joints that the rows of a log name, as ROS writes joint states in text."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, NamedTuple

_HEADER_COLUMNS: Final = 3  # columns of a joint state: seconds, nanoseconds, frame


class RowNames(NamedTuple):
    """Joints that cells of text name in every row, as `rostopic echo` writes them."""

    place: int  #: of the first among the columns
    joints: tuple[str, ...]

    def columns_of_messages(self, width: int) -> dict[str, str]:
        """Return the columns of joint states without a header, as of `ros2 topic echo --csv`.

        They are seconds, nanoseconds, frame, then names, positions, velocities and efforts.
        """
        count = len(self.joints)
        if self.place != _HEADER_COLUMNS or width != self.place + 4 * count:
            return {}
        columns = {"time": "0"}
        for number, kind in enumerate(("position", "velocity", "torque"), 1):
            first = self.place + number * count
            columns[kind] = ",".join(map(str, range(first, first + count)))
        return columns


def row_names(texts: Sequence[str | None], joints: Sequence[str]) -> RowNames:
    """Return the joints that columns of text name; none if fewer than two are of the URDF.

    `texts` are the text of each column that is the same in all rows, None of the others.
    """
    places = [index for index, text in enumerate(texts) if text in joints]
    if len(places) < 2:
        return RowNames(0, ())
    first = places[0]
    names = []
    for text in texts[first:]:
        if text is None:
            break
        names.append(text)
    return RowNames(first, tuple(names) if len(set(names)) == len(names) else ())
