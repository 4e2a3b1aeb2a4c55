"""The table of errors by joint."""

import pytest

from hil.results.error_columns import rms_error
from hil.results.results import JointJudgement


def judged(rms: float, relative: float | None) -> JointJudgement:
    return JointJudgement(
        joint="elbow",
        unit="N·m",
        rms=rms,
        relative=relative,
        explained=None,
        limit=None,
        share_of_limit=None,
        nominal_relative=None,
        controller_relative=None,
    )


@pytest.mark.parametrize(
    ("rms", "relative", "shown"),
    [(3.79, 0.119, "3.79 N·m"), (0.2, None, "0.2 N·m"), (0.0, 0.0, "0 N·m"), (0.0, None, "-")],
)
def test_a_joint_that_did_not_move_has_no_error(
    rms: float, relative: float | None, shown: str
) -> None:
    assert rms_error(judged(rms, relative)) == shown
