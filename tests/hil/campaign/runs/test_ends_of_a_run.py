"""Time left, a full disk, a stop."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import hil.base.files
from hil.base.errors import OutputError
from hil.campaign.operator import RunStatus
from hil.control.errors import MotionFailedError
from hil.control.motion_watch import OperatorRequest, Stop
from hil.control.simulated_cell import simulated_link
from tests.hil.campaign.runs.rig import Make, Operator, kinds

pytestmark = pytest.mark.safety


@pytest.mark.usefixtures("shown_in_virtual_time")
@pytest.mark.parametrize("warmup_drift", [0.0, 0.002])
@pytest.mark.parametrize("first_repetitions", [0, 3])
def test_the_time_left_is_right_and_counts_down(
    make: Make, warmup_drift: float, first_repetitions: int
) -> None:
    """Within a fifth after the first tenth, with a dry run, and where an earlier run is resumed."""
    campaign = make(repetitions=6, warmup_drift=warmup_drift)
    stop = Stop()
    if first_repetitions:

        def stopping(status: RunStatus) -> OperatorRequest:
            begun = status.phase == "repetition" and status.number > first_repetitions
            stop.requested = stop.requested or begun
            return OperatorRequest()

        with pytest.raises(MotionFailedError, match="stopped"):
            campaign.run(stop=stop, operator=Operator(stopping), durable=False)
    link = simulated_link(campaign.cell)
    estimates = list[tuple[float, float]]()

    class Clock(Operator):
        def show(self, status: RunStatus) -> None:
            estimates.append((link.port.now, status.time_left))

    campaign.run(link, operator=Clock(), durable=False)
    now, left = np.array(estimates).T
    true = now[-1] - now
    settled = now - now[0] > 0.1 * (now[-1] - now[0])
    assert settled.sum() >= 10
    off = np.abs(left - true)[settled] / (0.2 * true[settled] + 1.0)
    assert off.max() < 1.0, (true[settled][off.argmax()], left[settled][off.argmax()])
    learned = np.diff(now).max()  # since the last update: it arrives at once
    assert np.diff(left[settled]).max() < 0.1 * true[0] + learned


@pytest.mark.parametrize("name", ["dry_run.json", "warmup.json"])
def test_a_full_disk_is_named(make: Make, monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    drift = 1e-9 if name == "warmup.json" else 0.0
    campaign = make(warmup_drift=drift, warmup_least=3, warmup_most=3)
    write = hil.base.files._write_through

    def full(path: Path, content: str | bytes) -> None:
        if path.name.startswith(name):
            raise OSError(28, "No space left on device")
        write(path, content)

    monkeypatch.setattr(hil.base.files, "_write_through", full)
    with pytest.raises(OutputError, match=rf"{name} cannot be written \(No space left"):
        campaign.run(accept_dry_run=True)
    monkeypatch.undo()
    again = campaign.run(accept_dry_run=True)
    assert again.complete
    assert "dryrun" not in kinds(again)
