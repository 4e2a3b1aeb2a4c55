"""Numbers of a study made up: estimates and motions of which the errors are known beforehand."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from hil.study.records import (
    ClassForms,
    FitRecord,
    MotionForm,
    ScoreRecord,
)

Array = NDArray[np.float64]


def fitted(values: Array) -> FitRecord:
    """Repetitions of one excitation with these estimates (r, p)."""
    n = values.shape[1]
    return FitRecord(
        inputs="",
        repetitions=[f"excitation_{k:03d}_a1.mcap" for k in range(len(values))],
        values=values.tolist(),
        pooled=values.mean(axis=0).tolist(),
        pooled_std=[0.1] * n,
        undetermined=[],
        noise_std=[1.0, 1.0],
        log10_det=50.0,
        coupling_index=3.0,
        n_samples=100,
        correlation=np.eye(n).tolist(),
        duration=8.0,
        time=[0.0, 1.0],
        position=[[0.0, 1.0]] * 2,
        velocity=[[0.0, 1.0]] * 2,
    )


def flagged(count: int, of: int, repetitions: int, noise: float = 0.0, seed: int = 0) -> Array:
    """Estimates (r, of) of method `count`: its own parameter is 1 but for noise, the others 0."""
    random = np.random.default_rng([seed, count])
    return np.eye(of)[count] + noise * random.standard_normal((repetitions, of))


def scored(errors: Mapping[str, Array]) -> ScoreRecord:
    """Motions on which the k-th method, whose own parameter is 1, has these errors (m,)."""
    table = np.array(list(errors.values()))
    motions = table.shape[1]
    return ScoreRecord(
        inputs="",
        durations=[10.0] * motions,
        samples=[100] * motions,
        left_out=[[10, 30]] * motions,
        forms=[
            form(f"validation_{k:03d}_a1.mcap", np.diag([*column, 0.0]) ** 2)
            for k, column in enumerate(table.T)
        ],
        overall={name: values.tolist() for name, values in errors.items()},
        all_rows={name: (2.0 * values).tolist() for name, values in errors.items()},
        own={},
        mean_abs={
            name: [[value, 2.0 * value] for value in values.tolist()]
            for name, values in errors.items()
        },
        examples=[],
    )


def form(archive: str, gram: Array, joints: int = 2) -> MotionForm:
    """A motion whose Gram of [Phi | tau] (p + 1, p + 1) is shared equally by the joints."""
    n = len(gram) - 1
    return MotionForm(
        archive=archive,
        torque_squared=[1.0 / joints] * joints,
        columns=[list(range(n))] * joints,
        slow=[(gram / joints).tolist()] * joints,
        whole=gram[:n, :n].tolist(),
    )


def forms_of(grams: Sequence[Array]) -> ClassForms:
    """Motions with these Grams."""
    return ClassForms.of([form(f"validation_{k:03d}", gram) for k, gram in enumerate(grams)])
