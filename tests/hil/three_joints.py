"""A small arm to import logs for."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from hil.archive import open_archive
from hil.importers import ColumnMap, Robot, import_log

JOINTS = ("hip", "knee", "ankle")


def three_joint_robot(folder: Path) -> Robot:
    """Its URDF is written into the folder."""
    parts = ["<robot name='three'><link name='l0'/>"]
    for number, name in enumerate(JOINTS):
        parts.append(
            f"<link name='l{number + 1}'><inertial><mass value='1'/><origin xyz='0 0 0.2'/>"
            "<inertia ixx='1' iyy='1' izz='1' ixy='0' ixz='0' iyz='0'/></inertial></link>"
            f"<joint name='{name}' type='revolute'><parent link='l{number}'/>"
            f"<child link='l{number + 1}'/><axis xyz='0 1 0'/><origin xyz='0 0 0.4'/>"
            "<limit lower='-3' upper='3' effort='9' velocity='9'/></joint>"
        )
    path = folder / "three.urdf"
    path.write_text("".join([*parts, "</robot>"]))
    return Robot.from_urdf(path)


def column_map(**entries: object) -> ColumnMap:
    """Of positions called q1, q2 ... at 100 Hz, unless the entries say else."""
    rate = {} if "time" in entries else {"sample_rate": 100.0}
    return ColumnMap.model_validate({"position": {"columns": "q{}"}, **rate, **entries})


def imported(source: Path, robot: Robot, **entries: object) -> dict[str, Any]:
    """The columns of a log's archive, which lies beside it; entries as of `column_map`."""
    path = source.with_suffix(".mcap")
    import_log(source, path, robot=robot, columns=column_map(**entries))
    return dict(open_archive(path).columns)
