"""Series of the report as an identification computes them."""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest

from hil.identify import Identification, identify_archives
from hil.identify.options import FIXED
from hil.importers import ColumnMap, Robot, import_log
from hil.outcome import _load_series, _series_bytes
from hil.progress import Silent
from tests.hil.simulated_logs import simulate

# The arm of the log starts without acceleration, which no rigid body does: slow rows are left out.
OPTIONS = replace(
    FIXED, friction={"presliding": 1e-4, "third": "none"}, delay=0.0, standstill="slow"
)
N = 6


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An imported UR5, which rests for two seconds before it moves."""
    folder = tmp_path_factory.mktemp("log")
    time = np.arange(0.0, 10.0, 8e-3)
    made = simulate("ur5_robot.urdf", time, noise=0.3)
    rest = np.arange(-250, 0)[:, None]
    columns = np.column_stack([time, made.position, made.torque])
    still = np.repeat(columns[:1], 250, axis=0)
    still[:, :1] = 8e-3 * rest
    np.savetxt(folder / "log.csv", np.concatenate([still, columns]))
    (folder / "map.toml").write_text(
        "[time]\ncolumn = 0\n[position]\ncolumns = [1, 2, 3, 4, 5, 6]\n"
        "[torque]\ncolumns = [7, 8, 9, 10, 11, 12]\n"
    )
    return import_log(
        folder / "log.csv",
        folder / "log.mcap",
        robot=Robot.from_urdf(made.urdf),
        columns=ColumnMap.load(folder / "map.toml"),
    )


@pytest.fixture(scope="module")
def found(log: Path) -> Identification:
    return identify_archives([log], Silent(), OPTIONS)


class TestReportSeries:
    """What `hil identify` computes for the figures."""

    def test_split_adds_up_to_the_prediction(self, found: Identification) -> None:
        one = found.series
        parts = (
            one.example_inertia,
            one.example_coriolis,
            one.example_gravity,
            one.example_friction,
        )
        np.testing.assert_allclose(sum(parts), one.example_predicted, atol=1e-6)

    def test_says_which_rows_were_fitted(self, found: Identification) -> None:
        """Rest is shown for a second, and is not fitted."""
        one = found.series
        first = np.argmax(one.excitation_fitted.any(axis=1))
        rest = one.excitation_time[first] - one.excitation_time[0]
        assert 0.9 < rest < 1.1
        assert 0.3 < one.excitation_fitted.mean() < 1.0
        assert set(np.unique(one.example_used)) <= {0.0, 1.0}

    def test_friction_data_lie_around_the_law(self, found: Identification) -> None:
        one = found.series
        for j in range(N):
            known = np.isfinite(one.friction_speed[:, j])
            assert known.sum() > 100
            speed, torque = one.friction_speed[known, j], one.friction_torque[known, j]
            law = np.interp(speed, one.law_speed[:, j], one.law_torque[:, j])
            sliding = np.abs(speed) > 0.05
            fitted = found.results.noise_std[j]
            assert np.std((torque - law)[sliding]) < 2.0 * fitted

    def test_dry_friction_turns_round(self, found: Identification) -> None:
        one = found.series
        assert np.isfinite(one.reversal_travel).all()
        assert one.reversal_travel[-1] == pytest.approx(6e-4)

    def test_residual_is_smaller_than_the_torque_where_it_moves(
        self, found: Identification
    ) -> None:
        one = found.series
        slow = one.spectrum_frequency < 2.0
        assert (one.spectrum_residual[slow] < one.spectrum_torque[slow]).mean() > 0.95

    def test_survives_the_folder_of_results(self, found: Identification, tmp_path: Path) -> None:
        (tmp_path / "series.npz").write_bytes(_series_bytes(found.series))
        loaded = _load_series(tmp_path / "series.npz", N)
        for name, values in asdict(found.series).items():
            np.testing.assert_array_equal(getattr(loaded, name), values)

    def test_shows_what_was_fitted_where_nothing_is_held_out(self, log: Path) -> None:
        whole = identify_archives([log], Silent(), replace(OPTIONS, in_sample=True))
        one = whole.series
        np.testing.assert_array_equal(one.example_time, one.excitation_time)
