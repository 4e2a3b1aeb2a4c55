"""Held-out motions simulated forwards under the torques that were recorded."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from hil.errors import InputError
from hil.identify import Identification
from hil.identify.surroundings import nominal_of
from hil.plots.style import bare, page
from hil.progress import Reporter
from identification.validation.replay import FEEDBACK, Simulated, replay

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Replayed:
    """Position errors of models, simulated less recorded.

    Attributes:
        joint_names: (n,).
        units: of the errors of each joint, degrees or mm.
        time: since the beginning of the first motion, one after the other (m,) [s].
        errors: of each model by name (m, n), in `units`; NaN in gaps.
        tested_on: which motions, in words.
        verdict: on the identified model, in a sentence.
    """

    joint_names: tuple[str, ...]
    units: tuple[str, ...]
    time: Array
    errors: dict[str, Array]
    tested_on: str
    verdict: str

    def lines(self) -> list[str]:
        """Root mean square and largest error of each joint, model by model."""
        lines = [f"simulated on {self.tested_on}, with a feedback of {FEEDBACK:g} Hz:"]
        for name, error in self.errors.items():
            figures = (
                f"{joint} {rms:.2g} (at most {most:.2g}) {unit}"
                for joint, rms, most, unit in zip(
                    self.joint_names, *self._figures(error), self.units, strict=True
                )
            )
            lines.append(f"{name}: {', '.join(figures)}")
        return [*lines, self.verdict]

    def to_dict(self) -> dict[str, object]:
        """The same for JSON."""
        return {
            "joints": [*self.joint_names],
            "units": [*self.units],
            "models": {
                name: dict(
                    zip(("rms", "most"), (x.tolist() for x in self._figures(e)), strict=True)
                )
                for name, e in self.errors.items()
            },
            "verdict": self.verdict,
        }

    def figure(self) -> Figure:
        """Errors over time, a row for each joint."""
        n = len(self.joint_names)
        with page():
            figure = Figure(figsize=(8.0, 0.6 + 1.3 * n), layout="constrained")
            rows = figure.subplots(n, 1, sharex=True, squeeze=False)[:, 0]
            for joint, axes in enumerate(rows):
                for name, error in reversed(self.errors.items()):
                    axes.plot(self.time, error[:, joint], label=name, linewidth=0.8)
                axes.set_ylabel(f"{self.joint_names[joint]} [{self.units[joint]}]")
                bare(axes)
            rows[0].legend(loc="upper right", ncols=len(self.errors))
            rows[0].set_title("Position error under the recorded torques")
            rows[-1].set_xlabel("time [s]")
        return figure

    def _figures(self, error: Array) -> tuple[Array, Array]:
        return np.sqrt(np.nanmean(error**2, axis=0)), np.nanmax(np.abs(error), axis=0)


def replay_motions(found: Identification, reporter: Reporter) -> Replayed:
    """Simulate the motions that were predicted, by the identified and by the nominal model.

    Raises:
        InputError: there are no physically consistent parameters to simulate.
    """
    consistency, model = found.consistency, found.cell.model
    if isinstance(consistency, str):
        raise InputError(
            found.paths[0],
            f"there are no physically consistent parameters: {consistency}",
            remedy="see the verdict of `hil identify`",
        )
    consistent = consistency.consistent
    identified = Simulated(model, consistent.standard, consistent.estimate.values)
    arms = {"identified": identified}
    if (nominal := _nominal(found)) is not None:
        arms["nominal"] = nominal
    errors: dict[str, list[Array]] = {name: [] for name in arms}
    time: list[Array] = []
    with reporter.task("simulating", len(arms) * len(found.unseen)) as task:
        for samples in found.unseen:
            last = float(time[-1][-1]) if time else 0.0
            time.append(last + samples.motion.time - samples.motion.time[0])
            for name, arm in arms.items():
                errors[name].append(replay(arm, samples, identified))
                task.advance(1, name)
    scale = np.where(model.chain.revolute, 180.0 / np.pi, 1e3)
    return Replayed(
        joint_names=model.joint_names,
        units=tuple("°" if turns else "mm" for turns in model.chain.revolute),
        time=np.concatenate(time),
        errors={name: scale * np.concatenate(every) for name, every in errors.items()},
        tested_on=found.tested_on,
        verdict=found.verdict.line,
    )


def _nominal(found: Identification) -> Simulated | None:
    """The arm as its papers have it; None where they do not say what it weighs."""
    cell, nominal = found.cell, nominal_of(found.cell)
    if nominal is None:
        return None
    standard, table = cell.model.nominal, cell.file.nominal
    if table is not None and cell.model.rotor_inertia:
        standard[cell.model.layout.rotors] = table.rotor_inertia
    return Simulated(cell.model, standard, nominal.values)
