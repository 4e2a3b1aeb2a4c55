"""What a campaign settles for all its archives: noise of the positions, low-pass, delay."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Final, NamedTuple

import numpy as np

from hil.cell import Cell
from hil.errors import HilError
from hil.identify.sources import Source, position_noise, source_of
from identification import IdentificationError
from identification.recording import Recording
from identification.repetition_noise import repetition_noise
from identification.torque_channel import find_torque_bandwidth

from .cache import Where
from .factors import cell_in, opened, preprocessing
from .kept_forms import settings_from, settings_header
from .keys import choices_digest, code_digest
from .setup import stated_delay
from .types import ArchiveRef, Broken, Choices, Settings

COMPARED: Final = 32
"""Repetitions that are compared to find their noise, where no standstill was recorded."""

AT_REST: Final = "measured at standstill"
BETWEEN: Final = "measured on what differs between repetitions at equal times"
THEIR_OWN: Final = "taken from each recording's own fast part"


class Settled(NamedTuple):
    """Settings of a campaign.

    Attributes:
        settings: None where there is not one archive to settle them from.
        broken: archives that could not be read for it.
    """

    settings: Settings | None
    broken: tuple[Broken, ...]


def consulted(refs: Sequence[ArchiveRef]) -> tuple[ArchiveRef, ...]:
    """The archives of a campaign that its settings depend on."""
    ordered = sorted(refs, key=lambda ref: ref.order)
    rest = [ref for ref in ordered if ref.use == "standstill"]
    fitted = [ref for ref in ordered if ref.use == "excitation"]
    compared = not rest and of_one_motion(fitted)
    return (*rest, *fitted[: COMPARED if compared else 1])


def known_settings(refs: Sequence[ArchiveRef], choices: Choices, where: Where) -> Settings | None:
    """What was settled from these archives (see `consulted`) before; None if nothing."""
    if not refs:
        return None
    found = where.store(refs[0].location).get(choices_digest(choices, refs))
    return None if found is None else settings_from(found.header)


def settle(refs: Sequence[ArchiveRef], choices: Choices, where: Where) -> Settled:
    """Settle a campaign from the archives that `consulted` names, and keep what was settled.

    The noise of the positions is that of the first standstill; without one it is measured between
    the first `COMPARED` repetitions, if they are of one motion.
    """
    known = known_settings(refs, choices, where)
    if known is not None:
        return Settled(known, ())
    broken: list[Broken] = []
    rest, fitted = _read(refs, broken)
    if not fitted:
        return Settled(None, tuple(broken))
    cell, first = fitted[0]
    noise, words = None, THEIR_OWN
    if rest is not None:
        noise, words = position_noise(cell, rest), AT_REST
    elif of_one_motion(refs) and len(fitted) > 1:
        try:
            compared = repetition_noise([source.recording for _, source in fitted])
            noise, words = compared.position.white, BETWEEN
        except IdentificationError:
            pass  # no two that could be compared
    settings = Settings(
        smoother=choices.smoother,
        torque_delay=_delay(cell, choices),
        torque_bandwidth=None,
        noise_variance=None if noise is None else tuple(float(value) for value in noise),
        code=code_digest(),
        noise=words,
    )
    settings = replace(settings, torque_bandwidth=_bandwidth(cell, first, settings, choices))
    if not broken:
        where.store(refs[0].location).put(choices_digest(choices, refs), settings_header(settings))
    return Settled(settings, tuple(broken))


def _read(
    refs: Sequence[ArchiveRef], broken: list[Broken]
) -> tuple[Recording | None, list[tuple[Cell, Source]]]:
    """The first standstill that can be read, and the excitations."""
    rest, fitted = None, []
    for ref in refs:
        standing = ref.use == "standstill"
        if standing and rest is not None:
            continue
        try:
            with opened(ref) as archive:
                cell = cell_in(archive)
                source = source_of(archive, cell, to_fit=not standing)
        except (HilError, IdentificationError) as error:
            broken.append(Broken(ref.location, str(error)))
            continue
        if standing:
            rest = source.recording
        else:
            fitted.append((cell, source))
    return rest, fitted


def of_one_motion(refs: Sequence[ArchiveRef]) -> bool:
    """Whether the excitations among archives repeat one planned motion."""
    motions = {ref.motion for ref in refs if ref.use == "excitation"}
    return len(motions) == 1 and "" not in motions


def _delay(cell: Cell, choices: Choices) -> float:
    if choices.delay is not None:
        return choices.delay
    return stated_delay(cell)


def _bandwidth(cell: Cell, first: Source, settings: Settings, choices: Choices) -> float | None:
    """A low-pass in imported torques; a controller's own currents come through none."""
    wanted, recording = choices.torque_bandwidth, first.recording
    if wanted != "auto":
        return wanted
    if recording.motor_current is not None or recording.torque is None:
        return None
    noise = settings.noise_variance
    return find_torque_bandwidth(
        recording,
        cell.model,
        noise_variance=None if noise is None else np.array(noise),
        options=preprocessing(settings),
    )
