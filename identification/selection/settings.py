"""Settings of an identification: of recordings into samples, and of the estimate."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from identification.selection.averaging import AveragedBandwidth
from identification.signals.masks import ExcludedRows
from identification.signals.samples import Preprocessing, VelocitySource
from identification.signals.smoothing import LowPassShape


@dataclass(frozen=True)
class Strength:
    """How strongly the prior counts against the data."""

    weight: float = 1.0  #: of the described bodies, as a multiple of their information
    consistent: bool = False  #: whether parameters that no bodies have are excluded
    #: whether rotors that act like a link's inertia may also make half of their joint's torque
    wide_rotors: bool = False


@dataclass(frozen=True)
class Candidate:
    """What candidates of a setting may differ in; :mod:`.messages` words the differences."""

    bandwidth: float  #: of the motion [Hz]
    velocity: VelocitySource
    #: names of the friction terms of the first joint, with the speed that a term has [rad/s]
    friction: tuple[tuple[str, float | None], ...]
    presliding: float | None  #: displacement [rad]
    tanh: float | None  #: speed of a smooth reversal [rad/s]
    ripple: tuple[int, ...]  #: orders per motor turn
    springs: tuple[str, ...]  #: joints
    position_torques: tuple[str, ...]  #: joints
    excluded_rows: ExcludedRows | None  #: None: by the friction law
    delay: float  #: of the torque [s]
    low_pass: float | None  #: of the torque [Hz]
    shape: LowPassShape  #: of that
    strength: Strength  #: of the prior


@dataclass(frozen=True)
class Choice:
    """Decision by inner prediction."""

    name: str  # of the setting
    candidates: tuple[Candidate, ...]
    # ``||e|| / ||tau||`` over all joints, of a low-pass their geometric mean by joint; geometric
    # mean over the segments
    errors: tuple[float, ...]
    chosen: int  # index of the candidate


@dataclass(frozen=True)
class Settings:
    """Settings of the preprocessing and estimation of an arm's archives; serialisable.

    The user's options state some of them, inner prediction chooses the others.
    """

    preprocessing: Preprocessing  #: with the delay of the torque
    #: entries of `[robot.friction]` that replace the arm's
    friction: Mapping[str, Any] = field(default_factory=dict)
    #: of the positions (n,) [rad² or m²]; None estimates it in each recording
    noise_variance: tuple[float, ...] | None = None
    #: of the torques (n,) [N²·m² or N²]; None estimates it in each recording
    torque_variance: tuple[float, ...] | None = None
    stated_delay: float = 0.0  #: of the torque, by cell or options [s]
    delay_variance: float = 0.0  #: mean square error of the delay [s²]; zero if it is known
    #: bandwidth that the chosen one is averaged with; None: with none
    hedge: AveragedBandwidth | None = None
    strength: Strength = Strength()
    choices: tuple[Choice, ...] = ()  #: made by inner prediction
    #: parameters (p,) of bodies and drives that load the gears, for friction that grows with it;
    #: None: it does not, or they are estimated with it
    loading: tuple[float, ...] | None = None

    @property
    def versions(self) -> tuple[Settings, ...]:
        """These settings, and the settings of the bandwidth they are averaged with, if any."""
        if self.hedge is None:
            return (self,)
        return self, self.preprocessed(rigid_bandwidth=self.hedge.bandwidth)

    @property
    def shares(self) -> tuple[float, ...]:
        """Share of each of the versions in sums over rows."""
        return (1.0,) if self.hedge is None else self.hedge.shares

    def preprocessed(self, **changes: Any) -> Settings:
        """Return these settings with changes of the preprocessing."""
        return replace(self, preprocessing=replace(self.preprocessing, **changes))

    def with_friction(self, **changes: Any) -> Settings:
        """Return these settings with changed entries of `[robot.friction]`."""
        return replace(self, friction={**self.friction, **changes})
