"""Messages of joint states, one by one."""

from __future__ import annotations

from collections.abc import Sequence

from tests.hil.importers.bags import state
from tests.hil.importers.moving_log import COUNT, JOINTS, POSITION, RATE, SLOPE, TORQUE

START = 1_700_000_000_000_000_000
PERIOD = 10**9 // RATE
STAMPS = [START + PERIOD * k for k in range(COUNT)]
Message = tuple[int, bytes]


def message(
    k: int,
    *,
    stamp: int | None = None,
    joints: Sequence[int] = (0, 1, 2),
    position=POSITION,
    velocity=SLOPE,
    effort=TORQUE,
    late: int = 0,
) -> Message:
    """Sample k of some joints; received 77 ns after its time, whatever its stamp is."""
    some = list(joints)
    _, data = state(
        STAMPS[k] if stamp is None else stamp, position[k, some], velocity=velocity[k, some],
        effort=effort[k, some], names=[JOINTS[j] for j in some],
    )  # fmt: skip
    return STAMPS[k] + 77 + late, data


WHOLE = [message(k) for k in range(COUNT)]
