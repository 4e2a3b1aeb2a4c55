"""An arm to be exported."""

import numpy as np

from identification.export.exported_arm import ExportedArm
from identification.model.joint_ranges import JointRanges
from identification.model.robot import RobotModel
from tests.identification.robots import some_bodies

WRIST = np.eye(6)
WRIST[5, 4] = 0.5


def an_arm(urdf, **options):
    """Random consistent bodies, and friction of all kinds."""
    model = RobotModel.from_urdf(urdf, **options)
    n = model.n_joints
    standard = np.zeros(model.layout.size)
    standard[: 11 * n] = some_bodies(n)
    standard[model.layout.rotors] += 1.0
    for k, (i, j) in enumerate(model.layout.pairs):
        rotors = model.layout.rotors[[i, j]]
        standard[model.layout.couplings[k]] = 0.3 * np.sqrt(np.prod(standard[rotors]))
    others = np.random.default_rng(1).uniform(0.5, 2.5, model.n_parameters - model.base.rank)
    values = np.concatenate([model.base.grouping @ standard, others])
    infinite = np.full(n, np.inf)
    return ExportedArm(
        urdf, model, standard, values, JointRanges(-infinite, infinite, infinite, infinite)
    )
