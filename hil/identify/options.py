"""What a person may choose about an identification."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Method = Literal["default", "paper"]


@dataclass(frozen=True)
class Options:
    """How archives are turned into a result.

    Attributes:
        method: "default" smooths positions only; "paper" smooths positions and torques and
            filters the regressor alike.
        split: share of a single recording that is fitted; the rest is predicted. Used only where
            there are no validation runs.
        delay: time by which the torque lags the position [s]; None takes it from the cell.
        torque_bandwidth: low-pass [Hz] the torque has come through before it was recorded; None
            for none. "auto" looks for one in imported torques; a controller's own currents are
            known to have come through none.
    """

    method: Method = "default"
    split: float = 0.7
    delay: float | None = None
    torque_bandwidth: float | Literal["auto"] | None = "auto"
