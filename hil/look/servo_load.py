"""The load or the duty of a servo in a channel that is named as a torque: found, and left out."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Final

import numpy as np
import tomlkit

from hil.archive import Archive
from hil.importers.conclusions import ChannelMeaning
from hil.importers.name_words import words_of
from hil.importers.recording_import import ImportedRecording, ImportOptions, RobotOf, read_by_map
from hil.look.physics import Size
from hil.look.readings import NoJointTorque
from hil.look.torque_sample import SUSPECT_ERROR, TorqueSample
from identification.signals.recording import MIN_MOVEMENT

# joints whose torque may be positive throughout, by the weight they hold
_MAX_UNSIGNED_JOINTS: Final = 2


def may_be_load(imported: ImportedRecording, options: ImportOptions) -> bool:
    """Return whether a torque may be a servo's load: with commands, and not stated as torque."""
    columns = imported.archive.columns
    if imported.is_stated or not {"torque", "commanded_position"} <= columns.keys():
        return False
    return "torque" not in options.chosen


def servo_load(
    imported: ImportedRecording, sample: Callable[[], TorqueSample | None]
) -> NoJointTorque | None:
    """Return why a torque that may be a servo's load is one, by its sign or by its name.

    Args:
        imported: a recording.
        sample: returns rows of it, which show how large a named load is.
    """
    if _unsigned_torques(imported.archive):
        return NoJointTorque()
    if not _is_named_load(imported):
        return None
    asked = sample()
    size = None if asked is None else Size.of(asked.cell, asked.cell.model, asked.rows)
    ratio = size.factor if size is not None and size.by_masses else None
    return NoJointTorque(is_load=True, ratio=ratio)


def torques_without_sign(archive: Archive, sample: Callable[[], TorqueSample | None]) -> int:
    """Return the number of joints whose torque has no sign, 0 where weight may be the reason.

    Args:
        archive: a recording.
        sample: returns rows of it, which show whether masses explain the torque.
    """
    count = _unsigned_torques(archive)
    if count <= _MAX_UNSIGNED_JOINTS:
        return 0
    asked = sample()
    return count if asked is None or asked.score.overall > SUSPECT_ERROR else 0


def _unsigned_torques(archive: Archive) -> int:
    """Return the number of joints that move, if no torque is ever negative; else, or of one, 0."""
    if "torque" not in archive.columns:
        return 0
    torque = np.asarray(archive.columns["torque"])
    moving = np.ptp(np.asarray(archive.columns["position"]), axis=0) > MIN_MOVEMENT
    count = int(np.count_nonzero(moving))
    return count if count > 1 and (torque >= 0.0).all() and torque.any() else 0


def _is_named_load(imported: ImportedRecording) -> bool:
    """Return whether the channels of the torque are named as the load of a servo."""
    return any(
        isinstance(each, ChannelMeaning)
        and each.kind == "torque"
        and "load" in words_of(each.channels)
        for each in imported.concluded
    )


def without_torque(
    imported: ImportedRecording, robot_of: RobotOf, reason: NoJointTorque
) -> ImportedRecording:
    """Return a recording without its torque, and why."""
    if imported.map_text is None:
        columns = {
            name: column for name, column in imported.archive.columns.items() if name != "torque"
        }
        without = replace(imported, archive=replace(imported.archive, columns=columns))
    else:
        entries = tomlkit.parse(imported.map_text)
        del entries["torque"]
        without = read_by_map(imported.request, robot_of, tomlkit.dumps(entries))
    others = [
        each
        for each in imported.concluded
        if not (isinstance(each, ChannelMeaning) and each.kind == "torque")
    ]
    return replace(without, concluded=(*others, reason))
