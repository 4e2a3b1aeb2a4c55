"""The simulated twin of a cell: an arm near the nominal one, behind the cell's own link.

The twin knows of the cell what a robot would: its links, its gears, its limits. What nobody knows
before the robot has moved is varied: masses, inertias, rotors and friction within `SPREAD` of the
nominal figures. A cell without `[simulation]` gets one from `[nominal]` and the defaults below.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, replace
from typing import Any, Final

import numpy as np
import pinocchio
from numpy.typing import NDArray

from drivers.transports import SimulatedTransport
from drivers.transports.faults import Delay, Duplicate, Fault, Lose
from hil.cell import Cell
from hil.cell.text import replaced_value
from hil.simulation import (
    controller_settings,
    planted_values,
    simulated_controller,
    simulated_provenance,
)
from planner.toml_text import toml_value
from sim_fixtures import ServoSettings, SimulatedDrive, UnmodelledEffects

from .link import Link

Array = NDArray[np.float64]

SPREAD: Final = 0.1
"""Largest relative distance of what is planted from what is nominal."""
NOISE_SHARE: Final = 0.005
"""Current that flows about the target current, rms, as a share of the weakest motor's limit."""
RESOLUTION_SHARE: Final = 0.001
"""Step of the target current, likewise."""
FAULT_EVERY: Final = 3.0
"""s between two faults of the link, on average."""
LOOP_CYCLES: Final = 0.5
"""A target current acts over the cycle before the packet: half a cycle earlier on average."""
RESONANCE: Final = 500.0
"""rad/s of a main axis, rotor against link, where the cell says nothing of elasticity."""
FASTEST: Final = 800.0
"""rad/s that no resonance exceeds in any posture: the simulated arm is stepped in half cycles."""
POSTURES: Final = 60
"""That are looked at for it."""
MAIN_AXES: Final = 3
SLOWEST_LOOP: Final = 0.002
"""s; a slower current loop would shake the simulated arm."""
_HORIZON: Final = 4.0
"""Faults are varied for so many times the motion's length: settling and ways take time too."""


@dataclass(frozen=True, eq=False)
class Twin:
    """A simulated arm to rehearse on.

    Attributes:
        cell: nominal, but simulated, with fewer repetitions; what was varied is in its
            `[simulation]`.
        truth: planted parameters (p,) in the order of the model.
        assumed: what the arm has by assumption, in sentences.
        seed: of everything varied.
    """

    cell: Cell
    truth: Array
    assumed: tuple[str, ...]
    seed: int

    @classmethod
    def of(cls, cell: Cell, *, seed: int, repetitions: int) -> Twin:
        """Draw an arm for a cell.

        Args:
            cell: of any robot, with or without `[simulation]`.
            seed: of what is varied.
            repetitions: at most so many.
        """
        rng = np.random.default_rng(seed)
        planted = _varied(cell, rng)
        settings, assumed = _simulation(cell, planted, seed)
        text = _with_table(cell.text, "simulation", settings)
        text = replaced_value(text, "controller", "transport", toml_value("simulated"))
        fewer = min(repetitions, cell.campaign.repetitions)
        text = replaced_value(text, "campaign", "repetitions", fewer)
        twin = Cell.from_texts(text, cell.urdf, cell.path)
        return cls(twin, planted_values(twin), tuple(assumed), seed)

    def link(self, seconds: float, *, effects: bool, drive: SimulatedDrive | None = None) -> Link:
        """A link in virtual time to the arm, with faults now and then.

        Args:
            seconds: of motion that are to be run on it.
            effects: switch on what the model leaves out.
            drive: the arm's gears and motors, where they shall not be those of the cell.
        """
        settings = replace(
            controller_settings(self.cell, effects=effects),
            servo=_servo(self.cell),
            # Packets in a row that the cell says a motion survives.
            missed_replies=self.cell.controller.max_gap + 1,
            while_silent="continue",
        )
        controller = simulated_controller(
            self.cell,
            settings=settings,
            effects=effects,
            drive=drive,
            seed=self.seed,
        )
        faults = link_faults(self.cell, _HORIZON * seconds, self.seed)
        return Link.over(
            SimulatedTransport(controller, faults), self.cell, finish=controller.finish
        )

    @property
    def provenance(self) -> dict[str, str]:
        """Metadata that mark an archive as a rehearsal's, and say what was planted."""
        planted = dict(zip(self.cell.model.parameter_names, self.truth.tolist(), strict=True))
        return {
            **simulated_provenance(self.cell, effects=False),
            "rehearsal": "yes",
            "planted": json.dumps(planted),
        }


def link_faults(cell: Cell, seconds: float, seed: int) -> tuple[Fault, ...]:
    """Faults of an ordinary network: single packets that are lost, doubled or late.

    Args:
        cell: its `max_gap` says whether a lost packet is survived at all.
        seconds: of the controller's time that they are varied for.
        seed: of the draw.
    """
    rng = np.random.default_rng([seed, 7])
    cycles = round(seconds / cell.period)
    count = max(1, round(seconds / FAULT_EVERY))
    kinds = ["delay", "duplicate", *(["lose"] if cell.controller.max_gap else [])]
    faults: list[Fault] = []
    # Not in the packets of the start: what is rehearsed is motion.
    for cycle in sorted(rng.integers(1000, max(1001, cycles), count).tolist()):
        match kinds[rng.integers(len(kinds))]:
            case "delay":
                faults.append(Delay(cycle, cycles=float(rng.uniform(0.1, 0.8))))
            case "duplicate":
                faults.append(Duplicate(cycle))
            case _:
                faults.append(Lose(cycle))
    return tuple(faults)


