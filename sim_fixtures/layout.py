"""Where the axes of the simulated controller stand in its packets."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from drivers.packets import (
    AXIS_DTYPE,
    DRIVE_ON,
    MAX_CYCLIC_LENGTH,
    N_ARMS,
    NO_SLOT,
    CyclicPacket,
    InitPacket,
    Mode,
)
from sim_fixtures.drive import SimulatedDrive
from sim_fixtures.errors import SettingError
from sim_fixtures.settings import AXES_PER_ARM, MAX_SLOTS, ControllerSettings

_LED_BY_THE_PC = (1, 4, 5)
_FOREIGN = {
    "calibration": 0.5,
    "current_limit": 10.0,
    "gear_ratio": 100.0,
    "following_error": 2.0,
}
"""What the init packet says of every axis of another arm."""


class Layout:
    """Axis blocks of this arm and of the others, and the packets they make.

    Attributes:
        axes: (n_slots,) the axis blocks of the next packet.
        own: slot of each axis of this arm.
        slots: the same as numbers.
        n_slots: axis blocks in a packet.
    """

    def __init__(
        self, n_axes: int, settings: ControllerSettings, tail: np.random.Generator
    ) -> None:
        """Distribute the slots.

        Args:
            n_axes: of this arm.
            settings: arm, slots, foreign axes, long packets.
            tail: where the garbage of long packets comes from.

        Raises:
            SettingError: more axes than a packet has slots or the other arms have axes, or slots
                that are not distinct numbers below their count.
        """
        self.n_slots = n = n_axes + settings.foreign_axes
        if n > MAX_SLOTS:
            raise SettingError("foreign_axes", settings.foreign_axes, f"{MAX_SLOTS} axes in all")
        slots = settings.slots if settings.slots is not None else tuple(range(n_axes))
        if len(slots) != n_axes or len(set(slots)) != n_axes or not set(slots) <= set(range(n)):
            raise SettingError("slots", slots, f"{n_axes} different slots of 0..{n - 1}")
        self.slots = tuple(slots)
        self.own = np.array(slots, np.intp)
        self._foreign = np.array([s for s in range(n) if s not in slots], np.intp)
        self._settings = settings
        self._tail = tail
        others = [arm for arm in range(N_ARMS) if arm != settings.arm - 1]
        self._foreign_arm = [others[i // AXES_PER_ARM] for i in range(settings.foreign_axes)]
        self.axes: NDArray[np.void] = np.zeros(n, AXIS_DTYPE)
        # D1..D5, extra1..3 of all slots, (8, n_slots)
        self._values = self.axes.view(np.float32).reshape(n, -1)[:, 1:].T
        self._modes: tuple[int | bool | None, ...] = ()
        # the axes of other arms stand somewhere, each in another place
        places = np.arange(1.0, 1.0 + settings.foreign_axes) / 4.0
        self.axes["d"][self._foreign, 0] = self.axes["d"][self._foreign, 2] = places
        arms = {settings.arm - 1, *self._foreign_arm}
        self._on = bytes(DRIVE_ON if arm in arms else 0 for arm in range(N_ARMS))

    @property
    def foreign_targets(self) -> list[float]:
        """Targets of the axes of other arms [motor rev]."""
        targets: list[float] = self.axes["d"][self._foreign, 0].tolist()
        return targets

    def fill(self, values: NDArray[np.float64]) -> None:
        """Set D1..D5, extra1..3 of this arm's axes, (8, n_axes); infinite where float32 ends."""
        with np.errstate(over="ignore"):
            self._values[:, self.own] = values

    def set_modes(self, common: int | None, open_axes: Sequence[bool]) -> None:
        """Set all modes to `common`, or each axis to the open mode or to closed."""
        wanted = (common, *open_axes)
        if wanted == self._modes:
            return
        self._modes = wanted
        if common is not None:
            self.axes["mode"] = common
            return
        mode = self._settings.open_mode
        self.axes["mode"][self.own] = [mode if is_open else 0 for is_open in open_axes]
        opens = self._settings.foreign_open and any(open_axes)
        self.axes["mode"][self._foreign] = mode if opens else 0

    def packet(self, number: int, powered: bool) -> bytes:
        """Return the cyclic packet with the present axis blocks."""
        status = self._on if powered else bytes(N_ARMS)
        packet = CyclicPacket(number, status, bytes(N_ARMS), self.axes).encode()
        if self._settings.long_packets:
            packet += self._tail.bytes(MAX_CYCLIC_LENGTH - len(packet))
        return packet

    def obey(self, answer: CyclicPacket) -> None:
        """Let open axes of other arms go where the PC sends them."""
        mode = self._settings.open_mode
        if mode not in _LED_BY_THE_PC:
            return
        for slot in self._foreign.tolist():
            if self.axes["mode"][slot] == mode == answer.axes["mode"][slot]:
                target, delta = answer.axes["d"][slot, :2].tolist()
                self.axes["d"][slot, :4] = (target, delta, target, delta)

    def init(self, drive: SimulatedDrive, period: float) -> bytes:
        """Return the 1200 bytes with what the controller announces about its axes."""
        settings = self._settings
        row = settings.arm - 1
        own = (row, slice(drive.n_axes))
        shape = (N_ARMS, AXES_PER_ARM)
        tables = {name: np.zeros(shape, np.float32) for name in (*_FOREIGN, "kinematic_influence")}
        slots = np.full(shape, NO_SLOT, np.int32)
        modes = np.full(shape, -1, np.int32)
        for i, (arm, slot) in enumerate(zip(self._foreign_arm, self._foreign, strict=True)):
            at = (arm, i % AXES_PER_ARM)
            slots[at], modes[at] = slot, Mode.CLOSED
            for name, value in _FOREIGN.items():
                tables[name][at] = value
        slots[own], modes[own] = self.own, Mode.CLOSED
        for name in _FOREIGN:
            tables[name][own] = getattr(drive, name)
        tables["kinematic_influence"][row, 3:6] = (drive.k54, drive.k64, drive.k65)
        init = InitPacket.build(
            min(self.n_slots, AXES_PER_ARM), round(period * 1000.0), {},
            open_mode=modes, open_axes_map=slots, version=settings.version, **tables,
        )  # fmt: skip
        init.record["n_axes"] = self.n_slots
        return init.encode()
