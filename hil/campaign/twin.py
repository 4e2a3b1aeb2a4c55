"""The simulated arm of a rehearsal, close to the nominal one, with faults of its link.

Masses, inertias, rotors and friction are varied within `PARAMETER_SPREAD` of their nominal values.
A cell without `[simulation]` gets one from `[nominal]` and the defaults below.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, replace
from typing import Any, Final

import numpy as np
import pinocchio

from drivers.open_mode import MAX_TARGET_JUMP
from drivers.transports.simulated import Delay, Duplicate, Fault, Lose, SimulatedTransport
from hil.base.arrays import Array
from hil.cell import Cell
from hil.control.planted_arm import planted_values
from hil.control.simulated_cell import (
    assumed_simulation,
    controller_settings,
    simulated_controller,
    simulated_provenance,
)
from hil.control.ur_simulation import UrPeer, arm_truth, simulated_ur
from hil.control.virtual_link import VirtualLink
from sim_fixtures import ServoSettings, UnmodelledEffects

# Largest relative deviation of the simulated parameters from the nominal ones
PARAMETER_SPREAD: Final = 0.1
MEAN_FAULT_INTERVAL: Final = 3.0  # Mean time between two faults of the link, s
LOOP_DELAY_CYCLES: Final = 0.5
"""Mean delay of a target current, cycles: it acts over the cycle before the packet."""
MAIN_AXIS_RESONANCE: Final = 500.0
"""Resonance of a main axis, rotor against link, rad/s, where the cell has no elasticity."""
MAX_RESONANCE: Final = 800.0
"""Highest resonance in any posture, rad/s: the simulated arm has steps of 0.5 ms."""
RESONANCE_POSTURES: Final = 60  # Postures in which the resonances are computed
MAIN_AXES: Final = 3
MAX_CURRENT_LAG: Final = 0.002
"""Slowest current loop, s; a slower one makes the simulated arm oscillate."""
_FAULT_HORIZON_FACTOR: Final = 4.0
"""Period of link faults as a multiple of the motions' duration: moves take time, too."""


@dataclass(frozen=True)
class CurrentNoise:
    """Noise (rms) and resolution of the current [A], by the weakest motor's limit."""

    noise: float
    resolution: float


@dataclass(frozen=True)
class DefaultEffects:
    """Effects that the model lacks, with default sizes."""

    torque_ripple: float  #: share of the Coulomb torque
    friction_drift: float  #: share by which friction falls
    delay: float  #: [s]


@dataclass(frozen=True)
class ZeroNominal:
    """Fields of `[nominal]` that are all zero."""

    fields: tuple[str, ...]


@dataclass(frozen=True)
class NoLostPackets:
    """No packet is lost, as that would end a motion at full speed."""

    motor: str  #: joint of the motor
    turns: float  #: revolutions in a cycle
    allowed: float  #: by the guard
    cycle_ms: float


Assumption = CurrentNoise | DefaultEffects | ZeroNominal | NoLostPackets
"""What a simulated arm has that the cell file does not state."""