def _varied(cell: Cell, rng: np.random.Generator) -> dict[str, list[float]]:
    """Inertias of links, rotors and friction within the spread of the URDF and of `[nominal]`."""
    nominal = cell.nominal
    n = len(cell.joint_names)

    def varied(values: list[float]) -> list[float]:
        factors = 1.0 + SPREAD * rng.uniform(-1.0, 1.0, n)
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
) -> tuple[dict[str, Any], list[str]]:
    """`[simulation]` of the twin, and what in it is assumed."""
    table: dict[str, Any] = {**planted, "seed": seed}
    assumed = []
    given = cell.file.simulation
    if given is None:
        weakest = min(cell.drive_table.current_limit)
        table["initial_deg"] = cell.campaign.home_deg
        table["current_noise"] = NOISE_SHARE * weakest
        table["current_resolution"] = RESOLUTION_SHARE * weakest
        assumed.append(
            f"the current trembles by {table['current_noise']:.3g} A rms and comes in steps of "
            f"{table['current_resolution']:.3g} A ({NOISE_SHARE:.1%} and {RESOLUTION_SHARE:.1%} of "
            "the weakest motor's limit)"
        )
    if given is None or not (
        given.torque_ripple or given.friction_drift or any(given.elasticity) or given.delay
    ):
        effects = _ordinary_effects(cell, np.array(planted["rotor_inertia"]))
        table |= asdict(effects) | {"elasticity": list(effects.elasticity)}
        assumed.append(
            f"what the model leaves out is of ordinary size: torque ripple of "
            f"{effects.torque_ripple:.0%} of the Coulomb torque, friction that falls by "
            f"{effects.friction_drift:.0%}, springs in the main axes, {1e3 * effects.delay:g} ms "
            "of delay"
        )
    unknown = [key for key in ("rotor_inertia", "coulomb", "viscous") if not any(planted[key])]
    if unknown:
        assumed.append(f"[nominal] has nothing but zeros for {', '.join(unknown)}: so has the arm")
    return table, assumed


def _ordinary_effects(cell: Cell, rotors: Array) -> UnmodelledEffects:
    """Effects at their default sizes, with springs that suit the size of the arm."""
    n = len(cell.joint_names)
    links = _inertia(cell, cell.home).diagonal()
    reduced = rotors * links / np.maximum(rotors + links, np.finfo(np.float64).tiny)
    main = (np.arange(n) < MAIN_AXES) & (reduced > 0.0)
    compliance = np.zeros(n)
    compliance[main] = 1.0 / (reduced[main] * RESONANCE**2)
    if main.any():
        compliance *= max(1.0, _fastest(cell, rotors, compliance) / FASTEST) ** 2
    return replace(UnmodelledEffects.default_sizes(n), elasticity=tuple(compliance.tolist()))


def _inertia(cell: Cell, posture: Array) -> Array:
    """Inertia matrix of the links (n, n) [kg m²]."""
    model = pinocchio.buildModelFromXML(cell.urdf)
    upper = np.triu(pinocchio.crba(model, model.createData(), posture))
    return np.asarray(upper + np.triu(upper, 1).T)


def _fastest(cell: Cell, rotors: Array, compliance: Array) -> float:
    """Fastest resonance of springs (n,) in any of some postures within the limits [rad/s].

    Where axes are almost parallel, as the first and the third of an arm with seven, the link beyond
    a spring is much lighter than its own inertia says: the next axis gives way.
    """
    limits, soft = cell.joint_limits, compliance > 0.0
    shares = np.random.default_rng(0).random((POSTURES, len(rotors)))
    postures = [cell.home, *(limits.lower + shares * (limits.upper - limits.lower))]
    root = 1.0 / np.sqrt(compliance[soft])
    found = 0.0
    for posture in postures:
        inertia = _inertia(cell, posture) + np.diag(np.where(soft, 0.0, rotors))
        mobility = np.linalg.inv(inertia)[np.ix_(soft, soft)] + np.diag(1.0 / rotors[soft])
        found = max(found, float(np.linalg.eigvalsh(root[:, None] * mobility * root)[-1]))
    return float(np.sqrt(found))


def _servo(cell: Cell) -> ServoSettings:
    """A current loop as late as the cell says that its currents are."""
    lag = (LOOP_CYCLES - cell.controller.current_delay_cycles) * cell.period
    return ServoSettings(current_lag=float(np.clip(lag, 0.0, SLOWEST_LOOP)))


def _with_table(text: str, table: str, settings: dict[str, Any]) -> str:
    """The text of a cell file with these settings in a table, added where there is none."""
    if f"[{table}]" not in text:
        text += f"\n[{table}]\n"
    for key, value in settings.items():
        text = replaced_value(text, table, key, toml_value(value))
    return text
