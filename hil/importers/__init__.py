"""Foreign recordings into archives: logs of numbers (text, arrays) and rosbag2."""

from hil.importers.column_map import ColumnMap, Quantity, TimeColumn
from hil.importers.findings import Findings
from hil.importers.log import import_log
from hil.importers.output import Use
from hil.importers.robot import Robot
from hil.importers.rosbag2 import import_rosbag2

__all__ = [
    "ColumnMap",
    "Findings",
    "Quantity",
    "Robot",
    "TimeColumn",
    "Use",
    "import_log",
    "import_rosbag2",
]
