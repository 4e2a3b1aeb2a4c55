from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.study_fits import GROSS, SHARES, Fit, Study, disturbed, noisier
from benchmarks.study_recordings import (
    EFFECTS,
    Kept,
    excitation_path,
    record_excitation,
    study_cell,
    study_plan,
)
from benchmarks.study_tables import Covered, coverage_table, markdown, size_table
from hil.simulation import planted_values
from identification.estimators.least_squares import estimate
from identification.factor.factor import Factor
from identification.model.friction import FrictionLaw
from identification.model.robot import RobotModel
from identification.signals.recording import Recording
from identification.signals.samples import Preprocessing, prepare
from tests.benchmarks import by_pinocchio

SAMPLES, JOINTS = 20_000, 6


@pytest.fixture(scope="module")
def kept() -> Kept:
    time = np.arange(SAMPLES) * 1e-3
    recording = Recording(
        time=time,
        position=np.sin(time)[:, None] * np.ones(JOINTS),
        joint_names=tuple(f"joint_{k}" for k in range(1, JOINTS + 1)),
        torque=np.zeros((SAMPLES, JOINTS)),
        commanded_position=np.zeros((SAMPLES, JOINTS)),
    )
    return Kept(recording, np.linspace(1.0, 6.0, JOINTS) * 1e-13, np.full(JOINTS, 4.0), 0.5)


@pytest.fixture(scope="module")
def study() -> Study:
    """A study whose validation motion weighs all parameters alike."""
    cell = study_cell()
    model = cell.model
    gram = np.broadcast_to(np.eye(model.n_parameters + 1), Factor.zero(model).gram.shape).copy()
    rows = np.full(model.n_joints, 1000)
    factor = Factor(gram, rows, model.parameter_names)
    return Study(model, planted_values(cell), Preprocessing(), factor)


class TestDisturbances:
    @pytest.mark.parametrize("times", [10.0, 1000.0])
    def test_noise_of_the_log_is_so_many_times_that_of_the_encoders(
        self, kept: Kept, times: float
    ) -> None:
        noisy = noisier(kept, times, seed=1)
        added = noisy.recording.position - kept.recording.position
        expected = np.sqrt(times**2 - 1.0) * np.sqrt(kept.noise_variance)
        np.testing.assert_allclose(added.std(axis=0), expected, rtol=0.03)
        np.testing.assert_allclose(noisy.noise_variance, times**2 * kept.noise_variance)

    def test_once_the_noise_is_the_recording_itself(self, kept: Kept) -> None:
        assert noisier(kept, 1.0, seed=1) is kept

    @pytest.mark.parametrize("kind", ["spikes", "bursts"])
    def test_so_many_rows_are_off_by_so_much(self, kept: Kept, kind: str) -> None:
        torque = disturbed(np.zeros((SAMPLES, JOINTS)), kept, kind, seed=2)  # type: ignore[arg-type]
        hit = torque != 0.0
        np.testing.assert_allclose(np.abs(torque[hit]), GROSS * 2.0)
        # Bursts may overlap.
        assert hit.mean() == pytest.approx(SHARES[kind], rel=0.1)
        assert (torque > 0.0).any() and (torque < 0.0).any()

    def test_without_a_disturbance_the_torque_stays(self, kept: Kept) -> None:
        torque = np.ones((SAMPLES, JOINTS))
        assert (disturbed(torque, kept, "none", seed=2) == torque).all()


def drawn(study: Study, seeds: int, *, bias: float = 0.0, told: float = 1.0) -> Sequence[Covered]:
    """Estimates of standard deviation 1 that tell `told`; the first is off by `bias`."""
    random = np.random.default_rng(3)
    p = study.model.n_parameters
    rows = []
    for _ in range(seeds):
        values = study.truth + random.standard_normal(p)
        values[0] += bias
        half = np.full(p, 1.96 * told)
        rows.append(Covered(Fit(values, half, 0.0, 0.0), half / 2.0))
    return rows


