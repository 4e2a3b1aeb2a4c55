"""Draw docs/verdict.png: what measured and predicted torque look like with six faults.

`PYTHONPATH=. python docs/verdict_pictures.py`: a simulated UR5, each fault put into its log.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final

import numpy as np
from matplotlib.figure import Figure
from PIL import Image

import hil
from tests.hil.simulated_logs import simulate, write_log

HERE: Final = Path(__file__).parent
STEP: Final = 0.01  # s
JOINT: Final = 1  # that is drawn and has the fault

Change = Callable[[np.ndarray], np.ndarray]


def late(torque: np.ndarray) -> np.ndarray:
    """Return the torque 60 ms later."""
    return np.roll(torque, round(0.06 / STEP), axis=0)


def of_one(factor: float) -> Change:
    """Return a change of the torque of one joint by a factor."""
    factors = np.where(np.arange(6) == JOINT, factor, 1.0)
    return lambda torque: torque * factors


def cut(torque: np.ndarray) -> np.ndarray:
    """Return the torque as a sensor or drive with too small a range has it."""
    limit = 0.75 * np.abs(torque).max(axis=0)
    return np.clip(torque, -limit, limit)


def noisy(torque: np.ndarray) -> np.ndarray:
    """Return the torque with noise of half its scatter."""
    rng = np.random.default_rng(3)
    return torque + 0.5 * torque.std(axis=0) * rng.standard_normal(torque.shape)


FAULTS: Final[dict[str, Change]] = {
    "none": lambda torque: torque,
    "sign of one torque": of_one(-1.0),
    "one torque constant": of_one(2.0),
    "torque 60 ms late": late,
    "torque cut off": cut,
    "noise": noisy,
}


def main() -> None:
    """Draw the picture."""
    motion = simulate("ur5_robot.urdf", np.arange(0.0, 16.0, STEP))
    figure = Figure((11.0, 5.6), layout="constrained")
    with TemporaryDirectory() as folder:
        for axes, (name, change) in zip(figure.subplots(2, 3).flat, FAULTS.items(), strict=True):
            log = write_log(
                Path(folder) / "log.csv",
                ["t", "q{}", "tau{}"],
                *(motion.time, motion.position, change(motion.torque)),
            )
            found = hil.identify(log, urdf=motion.urdf)
            found.plot(JOINT, axes=axes)
            words = "good" if found.verdict.good else "not good"
            if any(recording.changes for recording in found.results.recordings):
                words = f"corrected, {words}"
            axes.set_title(f"{name}: {words}")
            axes.get_legend().set_visible(name == "none")
    figure.savefig(HERE / "verdict.png", dpi=100)
    picture = Image.open(HERE / "verdict.png").convert("RGB").quantize(64)
    picture.save(HERE / "verdict.png", optimize=True)


if __name__ == "__main__":
    main()
