"""Forward simulation of held-out motions under the recorded torques."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from hil.exporting import consistent_of
from hil.identify import Identification
from hil.identify.cell_context import nominal_of
from hil.identify.run import FIGURE_SAMPLES
from hil.plots.style import RULE, bare, page
from hil.progress import Reporter
from hil.report import ReportSeries
from identification.estimators.consistent import sample_ensemble
from identification.validation.replay import FEEDBACK, Simulated, replay, slow_residual

Array = NDArray[np.float64]

ENSEMBLE: Final = 10  #: Variants: a standard deviation from ten is known to 24 %
SEED: Final = 0
DRIFT: Final = 3.0
"""Drift over spread of the ensemble, below which the uncertainty explains it."""


@dataclass(frozen=True, eq=False)
class Replayed:
    """Position errors of models, simulated less recorded."""

    joint_names: tuple[str, ...]  #: (n,)
    units: tuple[str, ...]  #: of the errors of each joint (n,), degrees or mm
    time: Array  #: since the begin of the first motion, motions one after the other (m,) [s]
    errors: dict[str, Array]  #: of each model by name (m, n), in `units`; NaN in gaps
    #: standard deviation of the positions of variants of the identified arm (m, n), in `units`;
    #: None without variants
    spread: Array | None
    #: sentences on drifts of the identified model beyond its uncertainty
    reasons: tuple[str, ...]
    tested_on: str  #: description of the motions
    verdict: str  #: on the identified model

    @property
    def figures(self) -> dict[str, tuple[Array, Array]]:
        """RMS and largest error (n,) by model, and of the ensemble's spread."""
        rows = dict(self.errors)
        if self.spread is not None:
            rows["spread of the ensemble"] = self.spread
        return {name: _figures(error) for name, error in rows.items()}

    def lines(self) -> list[str]:
        """Return text lines with RMS and largest error of each joint by model."""
        lines = [f"simulated on {self.tested_on}, with a feedback of {FEEDBACK:g} Hz:"]
        for name, figures in self.figures.items():
            joints = zip(self.joint_names, *figures, self.units, strict=True)
            errors = (
                f"{joint} {rms:.2g} (at most {most:.2g}) {unit}"
                for joint, rms, most, unit in joints
            )
            lines.append(f"{name}: {', '.join(errors)}")
        return [*lines, *self.reasons, self.verdict]

    def to_dict(self) -> dict[str, object]:
        """Return the result for JSON."""
        return {
            "joints": [*self.joint_names],
            "units": [*self.units],
            "models": {
                name: {"rms": rms.tolist(), "most": most.tolist()}
                for name, (rms, most) in self.figures.items()
            },
            "reasons": [*self.reasons],
            "verdict": self.verdict,
        }

    def figure(self) -> Figure:
        """Return the figure of errors over time, a row for each joint."""
        n = len(self.joint_names)
        with page():
            figure = Figure(figsize=(8.0, 0.6 + 1.3 * n), layout="constrained")
            rows = figure.subplots(n, 1, sharex=True, squeeze=False)[:, 0]
            for joint, axes in enumerate(rows):
                if self.spread is not None:
                    middle, width = self.errors["identified"][:, joint], 2.0 * self.spread[:, joint]
                    axes.fill_between(
                        self.time, middle - width, middle + width,
                        label="ensemble (± 2 σ)", color=RULE,
                    )  # fmt: skip
                for name, error in reversed(self.errors.items()):
                    axes.plot(self.time, error[:, joint], label=name, linewidth=0.8)
                axes.set_ylabel(f"{self.joint_names[joint]} [{self.units[joint]}]")
                bare(axes)
            rows[0].legend(loc="upper right", ncols=3)
            rows[0].set_title("Position error under the recorded torques")
            rows[-1].set_xlabel("time [s]")
        return figure

    def beside(self, series: ReportSeries) -> ReportSeries:
        """Return the series of a report with those of the replay added."""
        some = slice(None, None, max(1, len(self.time) // FIGURE_SAMPLES))
        nothing = np.empty((0, 0))
        return replace(
            series,
            replay_time=self.time[some],
            replay_error=self.errors["identified"][some],
            replay_nominal=self.errors.get("nominal", nothing)[some],
            replay_spread=nothing if self.spread is None else self.spread[some],
            replay_words="\n".join(self.reasons),
        )


def _figures(error: Array) -> tuple[Array, Array]:
    return np.sqrt(np.nanmean(error**2, axis=0)), np.nanmax(np.abs(error), axis=0)


def replay_motions(found: Identification, reporter: Reporter, ensemble: int = ENSEMBLE) -> Replayed:
    """Simulate the predicted motions by identified, nominal and `ensemble` variants of the model.

    Raises:
        InputError: there are no physically consistent parameters to simulate.
    """
    consistent, model = consistent_of(found), found.cell.model
    names = ["identified"]
    standard, values = [consistent.standard], [consistent.estimate.values]
    if (nominal := nominal_of(found.cell)) is not None:  # None where no link has a stated mass
        names.append("nominal")
        bodies, table = model.nominal, found.cell.file.nominal
        if table is not None and model.layout.rotor_inertia:
            bodies[model.layout.rotors] = table.rotor_inertia
        standard.append(bodies)
        values.append(nominal.values)
    if ensemble > 1:
        variants = sample_ensemble(model, found.estimate.pooled, ensemble, SEED)
        standard.extend(variants.standard)
        values.extend(variants.values)
    arms = Simulated(model, np.array(standard), np.array(values))
    parts: list[Array] = []
    time: list[Array] = []
    with reporter.task("simulating (motions)", len(found.prepared.held_out)) as task:
        for samples in found.prepared.held_out:
            last = float(time[-1][-1]) if time else 0.0
            time.append(last + samples.motion.time - samples.motion.time[0])
            parts.append(replay(arms, samples))
            task.advance(1)
    scale = np.where(model.chain.revolute, 180.0 / np.pi, 1e3)
    errors = scale * np.concatenate(parts, axis=1)
    spread = np.std(errors[len(names) :], axis=0, ddof=1) if ensemble > 1 else None
    return Replayed(
        joint_names=model.joint_names,
        units=tuple("°" if turns else "mm" for turns in model.chain.revolute),
        time=np.concatenate(time),
        errors=dict(zip(names, errors, strict=False)),
        spread=spread,
        reasons=() if spread is None else _reasons(found, arms, errors[0], spread),
        tested_on=found.prepared.sources.tested_on,
        verdict=found.verdict.line,
    )


def _reasons(
    found: Identification, arms: Simulated, error: Array, spread: Array
) -> tuple[str, ...]:
    """Return sentences on joints that drift by more than the uncertainty of their parameters."""
    drift, uncertain = _figures(error)[0], _figures(spread)[0]
    left = slow_residual(arms, found.prepared.held_out)
    sentences = []
    for joint in np.flatnonzero(drift > DRIFT * uncertain):
        constant, friction = left.constant[joint], left.friction[joint]
        share, cause = max(
            (constant, "constant: an offset of the torque, a payload, or gravity"),
            (friction, "in the direction of motion: friction that differs from the fitted one"),
            (1.0 - constant - friction, "dependent on posture or time"),
        )
        unit = "N·m" if arms.model.chain.revolute[joint] else "N"
        sentences.append(
            f"{found.cell.joint_names[joint]} drifts {drift[joint] / uncertain[joint]:.1f} times"
            f" as far as its uncertainty: the residual torque averaged over {1.0 / FEEDBACK:g} s is"
            f" {left.rms[joint]:.2g} {unit}, {share:.0%} of its square {cause}"
        )
    return tuple(sentences)
