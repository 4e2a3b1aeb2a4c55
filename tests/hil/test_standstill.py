"""When an arm that the controller moves counts as being at rest."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from drivers.record import cycle_dtype
from hil.archive import open_archive
from hil.campaign.live_link import Standstill
from hil.testing import faulty_link
from tests.hil.fast_cell import fast_campaign, fast_cell

PERIOD = 0.002
SECOND = round(1.0 / PERIOD)


def records(
    first: int, count: int, velocity: float = 0.0, noise: float = 0.0, *, known: bool = True
) -> NDArray[np.void]:
    rows = np.zeros(count, cycle_dtype(2))
    rows["cycle"] = first + np.arange(count)
    rows["target_position"][:, 1] = velocity * PERIOD * rows["cycle"]
    rows["position"] = rows["target_position"] + noise * (-1.0) ** rows["cycle"][:, None]
    if not known:
        rows["position"][:, 0] = np.nan
    return rows


def test_a_second_without_motion_is_rest_and_less_is_not() -> None:
    still = Standstill(PERIOD)
    assert not still.take(records(0, SECOND))
    assert still.take(records(SECOND, 1))


def test_a_creeping_arm_is_not_at_rest() -> None:
    assert not Standstill(PERIOD).take(records(0, 10 * SECOND, velocity=1e-4))


def test_the_noise_of_an_encoder_is_no_motion() -> None:
    assert Standstill(PERIOD).take(records(0, SECOND + 1, noise=1e-4))


def test_motion_begins_the_second_anew() -> None:
    still = Standstill(PERIOD)
    assert not still.take(np.concatenate([records(0, SECOND - 5), records(SECOND - 5, 10, 0.5)]))
    assert not still.take(records(SECOND + 5, SECOND))
    assert still.take(records(2 * SECOND + 5, 10))


def test_an_arm_that_is_not_seen_counts_as_moving() -> None:
    assert not Standstill(PERIOD).take(records(0, 5 * SECOND, known=False))


def test_a_controller_that_starts_anew_begins_the_second_anew() -> None:
    still = Standstill(PERIOD)
    still.take(records(10_000, 10))
    assert not still.take(records(0, 10))


def test_a_recording_of_the_noise_in_which_the_arm_moved_is_made_again(tmp_path: Path) -> None:
    cell = fast_cell(tmp_path)
    quiet = fast_campaign(tmp_path / "quiet", cell)
    assert not quiet.run(unrehearsed=True).rejected
    (archive,) = quiet.folder.completed("standstill")
    cycle = int(open_archive(archive).columns["cycle"].mean())

    pushed = fast_campaign(tmp_path / "pushed", cell)
    result = pushed.run(faulty_link(cell, f"push@{cycle}x20:axis=1"), unrehearsed=True)
    assert [one.archive for one in result.rejected] == ["standstill_000_a1.mcap"]
    assert re.search(
        r"moved at .* rad/s while the arm was to stand still", result.rejected[0].reason
    )
    assert [path.name for path in pushed.folder.completed("standstill")] == [
        "standstill_000_a2.mcap"
    ]
