"""What a log records, by channel: name, unit, rate, and the quantity that its name says."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from hil.importers.channels import channels_of, kind_of
from hil.importers.column_map import ColumnMap, ready_maps
from hil.importers.stamps import without_restarts
from hil.importers.units import unit_of
from identification.signals.recording import PAUSE_SECONDS
from tests.hil.importers.bag_messages import WHOLE
from tests.hil.importers.bags import DEFINITION, STATE, bag, drives, mcap
from tests.hil.importers.moving_log import COUNT, JOINTS, NAMES, POSITION, RATE, TIME, rows, text

NAMED = {
    "q1": ("position", 1), "q[0]": ("position", 0), "actual_q_5": ("position", 5),
    "state.dq[3]": ("velocity", 3), "tau_J[2]": ("torque", 2), "M1 [Nm]": ("torque", 1),
    "joint_states/effort": ("torque", None), "AIPos.A3": ("position", 3),
    "GearTorque.A1": ("torque", 1), "actual_current_0": ("motor_current", 0),
    "Zeit [s]": ("time", None), "IPOC": ("time", None), "axis 3 (deg)": ("position", 3),
    "axis 3 (A)": ("motor_current", 3), "field.header.stamp": (None, None),
    "temperature1": (None, 1), "Joint_1": (None, 1), "target_positions": (None, None),
}  # fmt: skip


@pytest.mark.parametrize("name", NAMED)
def test_names_say_quantity_and_number(name: str) -> None:
    units = {"axis 3 (deg)": "deg", "axis 3 (A)": "A"}
    assert kind_of(name, units.get(name)) == NAMED[name]


@pytest.mark.parametrize("spelled", ["N.m", "Nm", "N·m", "N m"])
def test_units_of_torque_have_one_spelling_with_every_prefix(spelled: str) -> None:
    assert [unit_of(prefix + spelled) for prefix in ("", "m", "k")] == ["N.m", "mN.m", "kN.m"]


def test_columns_of_the_ready_maps_are_known_by_name() -> None:
    for name in ready_maps():
        for kind, quantity in ColumnMap.load(name).quantities().items():
            assert kind_of(str(quantity.columns).replace("{}", "1")) == (kind, 1), name


def test_a_table_has_a_channel_for_each_column(tmp_path: Path) -> None:
    below = ["ms", "deg", "deg", "deg", "Nm", "Nm", "Nm"]
    body = rows(time=[f"{1e3 * t:.3f}" for t in TIME])
    (tmp_path / "a.csv").write_text(text(body, head=[NAMES, below]))
    channels = channels_of(tmp_path / "a.csv")
    assert [channel.name for channel in channels] == NAMES
    assert [channel.unit for channel in channels] == ["ms", *["deg"] * 3, *["N.m"] * 3]
    assert [channel.kind for channel in channels] == ["time", *["position"] * 3, *["torque"] * 3]
    assert {channel.samples for channel in channels} == {COUNT}
    assert channels[3].rate == pytest.approx(RATE)


def test_arrays_have_size_type_and_rate(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", t=TIME, q=POSITION.T.astype(np.float32), other=np.zeros(7))
    by_name = {channel.name: channel for channel in channels_of(tmp_path / "a.npz")}
    q = by_name["q"]
    assert (q.size, q.samples, q.dtype, q.kind) == (3, COUNT, "float32", "position")
    assert q.rate == pytest.approx(RATE)
    assert by_name["other"].rate is None


@pytest.mark.parametrize("suffix", ["db3", "mcap"])
def test_joint_states_name_their_joints(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"x.{suffix}"
    if suffix == "db3":
        bag(path, {"/joint_states": (STATE, WHOLE)})
    else:
        mcap(path, {"/joint_states": (STATE, DEFINITION, "cdr", WHOLE)})
    channels = channels_of(path)
    assert [channel.kind for channel in channels] == ["position", "velocity", "torque"]
    assert {channel.joints for channel in channels} == {JOINTS}
    assert channels[0].name == "/joint_states/position"
    assert channels[0].rate == pytest.approx(RATE)


def test_other_messages_have_a_channel_for_each_field(tmp_path: Path) -> None:
    names = [channel.name for channel in channels_of(drives(tmp_path / "x.mcap"))]
    assert "/drives/drives/1/angle" in names


def test_motions_of_a_clock_that_begins_again_are_no_late_rows() -> None:
    """Rows of one motion are late for `PAUSE_SECONDS` at most."""
    part = np.arange(500, dtype=np.int64) * 8_000_000
    found = without_restarts(np.concatenate([part, part]))
    assert found.restarted is not None
    steps = np.diff(found.stamp)
    assert np.count_nonzero(steps > 1e9 * PAUSE_SECONDS) == 1
    assert np.median(steps) == 8_000_000
