"""Many archives at once: three campaigns of one arm, with more shoulder friction in the last.

Prints the friction of every campaign with its 95 % interval, from the folders with archives. The
picture shows it over time. The same on the command line: `hil batch FOLDER...`.
"""

from pathlib import Path
from tempfile import TemporaryDirectory

import matplotlib.pyplot as plt

from hil import Campaign, Cell, Options, Silent, reidentify
from hil.batch.cluster import Cluster
from hil.campaign import design

HERE = Path(__file__).parent
PICTURE = Path("runs/examples/06_batch.png")


def record(root: Path) -> None:
    """Three campaigns; the arm of the third has more friction in its shoulder."""
    arm = Cell.load(HERE / "two_joints" / "cell.toml").with_campaign(
        repetitions=2, validation_runs=1
    )
    plan = design(arm, Silent())
    for month, shoulder in (("2026-04", 8.2), ("2026-05", 8.2), ("2026-06", 12.3)):
        cell = arm.with_values({"simulation.coulomb": [shoulder, 3.1]})
        Campaign.create(root / month, cell, plan).run(unrehearsed=True)


def main() -> None:
    """Record, re-identify, draw."""
    with TemporaryDirectory() as folder, Cluster() as cluster:
        record(Path(folder))
        result = reidentify([folder], Options(), cluster, Silent())
    figure, axes = plt.subplots(figsize=(8, 3.5), layout="constrained")
    for level in result.campaigns:
        month = Path(level.campaign).name
        estimate = level.estimate
        for name, value, std in zip(estimate.names, estimate.values, estimate.std, strict=True):
            if name.startswith("f0"):
                print(f"{month:6s} {name}: {value:6.2f} ± {1.96 * std:.2f} N·m")
                style = {"f0_1": "ko", "f0_2": "C1s"}[name]
                axes.errorbar(month, value, 1.96 * std, fmt=style, capsize=4)
    axes.set(ylabel="Coulomb friction [N·m]", ylim=(0, None))
    axes.set_title("round: shoulder, square: elbow; 95 % intervals", fontsize="medium")
    PICTURE.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(PICTURE, dpi=90)


if __name__ == "__main__":
    main()
