"""`hil export`: files for simulators, and variants that differ as the parameters are uncertain."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from typer.testing import CliRunner

from hil.cli import app
from hil.exporting import arm_of, spread_of
from hil.importers import ColumnMap, Robot, import_log
from identification.estimators.consistent import sample_ensemble
from identification.model.pseudo_inertia import margin

from .identified_arm import IdentifiedArm, a_motion, identified_arm

Array = NDArray[np.float64]

TWO_LINK = (Path(__file__).parents[1] / "identification" / "two_link.urdf").read_text()


@pytest.fixture(scope="module")
def arm() -> IdentifiedArm:
    return identified_arm(TWO_LINK)


@pytest.fixture(scope="module")
def log(arm: IdentifiedArm, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording of the arm, imported."""
    folder = tmp_path_factory.mktemp("log")
    motion = a_motion(2, 1)
    torque = arm.cell.model.torque(arm.truth, *motion[1:])
    np.savetxt(folder / "log.csv", np.column_stack([motion.time, motion.position, torque]))
    (folder / "map.toml").write_text(
        "[time]\ncolumn = 0\n[position]\ncolumns = [1, 2]\n[torque]\ncolumns = [3, 4]\n"
    )
    (folder / "arm.urdf").write_text(TWO_LINK)
    return import_log(
        folder / "log.csv",
        folder / "log.mcap",
        robot=Robot.from_urdf(folder / "arm.urdf"),
        columns=ColumnMap.load(folder / "map.toml"),
    )


class TestEnsemble:
    """Variants are possible machines that spread as the covariance says."""

    def test_torque_spreads_as_wide_as_its_interval(self, arm: IdentifiedArm) -> None:
        """A standard deviation from 200 variants is known to 5 %: three times that is allowed."""
        variants = sample_ensemble(arm.cell.model, arm.estimate, 200, 1)
        motion, consistent = a_motion(2, 7), arm.consistency.consistent
        spread = spread_of(arm_of(arm.cell, consistent), variants, arm.estimate.covariance, motion)
        np.testing.assert_allclose(spread.variants, spread.covariance, rtol=0.15)
        centre = arm.cell.model.torque(arm.estimate.values, *motion[1:])
        mean = np.mean([arm.cell.model.torque(v, *motion[1:]) for v in variants.values], axis=0)
        assert np.all(np.abs(mean - centre).mean(axis=0) < 0.2 * spread.covariance)

    @pytest.mark.parametrize("factor", [1.0, 1e6])
    def test_every_variant_is_a_possible_machine(self, arm: IdentifiedArm, factor: float) -> None:
        """Also where the intervals reach far beyond what is possible."""
        model = arm.cell.model
        wide = replace(arm.estimate, covariance=factor * arm.estimate.covariance)
        variants = sample_ensemble(model, wide, 20, 1)
        assert np.all(margin(variants.standard[:, model.layout.links]) > 0.0)
        assert np.all(variants.standard[:, model.layout.rotors] >= 0.0)
        base = variants.standard @ model.base.grouping.T
        np.testing.assert_allclose(variants.values[:, : model.base.rank], base)
        for values in variants.values:
            for row in model.friction.table(values[model.friction_part]):
                assert row["f0"] >= 0.0
                assert row["f1"] >= 0.0

    def test_one_seed_is_one_ensemble(self, arm: IdentifiedArm) -> None:
        one, same, other = (
            sample_ensemble(arm.cell.model, arm.estimate, 5, seed).standard for seed in (1, 1, 2)
        )
        np.testing.assert_array_equal(one, same)
        assert not np.array_equal(one, other)

    def test_what_is_not_determined_stays(self) -> None:
        still = identified_arm(TWO_LINK, still=(0,))
        variants = sample_ensemble(still.cell.model, still.estimate, 5, 1)
        place = still.cell.model.parameter_names.index("f1_1")
        np.testing.assert_allclose(variants.values[:, place], variants.values[0, place])


class TestCommand:
    """What the command leaves and says."""

    def test_an_arm_and_its_variants(self, log: Path, tmp_path: Path) -> None:
        output = tmp_path / "deep" / "arm.sdf"
        words = [str(log), "--to", "sdf", "--ensemble", "3", "--seed", "2", "-o", str(output)]
        result = CliRunner().invoke(app, ["export", *words, "--json"])
        assert result.exit_code in (0, 5), result.output
        found = json.loads(result.stdout)
        assert found["path"] == str(output)
        assert found["read_back"] < 1e-6
        assert "rotor inertias" in found["left_out"]
        folder = tmp_path / "deep" / "arm_ensemble"
        assert sorted(p.name for p in folder.glob("*.sdf")) == ["0.sdf", "1.sdf", "2.sdf"]
        with np.load(folder / "ensemble.npz") as arrays:
            assert arrays["standard"].shape == (3, len(arrays["standard_names"]))
            assert arrays["values"].shape == (3, len(arrays["names"]))
        text = output.read_text()
        assert "verdict: " in text
        assert "log.mcap sha256" in text

    def test_without_mujoco_the_file_is_not_read_back(
        self, log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setitem(sys.modules, "mujoco", None)
        monkeypatch.chdir(tmp_path)
        result = CliRunner().invoke(app, ["export", str(log), "--to", "mjcf"])
        assert result.exit_code in (0, 5), result.output
        assert "not read back: MuJoCo is not installed" in result.stdout
        assert (tmp_path / "identified.xml").read_text().startswith("<mujoco")

    def test_a_replay_draws_and_says_how_far_models_stray(self, log: Path, tmp_path: Path) -> None:
        picture = tmp_path / "deep" / "replay.svg"
        result = CliRunner().invoke(app, ["replay", str(log), "-o", str(picture), "--json"])
        assert result.exit_code in (0, 5), result.output
        models = json.loads(result.stdout)["models"]
        assert max(models["identified"]["rms"]) < min(models["nominal"]["rms"])
        assert 0.0 < max(models["spread of the ensemble"]["rms"]) < min(models["nominal"]["rms"])
        assert "</svg>" in picture.read_text()

    def test_a_replay_goes_into_a_report_of_the_same_parameters(
        self, log: Path, tmp_path: Path
    ) -> None:
        """Not into that of another estimate, and a new identification takes it out."""
        (tmp_path / log.name).write_bytes(log.read_bytes())
        reports = []
        for command in (
            ["identify"],
            ["replay", "--ensemble", "2", "--estimator", "ols"],
            ["replay", "--ensemble", "2"],
            ["identify"],
        ):
            result = CliRunner().invoke(app, [*command, str(tmp_path)])
            assert result.exit_code in (0, 5), result.output
            reports.append("Simulated forwards" in (tmp_path / "report.html").read_text())
        assert reports == [False, False, True, False]

    def test_a_folder_without_archives_is_refused(self, tmp_path: Path) -> None:
        result = CliRunner().invoke(app, ["export", str(tmp_path), "--to", "mjcf"])
        assert str(tmp_path) in str(result.exception)
        assert "name the folder of a campaign" in str(result.exception)
