"""Your own arm: a URDF and a cell file of fifty lines, `two_joints/`, are enough.

Prints the true parameters of the simulated arm, which differ from the nominal ones, and the
estimates with their 95 % intervals. The picture is the torque of a held-out motion, measured and
predicted. Put your own URDF and cell file there (`hil new` writes one).
"""

import sys
from pathlib import Path
from tempfile import TemporaryDirectory

import matplotlib.pyplot as plt

from hil import Campaign, Cell, Silent
from hil.campaign import design

HERE = Path(__file__).parent
PICTURE = Path("runs/examples/03_own_robot.png")


def main(cell_file: Path) -> None:
    """Design, run and identify; draw the prediction."""
    cell = Cell.load(cell_file)
    with TemporaryDirectory() as folder:
        campaign = Campaign.create(Path(folder) / "campaign", cell, design(cell, Silent()))
        campaign.run(unrehearsed=True)  # a simulated arm only; a real one is rehearsed first
        identification = campaign.identify()
    print(identification.results.verdict.line)
    for entry in identification.results.parameters:
        planted = "" if entry.truth is None else f"{entry.truth:9.3f}"
        print(
            f"{entry.name:>40s}  {entry.estimate:9.3f} ± {1.96 * entry.std:.3f}  planted {planted}"
        )
    series = identification.series
    names = cell.joint_names
    figure, rows = plt.subplots(len(names), sharex=True, figsize=(8, 4.5), layout="constrained")
    for joint, (axes, name) in enumerate(zip(rows, names, strict=True)):
        axes.plot(series.example_time, series.example_measured[:, joint], "k", label="measured")
        axes.plot(series.example_time, series.example_predicted[:, joint], "--", color="#d98200",
                  label="predicted")  # fmt: skip
        axes.set_ylabel(f"{name} [N·m]")
    rows[0].legend(loc="upper right", ncols=2)
    rows[-1].set_xlabel(f"time of {series.example_archive} [s]")
    PICTURE.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(PICTURE, dpi=90)


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else HERE / "two_joints" / "cell.toml")
