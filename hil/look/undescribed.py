"""A robot for recordings without a URDF: joints without lengths and masses."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory

from hil.base.errors import SourceError
from hil.importers.channels import CHANNEL_NAMES, channels_of
from hil.importers.imported_robot import Robot
from hil.importers.lerobot import is_data_set
from hil.importers.log_files import LogFiles
from hil.importers.recording_import import ImportOptions


def undescribed_robot(source: Path, options: ImportOptions, files: LogFiles) -> Robot:
    """Return a robot with as many joints as the recording has positions; `files` are parsed once.

    Raises:
        SourceError: no channel is named as position, or its units need the arm.
    """
    if is_data_set(source):
        problem = "is a data set of LeRobot, in units that the ranges of the joints decide"
        raise SourceError(source, problem, field="--urdf", remedy="add --urdf ARM.urdf")
    channels = channels_of(source, files=files)
    names = next((channel.joints for channel in channels if channel.joints), ())
    if not names:
        given = options.chosen.get("position", "").split(",")
        size = sum(channel.size for channel in channels if channel.kind == "position")
        count = len(given) if len(given) > 1 else size
        names = tuple(f"joint_{number}" for number in range(1, count + 1))
    if not names:
        problem = f"no channel is named as position ({', '.join(CHANNEL_NAMES['position'][:3])})"
        remedy = "state --columns 'position=NAME{}', with {} for the joint"
        raise SourceError(source, problem, field="position", remedy=remedy)
    with TemporaryDirectory(prefix="hil-") as folder:
        path = Path(folder) / "undescribed.urdf"
        path.write_text(_urdf(names), encoding="utf-8")
        return Robot.from_urdf(path)


def _urdf(names: tuple[str, ...]) -> str:
    joints = "".join(
        f"<joint name='{name}' type='continuous'><parent link='link{k}'/>"
        f"<child link='link{k + 1}'/><origin xyz='0 0 0.1'/><axis xyz='{k % 2} {(k + 1) % 2} 0'/>"
        f"</joint><link name='link{k + 1}'/>"
        for k, name in enumerate(names)
    )
    return f"<robot name='undescribed'><link name='link0'/>{joints}</robot>"
