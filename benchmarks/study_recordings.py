"""Recordings of the simulated cell for `benchmarks.identification_study`: one motion, many seeds.

Each seed is a campaign of its own on the simulated NS 16: standstill, then the excitation once.
Its archives are read as `hil identify` reads them, and what it reads is kept as one compressed
numpy file per seed. A further seed runs the validation motions. What is there is not made again.
"""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal

import numpy as np

from hil.campaign import Campaign, CampaignPlan, Stop, design
from hil.cell import Cell
from hil.files import make_folder
from hil.identify.sources import gather_sources
from hil.progress import Silent
from hil.simulation import simulated_link, simulated_provenance
from identification.signals.recording import Recording
from planner.arrays import Array
from sim_fixtures.ns16 import CELL_PATH

Condition = Literal["clean", "effects", "ripple", "drift", "elasticity", "delay"]
"""What the arm has that the model leaves out: nothing, everything, or one thing alone."""
EFFECTS: Final[dict[Condition, str]] = {
    "ripple": "torque_ripple",
    "drift": "friction_drift",
    "elasticity": "elasticity",
    "delay": "delay",
}
"""Which setting of the simulated cell switches each of them on."""
VALIDATION_SEED: Final = 1_000_000
"""Far from the seeds of the excitations: noise of its own."""
_CAMPAIGN: Final = {
    "repetitions": 1,
    "validation_runs": 4,
    "approach_speed": 1.0,
    "settle_s": 0.2,
    "standstill_s": 2.0,
}


@dataclass(frozen=True, eq=False)
class Kept:
    """One recording as `hil identify` reads it.

    Attributes:
        recording: of the motion.
        noise_variance: of its positions, from standstill (n,) [rad²].
        torque_variance: of its torques, from standstill (n,) [N²·m²].
        origin: time at which the planned motion begins [s].
    """

    recording: Recording
    noise_variance: Array
    torque_variance: Array
    origin: float

    def save(self, path: Path) -> None:
        """Write to a numpy file; it is whole or not there."""
        one = self.recording
        assert one.torque is not None
        assert one.commanded_position is not None
        scratch = path.with_suffix(".part")
        with scratch.open("wb") as file:
            np.savez_compressed(
                file,
                time=one.time,
                position=one.position,
                torque=one.torque,
                commanded=one.commanded_position,
                joint_names=np.array(one.joint_names),
                noise_variance=self.noise_variance,
                torque_variance=self.torque_variance,
                origin=np.array(self.origin),
            )
        scratch.replace(path)

    @classmethod
    def load(cls, path: Path) -> Kept:
        """Read what `save` wrote."""
        with np.load(path) as file:
            recording = Recording(
                time=file["time"],
                position=file["position"],
                joint_names=tuple(file["joint_names"].tolist()),
                torque=file["torque"],
                commanded_position=file["commanded"],
            )
            return cls(
                recording, file["noise_variance"], file["torque_variance"], float(file["origin"])
            )


def study_cell() -> Cell:
    """The NS 16 cell with one repetition, its arm at home when it is switched on."""
    cell = Cell.load(CELL_PATH)
    campaign = {f"campaign.{key}": value for key, value in _CAMPAIGN.items()}
    return cell.with_values({**campaign, "simulation.initial_deg": cell.campaign.home_deg})


def study_plan(folder: Path, cell: Cell) -> CampaignPlan:
    """The plan in the folder, or else the one that `hil demo` would find for the cell."""
    path = folder / "plan.json"
    if not path.exists():
        make_folder(folder)
        design(cell, Silent()).save(path)
    return CampaignPlan.load(path)


def excitation_path(folder: Path, seed: int, condition: Condition) -> Path:
    """Where the excitation of a seed is kept."""
    return folder / f"{condition}_{seed:04d}.npz"


def validation_paths(folder: Path, cell: Cell, condition: Condition) -> list[Path]:
    """Where the validation motions are kept."""
    count = cell.campaign.validation_runs
    return [folder / f"{condition}_validation_{index}.npz" for index in range(count)]


def record_excitation(
    folder: Path, cell: Cell, plan: CampaignPlan, seed: int, condition: Condition
) -> None:
    """Run the excitation with this seed and keep it, unless it is there."""
    path = excitation_path(folder, seed, condition)
    if not path.exists():
        alone = CampaignPlan(plan.excitation, (), plan.moves)
        _run(cell, alone, seed, [path], condition)


def record_validation(folder: Path, cell: Cell, plan: CampaignPlan, condition: Condition) -> None:
    """Run the validation motions and keep them, unless they are there."""
    paths = validation_paths(folder, cell, condition)
    if not all(path.exists() for path in paths):
        _run(cell, plan, VALIDATION_SEED, paths, condition)


def _with_effect(cell: Cell, condition: Condition) -> Cell:
    """The cell with this effect alone at the size it names, if it is one of them."""
    if condition not in EFFECTS:
        return cell
    return cell.with_values(
        {
            f"simulation.{setting}": [0.0] * len(cell.joint_names) if other == "elasticity" else 0.0
            for other, setting in EFFECTS.items()
            if other != condition
        }
    )


def _run(
    cell: Cell, plan: CampaignPlan, seed: int, paths: Iterable[Path], condition: Condition
) -> None:
    """Run a campaign in a scratch folder; keep its validation motions, or else its excitation."""
    effects = condition != "clean"
    seeded = _with_effect(cell, condition).with_campaign(simulation_seed=seed)
    scratch = Path(tempfile.mkdtemp(prefix="study_"))
    try:
        campaign = Campaign.create(scratch / "campaign", seeded, plan)
        link = simulated_link(seeded, effects=effects)
        provenance = simulated_provenance(seeded, effects)
        campaign.run(link, Stop(), Silent(), provenance=provenance, durable=False, unrehearsed=True)
        kinds = ("standstill", "excitation", "validation")
        archives = [path for kind in kinds for path in campaign.folder.completed(kind)]
        # All of a single excitation is wanted: nothing is held out of it.
        sources = gather_sources(archives, split=1.0)
    finally:
        shutil.rmtree(scratch)
    assert sources.noise_variance is not None
    assert sources.torque_variance is not None
    wanted = sources.held_out if plan.validation else sources.training
    for source, path in zip(wanted, paths, strict=True):
        noise = sources.noise_variance, sources.torque_variance
        Kept(source.recording, *noise, source.origin).save(path)