@dataclass(frozen=True, eq=False)
class Twin:
    """A simulated arm for a rehearsal.

    Attributes:
        cell: with a simulated controller; its `[simulation]` has the varied parameters.
        truth: simulated parameters (p,) in the order of the model.
        assumed: what the cell file does not state.
        seed: of the variation.
    """

    cell: Cell
    truth: Array
    assumed: tuple[Assumption, ...]
    seed: int

    @classmethod
    def of(cls, cell: Cell, *, seed: int, repetitions: int) -> Twin:
        """Return an arm with random parameters for a cell."""
        rng = np.random.default_rng(seed)
        planted = _varied(cell, rng)
        settings, assumed = _simulation(cell, planted, seed)
        twin = cell.with_values(
            {
                **{f"simulation.{key}": value for key, value in settings.items()},
                "controller.transport": "simulated",
                **_ur_table(cell),
                "campaign.repetitions": min(repetitions, cell.campaign.repetitions),
            }
        )
        if (limit := too_far_without_a_packet(twin)) is not None:
            assumed.append(limit)
        return cls(twin, planted_values(twin), tuple(assumed), seed)

    def link(self, seconds: float, *, effects: bool) -> VirtualLink:
        """Return a link in virtual time to the arm, with random faults."""
        if self.cell.is_ur:
            return self._ur_link(seconds, effects=effects)
        table = self.cell.controller
        # The current loop has the delay of `[controller] current_delay_cycles`.
        lag = (LOOP_DELAY_CYCLES - table.current_delay_cycles) * self.cell.period
        settings = replace(
            controller_settings(self.cell, effects=effects),
            servo=ServoSettings(current_lag=float(np.clip(lag, 0.0, MAX_CURRENT_LAG))),
            # `[controller] max_gap` missed packets in a row end no motion.
            missed_replies=table.max_gap + 1,
            while_silent="continue",
        )
        controller = simulated_controller(
            self.cell, settings=settings, effects=effects, seed=self.seed
        )
        faults = link_faults(self.cell, _FAULT_HORIZON_FACTOR * seconds, self.seed)
        return VirtualLink.over(
            SimulatedTransport(controller, faults), self.cell, finish=controller.finish
        )

    def _ur_link(self, seconds: float, *, effects: bool) -> VirtualLink:
        """Return one to a controller of Universal Robots: its servoj lags by some 30 ms.

        It has the torque constants of the cell.
        """
        truth = arm_truth(self.cell, exact=True)
        robot = simulated_ur(self.cell, seed=self.seed, truth=truth, effects=effects)
        peer = UrPeer(robot)
        faults = link_faults(self.cell, _FAULT_HORIZON_FACTOR * seconds, self.seed)
        return VirtualLink.over(SimulatedTransport(peer, faults), self.cell, finish=peer.finish)

    @property
    def provenance(self) -> dict[str, str]:
        """Metadata of a rehearsal's archive, with the simulated parameters."""
        planted = dict(zip(self.cell.model.parameter_names, self.truth.tolist(), strict=True))
        return {
            **simulated_provenance(self.cell, effects=False),
            "rehearsal": "yes",
            "planted": json.dumps(planted),
        }


def _ur_table(cell: Cell) -> dict[str, Any]:
    """Return what makes a simulated controller one of Universal Robots."""
    return {"controller.rtde.port": cell.controller.rtde.port} if cell.is_ur else {}


def link_faults(cell: Cell, seconds: float, seed: int) -> tuple[Fault, ...]:
    """Return single packets doubled, late or, where a motion survives it, lost within `seconds`."""
    rng = np.random.default_rng([seed, 7])
    cycles = round(seconds / cell.period)
    count = max(1, round(seconds / MEAN_FAULT_INTERVAL))
    survived = cell.max_gap > 0 and too_far_without_a_packet(cell) is None
    kinds = ["delay", "duplicate", *(["lose"] if survived else [])]
    faults: list[Fault] = []
    # Not in the packets of the start.
    for cycle in sorted(rng.integers(1000, max(1001, cycles), count).tolist()):
        match kinds[rng.integers(len(kinds))]:
            case "delay":
                faults.append(Delay(cycle, cycles=float(rng.uniform(0.1, 0.8))))
            case "duplicate":
                faults.append(Duplicate(cycle))
            case _:
                faults.append(Lose(cycle))
    return tuple(faults)


def too_far_without_a_packet(cell: Cell) -> NoLostPackets | None:
    """Return why a lost packet ends a motion at full speed; None where the motion survives it.

    A controller that extrapolates is then one step ahead of the set-point sent last.
    """
    if not cell.max_gap:
        return None
    share = MAX_TARGET_JUMP * np.array(cell.drive_table.following_error)
    speeds = np.diag(cell.joint_limits.velocity)
    turns = cell.drive_train.motor_revolutions_per_cycle(speeds, cell.period)
    steps = np.abs(turns).sum(axis=0)
    motor = int(np.argmax(steps / share))
    if steps[motor] <= share[motor]:
        return None
    name = cell.joint_names[motor]
    turned, allowed = float(steps[motor]), float(share[motor])
    return NoLostPackets(name, turned, allowed, cell.controller.cycle_ms)


