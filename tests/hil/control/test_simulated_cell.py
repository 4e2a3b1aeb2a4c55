"""What an archive says of the simulated arm that it is from."""

import json

from hil.cell import Cell
from hil.control.simulated_cell import simulated_provenance
from sim_fixtures.ns16 import CELL_PATH


def test_elasticity_is_named_by_joint() -> None:
    effects = json.loads(simulated_provenance(Cell.load(CELL_PATH), effects=True)["effects"])
    assert (
        "elasticity of joint_1 5e-07, joint_2 5e-07, joint_3 1.25e-06, joint_4 0, joint_5 0,"
        " joint_6 0 rad/(N·m)"
    ) in effects
    assert simulated_provenance(Cell.load(CELL_PATH), effects=False)["effects"] == "[]"
