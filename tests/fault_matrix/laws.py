"""Laws that hold in every run, whatever the fault: judged by bytes and records, not the guard."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from drivers import Counters, CyclicPacket, State
from drivers.packets import DRIVE_ON, Mode, cyclic_length, is_init, next_number, packet_number
from planner import JointLimits
from tests.fault_matrix import small_cell

Array = NDArray[np.float64]
Exchanged = Sequence[Sequence[Any]]
"""Packets received, each with its answer or None."""

N: Final = small_cell.N
PERIOD: Final = 0.001
LIMITS: Final = JointLimits(
    lower=np.full(N, -2.0),
    upper=np.full(N, 2.0),
    velocity=np.array(small_cell.SPEED),
    acceleration=np.full(N, 30.0),
    jerk=np.full(N, 3000.0),
)
TOLERATED: Final = 4
"""Answers missing in a row that the controller puts up with; the next one ends open mode."""
MAX_GAP: Final = 2
"""Of the session, by default."""
SESSION_THRESHOLD: Final = 0.6 * small_cell.FOLLOWING_ERROR
"""Narrower than the controller's own, so that the session is the first to notice."""
_ALLOWANCE: Final = 0.1 * SESSION_THRESHOLD
_STOP_FACTORS: Final = (1.0, 2.0, 3.0)
_ASKS: Final = {Mode.DRIVE_OFF_REQUEST, Mode.FOLLOWING_ERROR}
_OPEN: Final = [Mode.POSITION] * N
_FASTEST: Final = max(
    abs(ratio) * speed * PERIOD / (2.0 * np.pi)
    for ratio, speed in zip(small_cell.TABLE["gear_ratio"], small_cell.SPEED, strict=True)
)


def broken_on_the_wire(exchanged: Exchanged, fates: Counters) -> Iterator[str]:
    """Answers: one for each that gets one; set-points only for open axes with the drive on."""
    answered = sum(reply is not None for _, reply in exchanged)
    if answered != fates.answered + fates.duplicates:
        yield f"{answered} answers for {fates}"
    silent = len(exchanged) - answered
    if silent != fates.stale + fates.malformed + fates.ended:
        yield f"{silent} packets unanswered, but {fates}"
    for packet, reply in exchanged:
        if reply is None:
            continue
        if packet_number(reply) != next_number(packet_number(packet)):
            yield f"number {packet_number(reply)} in the answer to {packet_number(packet)}"
        if not is_init(packet) and len(packet) == cyclic_length(N):
            yield from _broken_in_answer(packet, reply)


def _broken_in_answer(packet: bytes, reply: bytes) -> Iterator[str]:
    received = CyclicPacket.decode(packet, N)
    answer = CyclicPacket.decode(reply, N)
    modes = received.axes["mode"].tolist()
    powered = received.status[0] == DRIVE_ON
    if _ASKS & set(answer.axes["mode"].tolist()):
        return
    ours, theirs = answer.axes["d"], received.axes["d"]
    if powered and modes == _OPEN:
        ahead = float(np.abs(ours[:, 0] - theirs[:, 0]).max())
        # Every target is one of the last MAX_GAP + 1 set-points, give or take a tenth of the
        # threshold, and the answer is the next of them.
        if not ahead <= (MAX_GAP + 1) * 1.01 * _FASTEST + _ALLOWANCE:
            yield f"a set-point {ahead} motor revolutions from the controller's target"
        return
    for axis in range(N):
        is_open = powered and modes[axis] == Mode.POSITION
        same = ours[axis].view(np.int32) == theirs[axis].view(np.int32)
        if not is_open and not np.all(same | (ours[axis] == 0.0)):
            yield f"set-point {ours[axis]} for closed axis {axis + 1}, not {theirs[axis]}"


def broken_in_records(records: NDArray[np.void], still: slice | None) -> Iterator[str]:
    """What was commanded keeps the bounds, and nothing moves after the motion was lost.

    Args:
        records: (m,) all of the run.
        still: those between a loss or refusal and the next request, if there was one.
    """
    sent = np.isfinite(records["commanded_position"]).all(axis=1)
    may = (records["mode"] == Mode.POSITION).all(axis=1) & (records["status"] == DRIVE_ON)
    if np.any(sent & ~may):
        yield f"set-points in {int(np.sum(sent & ~may))} cycles without open mode"
    if still is not None and np.any(np.nan_to_num(records["commanded_velocity"][still])):
        yield "set-points that move after the motion was lost or refused"
    for first, last in _stretches(sent & (records["state"] != State.OPENING)):
        rows = records[first:last]
        v = rows["commanded_velocity"]
        # After a long gap a motion goes on from the controller's target, and at its velocity.
        carried = np.flatnonzero((rows["gap"][1:] > MAX_GAP) & v[:-1].any(axis=1)) + 1
        for number, part in enumerate(np.split(rows, carried)):
            yield from _broken_bounds(part, int(part["gap"][0]) if number else 0)


def _broken_bounds(rows: NDArray[np.void], carried: int) -> Iterator[str]:
    """Of a motion from rest, or from where the controller carried it by so many steps."""
    q, v = rows["commanded_position"], rows["commanded_velocity"]
    if np.any(q < LIMITS.lower) or np.any(q > LIMITS.upper):
        yield "a set-point outside the joints' range"
    same = (np.diff(q, axis=0, prepend=np.nan) == 0.0).all(axis=1)
    # What the controller did not take is sent again, with its velocity: no step of the motion.
    q = q[~(same & v.any(axis=1))]
    before = np.tile(q[:1], (3, 1))
    if carried:
        step = PERIOD * rows["target_velocity"][0]
        before = rows["target_position"][0] - np.arange(2.0, -1.0, -1.0)[:, None] * step
    q = np.vstack((before, q))
    bounds = (LIMITS.velocity, LIMITS.acceleration, LIMITS.jerk)
    for order, (bound, factor) in enumerate(zip(bounds, _STOP_FACTORS, strict=True), start=1):
        rates = np.abs(np.diff(q, order, axis=0)) / PERIOD**order
        # The controller's own steps have no acceleration: it comes back in a few cycles.
        free = min(2 * carried, round(0.03 / PERIOD)) + 2 if carried and order == 3 else 0
        rate = rates[free:].max(axis=0, initial=0.0)
        if np.any(rate > bound * factor * (1.0 + 1e-5)):
            yield f"derivative {order} of the set-points is {rate}, allowed is {bound * factor}"


def _stretches(mask: NDArray[np.bool_]) -> Iterator[tuple[int, int]]:
    edges = np.flatnonzero(np.diff(np.concatenate(([False], mask, [False])).astype(int)))
    yield from zip(edges[::2], edges[1::2], strict=True)
