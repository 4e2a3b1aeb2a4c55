"""Some rows of a recording, which show whether its torque is the torque of the arm."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np

from hil.archive import Archive
from hil.cell import Cell
from hil.look.other_arm import Contradictions
from hil.look.readings import ExplainedTorque
from hil.pipeline.sources import cell_of, source_of
from identification.errors import IdentificationError
from identification.estimators.torque_channel import possible_low_passes
from identification.hypotheses.diagnosis import (
    UNEXPLAINED,
    TorqueDiagnosis,
    few_rows,
    torque_of,
    with_readings,
)
from identification.hypotheses.scores import Score, fits_alike, score_of
from identification.hypotheses.springs import may_have_springs, score_with_springs
from identification.model.robot import RobotModel
from identification.signals.position_steps import PositionJump, position_steps
from identification.signals.recording import RIGID_RATE, Recording
from identification.signals.samples import Preprocessing, Samples, Smoothed, prepare

SETTINGS: Final = Preprocessing(14.0, exclude_rows="rests")
"""Preparation of a recording whose readings are compared."""
SUSPECT_ERROR: Final = 0.15
"""Error of the torque, predicted from other parts, above which a log is looked at closely. Right
logs of four real arms have 0.04 to 0.11, with URDFs of other arms 0.09 to 1.1."""
# of the error, that a low-pass or heavy rotors leave where they are there
_EXPLAINED_ERROR_RATIO: Final = 0.5
_DRIVING_FRICTION_SIGMAS: Final = -4.0  # standard errors of a friction that drives a joint


def prepared(recording: Recording, model: RobotModel) -> Samples:
    """Return a recording prepared for a comparison of its readings."""
    return prepare(recording.averaged(RIGID_RATE), model, options=SETTINGS)


@dataclass(frozen=True, eq=False)
class TorqueSample:
    """Rows of a recording, with their score.

    Attributes:
        cell: of the arm.
        samples: of the recording.
        rows: some of them.
        score: of these.
        jumps: steps of the positions that no arm makes.
    """

    cell: Cell
    samples: Samples
    rows: Samples
    score: Score
    jumps: tuple[PositionJump, ...] = ()

    @classmethod
    def of(cls, archive: Archive) -> TorqueSample | None:
        """Return the rows of an archive; None if they cannot be used."""
        cell = cell_of(archive)
        try:
            source = source_of(archive, cell)
            samples = prepared(source.recording, cell.model)
            rows = few_rows([samples])
            if not rows.usable.any():
                return None  # nothing moves
            jumps = position_steps(source.recording, source.name).jumps
            return cls(cell, samples, rows, score_of(cell.model, rows), jumps)
        except (IdentificationError, ValueError):
            return None  # the identification says what is wrong

    def diagnosis(self) -> TorqueDiagnosis:
        """Return what the torque is as a whole, and the joints where it follows the arm."""
        model = self.cell.model
        found = torque_of(model, [self.samples], self.rows, self.score)
        if self._is_far:
            return found
        return with_readings(found, model, self.rows, self.score)

    @property
    def _is_far(self) -> bool:
        return self.score.overall > SUSPECT_ERROR or bool(
            np.any(self.score.friction < _DRIVING_FRICTION_SIGMAS)
        )

    @property
    def is_unexplained_by_jumps(self) -> bool:
        """Whether positions jump, so that torque that does not follow them says nothing more."""
        return bool(self.jumps) and self._is_far

    def is_suspect(self, found: TorqueDiagnosis) -> bool:
        """Return whether the torque does not follow the arm as it is read.

        Joints of a wrist have so little torque that the error of all hides theirs.
        """
        return self._is_far or any(step.sure for step in (*found.zeros, *found.discrete))

    def contradictions(
        self,
        score: Score | None = None,
        error: float | None = None,
        changed: Sequence[str] = (),
    ) -> Contradictions:
        """Return what contradicts the arm, by default with the score as read and its error."""
        score = self.score if score is None else score
        error = score.overall if error is None else error
        return Contradictions.of(self.cell, self.cell.model, self.rows, score, error, changed)


class Explained(NamedTuple):
    """Score of a torque through a low-pass, or with heavy rotors or springs."""

    score: Score
    how: ExplainedTorque


def explained(archive: Archive) -> Explained | None:
    """Return how a low-pass or heavy rotors explain the torque as it is read; None: they do not.

    They explain it if they halve the error of the same rows, and no friction drives a joint. Other
    units, signs and orders are searched without them, and may then seem to fit.
    """
    cell = cell_of(archive)
    model = cell.model
    try:
        recording = source_of(archive, cell).recording.averaged(RIGID_RATE)
        motions: dict[Preprocessing, Smoothed] = {}
        unfiltered = prepare(recording, model, options=SETTINGS, motions=motions)
        least = min(UNEXPLAINED, _EXPLAINED_ERROR_RATIO * score_of(model, unfiltered).overall)
        low_passes = possible_low_passes(recording, model, options=SETTINGS)
        for how in (*low_passes, SETTINGS):
            samples = prepare(recording, model, options=how, motions=motions)
            for wide_rotors in (False, True) if how is not SETTINGS else (True,):
                score = score_of(model, samples, wide_rotors=wide_rotors)
                if 0.0 < score.overall < least and not score.driven.any():
                    found = ExplainedTorque(how.torque_bandwidth, heavy_rotors=wide_rotors)
                    return Explained(score, found)
    except (IdentificationError, ValueError):
        pass  # the identification says what is wrong
    return None


def explained_by_springs(model: RobotModel, rows: Samples, score: Score) -> Explained | None:
    """Return how springs of as few joints as possible explain a torque; None: they do not.

    They do as a low-pass does, see `explained`.

    Args:
        model: of the arm.
        rows: some of the recording, as read.
        score: of these.
    """
    least = min(UNEXPLAINED, _EXPLAINED_ERROR_RATIO * score.overall)
    joints = may_have_springs(model, rows)
    every = score_with_springs(model, rows, joints)
    if every is None or not 0.0 < every.overall < least or every.driven.any():
        return None
    best = every
    for joint in joints:
        fewer = tuple(each for each in joints if each != joint)
        without = score_with_springs(model, rows, fewer)
        if without is not None and fits_alike(without, every, model):
            joints, best = fewer, without
    names = tuple(model.joint_names[joint] for joint in joints)
    return Explained(best, ExplainedTorque(None, heavy_rotors=False, springs=names))
