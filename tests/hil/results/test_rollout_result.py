"""What the result of a rollout says, and that of drawn arms."""

from pathlib import Path

import numpy as np
import pytest

from hil.export.model_files import ExportedEnsemble
from hil.results.rollout_result import ArmErrors, PolishResult, RolloutResult
from identification.estimators.ensemble import Ensemble

LIGHT = ArmErrors(
    joints=[[1e-3, 8e-3], [2e-3, 2e-2], [5e-3, 4e-2], [1e-2, 6e-2]],
    tool=[1e-3] * 4,
    unstable=0,
    unstable_joints=[0, 0],
)
CONTINUED = [3e-3, 1e-2, 7e-2, 0.2]  # rad


def a_result(**changes) -> RolloutResult:
    """A second joint that is light: far off at first, and not later."""
    fields = {
        "cell": "arm", "simulated": True, "joint_names": ["a", "b"], "units": ["rad", "rad"],
        "parameters": "", "drive": "the recorded torque", "tool": "b", "windows": 9, "step": 5e-3,
        "horizons": [0.1, 0.2, 0.5, 1.0], "identified": LIGHT, "nominal": None, "no_nominal": "-",
        "samples": 0, "seed": 1, "sample_errors": [], "widened": 1.0, "inside": [],
        "leading_joint": "b", "leading_effect": "", "polish": None, "notes": [],
        "continued": CONTINUED,
    }  # fmt: skip
    return RolloutResult(**(fields | changes))  # type: ignore[arg-type]


class TestPolishAdvice:
    def test_is_given_where_joints_that_continue_are_nearer(self) -> None:
        message = a_result().message
        assert "At 0.1 s it is further off than joints that continue" in message
        assert "(5.7 against 3 mrad): --polish" in message

    def test_not_where_the_arm_is_nearer(self) -> None:
        assert "--polish" not in a_result(continued=[6e-3, 1e-2, 7e-2, 0.2]).message

    def test_nor_of_a_result_without_that_figure(self) -> None:
        assert "--polish" not in a_result(continued=[]).message

    def test_nor_after_a_polish(self) -> None:
        polish = PolishResult(
            accepted=True, reason="Used.", windows=9, change=-0.1, errors=LIGHT, parameters=[]
        )
        message = a_result(polish=polish).message
        assert message.endswith("Used.")
        assert "--polish" not in message


@pytest.mark.parametrize(
    ("count", "spread", "said"),
    [
        (20, 1.01, ""),
        (
            20,
            0.4,
            "warning: the nearest physically consistent arms do not scatter",
        ),
        (3, 0.6, "the spread of fewer than 10 arms is mostly chance"),
    ],
)
def test_drawn_arms_that_vary_otherwise_are_named(count: int, spread: float, said: str) -> None:
    arms = Ensemble(
        np.zeros((count, 1)), np.zeros((count, 1)), np.zeros(count, np.bool_), np.array([spread]), 1
    )
    exported = ExportedEnsemble(Path("arms"), arms, 1, ("a",), 1e-15, "The model is good.")
    text = "\n".join(exported.lines())
    assert said in text
    assert ("chance" in text or "warning" in text) == bool(said)