def _varied(cell: Cell, rng: np.random.Generator) -> dict[str, list[float]]:
    """Return inertias, rotors and friction varied about the values of the URDF and `[nominal]`."""
    nominal = cell.nominal
    n = len(cell.joint_names)

    def varied(values: list[float]) -> list[float]:
        factors = 1.0 + PARAMETER_SPREAD * rng.uniform(-1.0, 1.0, n)
        return (np.array(values) * factors).tolist()  # type: ignore[no-any-return]

    return {
        "inertia_scale": varied([1.0] * n),
        "rotor_inertia": varied(nominal.rotor_inertia),
        "coulomb": varied(nominal.coulomb),
        "viscous": varied(nominal.viscous),
        "third": varied(nominal.third or [0.0] * n),
    }


def _simulation(
    cell: Cell, planted: dict[str, list[float]], seed: int
) -> tuple[dict[str, Any], list[Assumption]]:
    """Return `[simulation]` of the simulated arm, and what in it is assumed."""
    table: dict[str, Any] = {**planted, "seed": seed}
    assumed: list[Assumption] = []
    given = cell.file.simulation
    if given is None:
        table |= assumed_simulation(cell)
        assumed.append(CurrentNoise(table["current_noise"], table["current_resolution"]))
    if given is None or not (
        given.torque_ripple or given.friction_drift or any(given.elasticity) or given.delay
    ):
        effects = _ordinary_effects(cell, np.array(planted["rotor_inertia"]))
        table |= asdict(effects) | {"elasticity": list(effects.elasticity)}
        assumed.append(DefaultEffects(effects.torque_ripple, effects.friction_drift, effects.delay))
    fields = ("rotor_inertia", "coulomb", "viscous")
    if unknown := tuple(key for key in fields if not any(planted[key])):
        assumed.append(ZeroNominal(unknown))
    return table, assumed


def _ordinary_effects(cell: Cell, rotors: Array) -> UnmodelledEffects:
    """Return effects of default sizes, with springs that suit the arm.

    No resonance exceeds `MAX_RESONANCE` in any of `RESONANCE_POSTURES` random postures. Where axes
    are almost parallel, the effective inertia beyond a spring is much below that of its link.
    """
    n = len(rotors)
    limits = cell.joint_limits
    model = pinocchio.buildModelFromXML(cell.urdf)
    data = model.createData()

    def inertia(posture: Array) -> Array:
        upper = np.triu(pinocchio.crba(model, data, posture))
        return np.asarray(upper + np.triu(upper, 1).T)

    links = inertia(cell.home).diagonal()
    reduced = rotors * links / np.maximum(rotors + links, np.finfo(np.float64).tiny)
    soft = (np.arange(n) < MAIN_AXES) & (reduced > 0.0)
    compliance = np.zeros(n)
    compliance[soft] = 1.0 / (reduced[soft] * MAIN_AXIS_RESONANCE**2)
    root = 1.0 / np.sqrt(compliance[soft])
    fastest = 0.0
    shares = np.random.default_rng(0).random((RESONANCE_POSTURES, n))
    for posture in [cell.home, *(limits.lower + shares * (limits.upper - limits.lower))]:
        if soft.any():
            whole = inertia(posture) + np.diag(np.where(soft, 0.0, rotors))
            mobility = np.linalg.inv(whole)[np.ix_(soft, soft)] + np.diag(1.0 / rotors[soft])
            frequency = float(np.linalg.eigvalsh(root[:, None] * mobility * root)[-1])
            fastest = max(fastest, frequency)
    compliance *= max(1.0, float(np.sqrt(fastest)) / MAX_RESONANCE) ** 2
    return replace(UnmodelledEffects.default_sizes(n), elasticity=tuple(compliance.tolist()))
