"""Torques of recordings that hold motor currents only."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from hil.errors import ArchiveError
from identification.estimators.current_scale import CurrentScale, scale_from_nominal
from identification.signals.recording import Recording
from identification.signals.samples import smooth
from planner.checked_data import numbers

from .sources import Sources

Array = NDArray[np.float64]


def motor_from_joint(recording: Recording) -> Array:
    """Motor angles per joint angle (n, n) as imported; the identity where none were given."""
    stored = recording.provenance.get("motor_from_joint")
    return np.eye(recording.n_joints) if stored is None else numbers(json.loads(stored), 2)


def with_torques(sources: Sources) -> Sources:
    """These sources with a torque in every recording.

    Where there are currents only, the gains are read from the nominal masses of the URDF, and a
    warning says so. Only what is fitted is looked at.

    Raises:
        ArchiveError: the URDF has no masses that the currents could be compared with.
    """
    everything = (*sources.training, *sources.held_out)
    if all(source.recording.torque is not None for source in everything):
        return sources
    model, recordings = sources.cell.model, [source.recording for source in sources.training]
    currents = [one.motor_current for one in recordings if one.motor_current is not None]
    if len(currents) < len(recordings) or not np.any(model.nominal):
        raise ArchiveError(
            None,
            "the recordings hold no torques, and the URDF has no masses to compare currents with",
            field="torque",
            remedy="give drive.torque_constant in the column map, or find it by `hil gains`",
        )
    turns = motor_from_joint(recordings[0])
    motions = [smooth(one, sources.noise_variance) for one in recordings]
    scale = scale_from_nominal(model, motions, currents, turns)
    if not scale.determined.any():
        raise ArchiveError(
            None,
            "the recordings hold no torques, and their currents do not look like the weight and "
            "inertia of the URDF on any axis",
            field="torque",
            remedy="give drive.torque_constant in the column map, or find it by `hil gains`",
        )

    def with_torque(one: Recording) -> Recording:
        if one.torque is not None or one.motor_current is None:
            return one
        return replace(one, torque=(one.motor_current * scale.values) @ turns)

    sources = replace(
        sources,
        training=tuple(source.changed(with_torque) for source in sources.training),
        held_out=tuple(source.changed(with_torque) for source in sources.held_out),
    )
    for warning in _warnings(sources.cell.joint_names, scale):
        sources = sources.with_warning(warning)
    return sources


def _warnings(names: tuple[str, ...], scale: CurrentScale) -> list[str]:
    known = scale.determined
    figures = ", ".join(
        f"{name} {value:.4g} ± {2.0 * std:.2g}"
        for name, value, std in zip(names, scale.values, scale.std, strict=True)
        if np.isfinite(std)
    )
    warnings = [
        "only currents were recorded and no torque constants given: they were found by comparing "
        f"the currents with the masses of the URDF ({figures} N·m/A), so every torque and "
        "parameter is as right as those masses; `hil gains` with a known payload does without them"
    ]
    turned = [name for name, negative in zip(names, scale.turned, strict=True) if negative]
    if turned:
        warnings.append(
            f"the torque constant of {', '.join(turned)} comes out negative: where the current is "
            "positive the weight and inertia of the URDF need a negative torque. Either the sign "
            "of the current or of the axis is turned in the recording, or the URDF's masses are "
            "wrong there; the sign was used as found. Check it before using the torques"
        )
    inertial = [name for name, only in zip(names, scale.inertial, strict=True) if only]
    if inertial:
        warnings.append(
            f"weight hardly loads {', '.join(inertial)}: the torque constant there rests on "
            "inertia and takes the rotor's for that of the links"
        )
    unknown = [name for name, sure in zip(names, known, strict=True) if not sure]
    if unknown:
        warnings.append(
            f"no torque constant could be found for {', '.join(unknown)}: its torque is the "
            "current in A (times the gears), which predicts the current but no torque"
        )
    return warnings