class TestCoverage:
    def test_honest_intervals_cover_what_they_say(self, study: Study) -> None:
        table = coverage_table(study, drawn(study, 400))
        # 58 x 400 draws: the standard deviation of the mean is 0.14 %.
        assert table["coverage"] == pytest.approx(0.95, abs=0.006)
        assert table["parameters_below_90"] == 0
        assert table["reported_over_actual"] == pytest.approx(1.0, abs=0.03)
        assert table["classical_coverage"] == pytest.approx(0.673, abs=0.012)

    def test_intervals_half_as_wide_are_found_out(self, study: Study) -> None:
        table = coverage_table(study, drawn(study, 400, told=0.5))
        assert table["coverage"] == pytest.approx(0.673, abs=0.012)
        assert table["reported_over_actual"] == pytest.approx(0.5, abs=0.02)

    def test_a_bias_is_named(self, study: Study) -> None:
        table = coverage_table(study, drawn(study, 400, bias=3.0))
        worst = table["worst"][0]
        assert worst["name"] == study.model.parameter_names[0]
        assert worst["bias_over_std"] == pytest.approx(3.0, abs=0.3)
        assert worst["reported_over_actual"] == pytest.approx(1.0, abs=0.15)
        assert worst["name"] in markdown("coverage", table)


def test_a_test_of_the_right_size_rejects_one_time_in_twenty() -> None:
    p = (np.arange(1000) + 0.5) / 1000
    assert size_table(p.tolist())["rejected_at_5"] == 0.05


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("study")


@pytest.fixture(scope="module")
def recorded(folder: Path) -> Path:
    cell = study_cell()
    record_excitation(folder, cell, study_plan(folder, cell), 7, "clean")
    return excitation_path(folder, 7, "clean")


class TestRecordings:
    @pytest.mark.slow
    def test_a_seed_is_one_recording_of_the_whole_excitation(
        self, folder: Path, recorded: Path
    ) -> None:
        cell = study_cell()
        one = Kept.load(recorded)
        duration = study_plan(folder, cell).excitation.trajectory.duration
        assert one.recording.joint_names == cell.joint_names
        assert one.recording.time[-1] - one.origin >= duration
        assert np.isfinite(one.recording.commanded_position).all()
        assert (one.noise_variance > 0.0).all() and (one.torque_variance > 0.0).all()

    def test_what_is_there_is_not_made_again(self, folder: Path, recorded: Path) -> None:
        before = recorded.stat().st_mtime_ns
        cell = study_cell()
        record_excitation(folder, cell, study_plan(folder, cell), 7, "clean")
        assert recorded.stat().st_mtime_ns == before
        assert not list(folder.glob("*.part"))

    def test_what_was_kept_comes_back(self, recorded: Path, tmp_path: Path) -> None:
        one = Kept.load(recorded)
        again = replace(one, origin=one.origin + 1.0)
        again.save(tmp_path / "again.npz")
        loaded = Kept.load(tmp_path / "again.npz")
        assert loaded.origin == one.origin + 1.0
        np.testing.assert_array_equal(loaded.recording.position, one.recording.position)
        np.testing.assert_array_equal(loaded.recording.torque, one.recording.torque)


def test_least_squares_is_what_numpy_makes_of_pinocchios_regressor(recorded: Path) -> None:
    one, cell = Kept.load(recorded), study_cell()
    law = FrictionLaw(third=None, offset=True, standstill=0.1)
    model = RobotModel.from_urdf(cell.urdf, friction=law)
    samples = prepare(one.recording, model, noise_variance=one.noise_variance)
    weights = 1.0 / one.torque_variance
    expected = by_pinocchio.fitted_torque(cell.urdf, samples, weights)
    values = estimate(model, Factor.of(model, samples), weights).values
    ours = model.torque(values, *samples.motion[1:])[samples.usable]
    assert np.abs(ours - expected).max() < 1e-6 * np.sqrt(np.mean(expected**2))


def test_every_effect_is_a_setting_of_the_simulated_cell() -> None:
    settings = study_cell().simulation
    assert all(np.any(getattr(settings, name)) for name in EFFECTS.values())
