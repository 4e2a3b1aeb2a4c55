"""A small arm whose searches take a second, and a genome with motions that fail."""

from __future__ import annotations

import os
import time
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from identification import RobotModel
from identification.excitation import Constraints, Objective, Problem, ViaPointGenome
from planner import JointLimits, PlanningError
from tests.identification.two_link import URDF

VELOCITY = np.array([3.0, 4.0])
LIMITS = JointLimits([-2.0, -2.5], [2.0, 2.5], VELOCITY, VELOCITY / 0.3, VELOCITY / 0.03)

DEG = np.pi / 180.0
NS16_HOME = DEG * np.array([0.0, -90.0, 180.0, 0.0, 90.0, 0.0])
NS16_VELOCITY = DEG * np.array([155.0, 155.0, 170.0, 360.0, 350.0, 550.0])
NS16_LIMITS = JointLimits(
    DEG * np.array([-180.0, -140.0, -20.0, -360.0, -120.0, -360.0]),
    DEG * np.array([180.0, 5.0, 260.0, 360.0, 120.0, 360.0]),
    NS16_VELOCITY,
    NS16_VELOCITY / 0.3,
    NS16_VELOCITY / 0.03,
)


def problem(genome=None, **constraints):
    """Three via points of a two-joint arm, 13 parameters."""
    return Problem(
        genome or ViaPointGenome(LIMITS, n_via=3),
        Objective(RobotModel.from_urdf(URDF)),
        Constraints(**{"limits": LIMITS, "max_duration": 20.0, **constraints}),
    )


@dataclass(frozen=True, eq=False)
class FaultyGenome:
    """Via points; some values of the first gene crash, delay or fail the planning."""

    inner: ViaPointGenome
    crash: tuple[float, float] = (2.0, 2.0)
    hang: tuple[float, float] = (2.0, 2.0)
    refuse: tuple[float, float] = (2.0, 2.0)
    elbow_at_rest: bool = False

    @property
    def n_genes(self):
        return self.inner.n_genes

    def motions(self, genes):
        if np.any(self.within(genes, self.crash)):
            os.abort()
        if np.any(self.within(genes, self.hang)):
            time.sleep(60.0)
        if self.elbow_at_rest:
            genes = genes.copy()
            genes[:, 1:-2:2] = 0.5
        motions: list[Any] = self.inner.motions(genes)
        for index in np.flatnonzero(self.within(genes, self.refuse)):
            motions[index] = PlanningError("planning failed")
        return motions

    def sample(self, random, count):
        return self.inner.sample(random, count)

    def source(self, *args):
        return self.inner.source(*args)

    @staticmethod
    def within(genes, bounds):
        return (genes[:, 0] >= bounds[0]) & (genes[:, 0] <= bounds[1])


def faulty(**faults):
    return replace(FaultyGenome(ViaPointGenome(LIMITS, n_via=3)), **faults)


def bits(design):
    """Return the fields of a design, arrays as bytes."""
    fields = vars(design) | {"genes": design.genes.tobytes()}
    fields["excitation"] = design.excitation.to_dict()
    fields["front"] = [
        array.tobytes()
        for array in (design.front.genes, design.front.measures, design.front.duration)
    ]
    return fields
