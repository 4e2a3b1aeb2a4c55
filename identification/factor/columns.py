"""Factors of other columns than the regressor's W.

Instrumental variables use [Z | W | y], gains [W | L | t | 1 | i], a search for the direction of
gravity [W0 | Wx | Wy | Wz | y], uncertain friction laws [W | F | y].
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from identification.arrays import Array
from identification.factor.blocks import FINE_BLOCK, count_by_block
from identification.factor.factor import Factor, time_blocks
from identification.factor.rows import augmented_rows
from identification.model.friction import FrictionTerm
from identification.model.known_payload import Load, Payload
from identification.model.link_wrenches import LINK_SYMBOLS, N_INERTIA
from identification.model.motion import Motion
from identification.model.regressor import RegressorPlan
from identification.model.robot import RobotModel
from identification.signals.samples import Samples

_ROWS_PER_RECORDING: Final = 500  # of one recording, in standard parameters
_PARTS: Final = ("W0", "Wx", "Wy", "Wz")


def instrument_factor(
    model: RobotModel, samples: Samples, instrument: Motion, usable: NDArray[np.bool_] | None = None
) -> Factor:
    """Reduce a recording to blocks of [Z | W | y].

    Args:
        model: of the arm.
        samples: of the recording, whose load of the gears the instrument has too.
        instrument: noise-free motion; rows count if it moves as well.
        usable: rows in which it is known (m, n), by default all.
    """
    rows = samples.usable & model.moving(instrument.velocity)
    if usable is not None:
        rows &= usable
    columns = tuple(
        np.append(joint_columns, joint_columns + model.n_parameters)
        for joint_columns in model.plan.columns
    )
    measured = augmented_rows(model, replace(samples, usable=rows))
    # The same rows, with the same torque low-pass.
    instrument = replace(instrument, load=samples.motion.load)
    planned = augmented_rows(model, replace(samples, motion=instrument, usable=rows))
    index = samples.blocks(FINE_BLOCK)
    both = (
        (index[part], [np.concatenate([z[:-1], w]) for z, w in zip(quiet, noisy, strict=True)])
        for (part, noisy), (_, quiet) in zip(measured, planned, strict=True)
    )
    names = (*(f"Z {name}" for name in model.parameter_names), *model.parameter_names)
    return Factor.of_rows(both, count_by_block(index, rows), columns, names)


def measured_part(factor: Factor) -> Factor:
    """Return the part [W | y] of :func:`instrument_factor`, for least squares on equal rows."""
    p = factor.n_parameters // 2
    return factor.restricted(np.arange(p, 2 * p))


def gain_factor(
    model: RobotModel,
    samples: Samples,
    motor_current: Array,
    *,
    payload: Payload | None = None,
    unknown_inertia: bool = False,
    transmission: Array | None = None,
    block: float = FINE_BLOCK,
) -> Factor:
    """Reduce a recording to blocks of [W | L | t | 1 | i], one Gram matrix for each motor.

    A motor's current counts if the rows of all its joints do; t is the payload torque, L has no
    columns, or six of additional moments of inertia of the payload.

    Args:
        model: of the arm.
        samples: of the recording.
        motor_current: (m, n) [A].
        payload: that the arm carries.
        unknown_inertia: whether L has six columns, zero without payload.
        transmission: motor angles per joint angle (n, n); identity: gains include gear ratios.
        block: duration of blocks, which count from the origin of the motion [s].
    """
    n = model.n_joints
    p = model.n_parameters
    m = len(samples.motion.time)
    turns = np.eye(n) if transmission is None else np.asarray(transmission, dtype=np.float64)
    blocks, columns = samples.regressor(model)
    load = model.elements.known_torque(samples.motion.position)
    moments = [np.zeros((m, N_INERTIA if unknown_inertia else 0))] * n
    if payload is not None:
        carried = Load(model.chain, model.gravity, payload)
        load = load + carried.torque(samples.motion)
        if unknown_inertia:
            moments = [*carried.moment_columns(samples.motion)]
    width = p + moments[0].shape[1]
    index = samples.blocks(block)
    usable = np.zeros((m, n), dtype=np.bool_)
    tables = np.zeros((n, width + 3, m))
    for motor, share in enumerate(np.linalg.inv(turns).T):
        acting = np.flatnonzero(share).tolist()
        usable[:, motor] = samples.usable[:, acting].all(axis=1)
        for joint in acting:
            tables[motor, columns[joint]] += share[joint] * blocks[joint].T
            known = np.column_stack([moments[joint], load[:, joint]])
            tables[motor, p : width + 1] += share[joint] * samples.as_measured(joint, known).T
        tables[motor, width + 1] = 1.0
        tables[motor, width + 2] = motor_current[:, motor]
        tables[motor][:, ~usable[:, motor]] = 0.0
    symbols = LINK_SYMBOLS[: width - p]
    names = (*model.parameter_names, *symbols, "torque of the payload", "offset")
    every = (np.arange(width + 2),) * n
    return Factor.of_rows([(index, tables)], count_by_block(index, usable), every, names)


def friction_factor(model: RobotModel, samples: Samples, terms: Sequence[FrictionTerm]) -> Factor:
    """Reduce a recording to blocks of [W | F | y], F with q more friction terms of each joint.

    The parameters p + q j to p + q (j + 1) are of joint j; none depends on the load.
    """
    n = model.n_joints
    p = model.n_parameters
    q = len(terms)
    index, block = time_blocks(samples)
    added = _friction_columns(model, samples, terms)
    columns = tuple(
        np.append(joint_columns, p + q * joint + np.arange(q))
        for joint, joint_columns in enumerate(model.plan.columns)
    )
    chunks = (
        (
            index[rows],
            [
                np.concatenate(
                    [
                        table[:-1],
                        np.where(samples.usable[rows, joint], added[joint][:, rows], 0.0),
                        table[-1:],
                    ]
                )
                for joint, table in enumerate(tables)
            ],
        )
        for rows, tables in augmented_rows(model, samples)
    )
    names = (
        *model.parameter_names,
        *(f"{term.label} {k} {joint + 1}" for joint in range(n) for k, term in enumerate(terms)),
    )
    counts = count_by_block(index, samples.usable)
    return replace(Factor.of_rows(chunks, counts, columns, names), block=block)


def _friction_columns(
    model: RobotModel, samples: Samples, terms: Sequence[FrictionTerm]
) -> list[Array]:
    """Return the columns of friction terms in the torque of each joint, n times (q, m)."""
    if samples.parent is not None:
        parent, rows = samples.parent
        return [columns[:, rows] for columns in _friction_columns(model, parent, terms)]
    motion = samples.motion
    direction = motion.direction
    if direction is None:
        direction = model.friction.direction(motion)
    columns = [
        np.array([term.column(motion.velocity[:, j], direction[:, j]) for term in terms])
        for j in range(model.n_joints)
    ]
    return [samples.as_measured(j, column.T).T for j, column in enumerate(columns)]


def every_torque_factor(model: RobotModel, motions: Sequence[Samples]) -> Factor:
    """Reduce usable rows to [W | y_1 ... y_n], whatever the n torques are of, one block a motion.

    The motions are without a low-pass of the torque.
    """
    n = model.n_joints
    p = model.n_parameters
    index = np.repeat(np.arange(len(motions)), [len(samples.torque) for samples in motions])
    samples = replace(
        motions[0],
        motion=Motion.joined([samples.motion for samples in motions]),
        torque=np.concatenate([samples.torque for samples in motions]),
        usable=np.concatenate([samples.usable for samples in motions]),
        segments=(),
        mask=None,
    )
    every = samples.torque.T
    chunks = (
        (
            index[rows],
            [
                np.concatenate(
                    [block[:-1], np.where(samples.usable[rows, joint], every[:, rows], 0.0)]
                )
                for joint, block in enumerate(tables)
            ],
        )
        for rows, tables in augmented_rows(model, samples)
    )
    columns = tuple(
        np.append(joint_columns, np.arange(p, p + n - 1)) for joint_columns in model.plan.columns
    )
    names = (*model.parameter_names, *(f"torque {joint}" for joint in range(1, n)))
    return Factor.of_rows(chunks, count_by_block(index, samples.usable), columns, names)


def standard_factor(model: RobotModel, recordings: Sequence[Samples]) -> Factor:
    """Reduce some `_ROWS_PER_RECORDING` usable rows of each recording to [W0 | Wx | Wy | Wz | y].

    The columns are of s standard parameters, friction, springs and balancers; the regressor is
    affine in gravity: W(g) = W0 + gx Wx + gy Wy + gz Wz, so one pass serves any.
    """
    n = model.n_joints
    s = model.layout.size
    s += len(model.friction.names) + len(model.elements.names)
    plans = [
        RegressorPlan(
            model.chain,
            gravity,
            [list(range(10))] * n,
            [model.layout.rotor_inertia] * n,
            model.friction,
            model.layout.pairs,
            model.elements,
        )
        for gravity in (np.zeros(3), *np.eye(3))
    ]
    gram = np.zeros((n, 4 * s + 1, 4 * s + 1))
    rows = np.zeros(n, dtype=np.intp)
    for samples in recordings:
        every = max(1, len(samples.torque) // _ROWS_PER_RECORDING)
        filtered = samples.torque_bandwidth is not None
        part = slice(None, None, 1 if filtered else every)  # filters need all rows
        motion = model.with_gear_load(replace(samples.motion.rows(part), direction=None))
        evaluated = [plan.evaluate(motion) for plan in plans]
        for joint in range(n):
            usable = samples.usable[::every, joint]
            table = np.zeros((len(usable), 4 * s + 1))
            for k, (blocks, columns) in enumerate(evaluated):
                block = blocks[joint]
                if filtered:
                    block = samples.as_measured(joint, block)[::every]
                table[:, k * s + columns[joint]] = block
            for k in (1, 2, 3):
                table[:, k * s : (k + 1) * s] -= table[:, :s]
            table[:, -1] = samples.torque[::every, joint]
            table = table[usable]
            gram[joint] += table.T @ table
            rows[joint] += len(table)
    return Factor.of_gram(gram, rows, tuple(f"{part} {k}" for part in _PARTS for k in range(s)))


def under_gravity(factor: Factor, gravity: Array) -> Factor:
    """Return the part [W | y] of a :func:`standard_factor` under a gravity (3,) [m/s²]."""
    share = np.append(1.0, gravity)
    n = factor.n_joints
    s = factor.n_parameters // 4
    half = share @ factor.gram[:, :-1, :-1].reshape(n, 4, s * 4 * s)
    gram = np.empty((n, s + 1, s + 1))
    gram[:, :s, :s] = share @ half.reshape(n, s, 4, s)
    gram[:, :s, s] = share @ factor.gram[:, :-1, -1].reshape(n, 4, s)
    gram[:, s, :s] = gram[:, :s, s]
    gram[:, s, s] = factor.gram[:, -1, -1]
    return Factor.of_gram(gram, factor.samples, factor.parameter_names[:s])
