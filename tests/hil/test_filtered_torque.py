"""Logs of torque that has come through a low-pass, read with everything but that fixed."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import butter, sosfilt, sosfiltfilt

from hil.identify.options import FIXED, Options
from hil.identify.prepared import Prepared, prepare_sources
from hil.identify.settings import stated_settings
from hil.identify.sources import gather_sources
from hil.importers import ColumnMap, Quantity, Robot, TimeColumn, import_log
from hil.progress import Silent
from identification import FrictionLaw, estimate, prediction_error
from identification.factor.factor import Factor
from tests.hil.simulated_logs import simulate

RATE = 125.0  # Hz
BANDWIDTH = 4.0  # Hz
OPTIONS = replace(FIXED, delay=None, torque_bandwidth="auto")
COLUMNS = ColumnMap(
    time=TimeColumn(column="time"),
    position=Quantity(columns="position", joints_along="columns"),
    torque=Quantity(columns="torque", joints_along="columns"),
)


def prepared(
    folder: Path, order: int | None, *, causal: bool = False, options: Options = OPTIONS
) -> Prepared:
    """A log of a UR5, its torque through a Butterworth low-pass."""
    log = simulate("ur5_robot.urdf", np.arange(0.0, 24.0, 1.0 / RATE), pace=2.0)
    torque = log.torque
    if order is not None:
        sections = butter(order, BANDWIDTH, fs=RATE, output="sos")
        torque = (sosfilt if causal else sosfiltfilt)(sections, torque, axis=0)
    np.savez(folder / "log.npz", time=log.time, position=log.position, torque=torque)
    robot = Robot.from_urdf(
        log.urdf, friction=FrictionLaw(third=None, offset=True, standstill=0.02)
    )
    archive = import_log(folder / "log.npz", folder / "log.mcap", robot=robot, columns=COLUMNS)
    return prepare_sources(gather_sources([archive], 0.7), options, Silent())


def held_out_error(found: Prepared) -> float:
    model = found.sources.cell.model
    values = estimate(model, Factor.of(model, found.fitted[0])).values
    (error,) = prediction_error(model, values, found.held_out, all_rows=True)
    return error.overall


@pytest.fixture(scope="module")
def unfiltered(tmp_path_factory: pytest.TempPathFactory) -> Prepared:
    return prepared(tmp_path_factory.mktemp("unfiltered"), None)


class TestFilteredTorque:
    def test_none_is_claimed_without_one(self, unfiltered: Prepared) -> None:
        assert unfiltered.settings.preprocessing.torque_bandwidth is None

    @pytest.mark.parametrize("order", [1, 4])
    def test_without_phase(self, tmp_path: Path, order: int, unfiltered: Prepared) -> None:
        found = prepared(tmp_path, order)
        assert found.settings.preprocessing.torque_bandwidth == pytest.approx(BANDWIDTH, rel=0.2)
        assert held_out_error(found) < 1.3 * held_out_error(unfiltered)

    @pytest.mark.parametrize("order", [1, 2])
    def test_a_lag_is_no_delay(self, tmp_path: Path, order: int, unfiltered: Prepared) -> None:
        """A low-pass that runs forwards lags by some ten ms, which are not taken for a delay."""
        found = prepared(tmp_path, order, causal=True)
        assert found.settings.preprocessing.torque_bandwidth == pytest.approx(BANDWIDTH, rel=0.2)
        assert found.settings.preprocessing.torque_shape.causal
        assert found.settings.preprocessing.torque_delay == 0.0
        assert found.delays is None
        assert held_out_error(found) < 1.3 * held_out_error(unfiltered)


class TestFixedOptions:
    def test_nothing_is_decided(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        def never(*_: object, **__: object) -> None:
            raise AssertionError("something was asked")

        for name in ("choose_settings", "estimate_delays", "possible_low_passes"):
            monkeypatch.setattr(f"hil.identify.settings.{name}", never)
        found = prepared(tmp_path, 2, causal=True, options=FIXED)
        assert found.settings == stated_settings(found.sources.cell, FIXED)
