"""A fleet over months: five robots of one type, whose logs are thirty small CSV files.

The elbow of robot3 wears by 9 % a month; all robots have a season. Prints what `hil trend` says of
the logs, and draws the friction of every elbow.
"""

import csv
import subprocess
import sys
from datetime import UTC, datetime, timedelta
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pinocchio

ARM = Path(__file__).parent / "two_joints" / "robot.urdf"
OUTPUT = Path("runs/examples/fleet")
PICTURE = Path("runs/examples/08_fleet.png")
FIRST = datetime(2026, 1, 12, 6, tzinfo=UTC)
COULOMB = np.array([7.0, 3.5])  # N·m
VISCOUS = np.array([4.0, 2.0])  # N·m·s/rad


def friction(robot: int, month: int) -> np.ndarray:
    """What a robot's friction is multiplied by, which its maker does not know."""
    own = np.random.default_rng([robot, month]).normal(1.0, 0.01, 2)
    season = 1.0 + 0.06 * np.cos(2.0 * np.pi * month / 12.0)
    wear = 1.0 + 0.09 * max(0.0, month - 1.5) * np.array([0.0, robot == 3])
    return own * season * wear


def write_log(path: Path, robot: int, month: int) -> None:
    """Eight seconds of motion at 100 Hz: time, positions and torques."""
    start = FIRST + timedelta(days=30.4 * month, hours=robot)
    time = np.arange(0.0, 8.0, 0.01)
    random = np.random.default_rng([robot, month, 1])
    frequency = 2.0 * np.pi * np.array([[0.25, 0.375], [0.625, 0.875], [1.0, 1.25]])
    angle = frequency * time[:, None, None] + random.uniform(0.0, 6.0, (3, 2))
    size = np.array([[0.6], [0.3], [0.15]])
    position = (size * np.sin(angle)).sum(axis=1)
    velocity = (size * frequency * np.cos(angle)).sum(axis=1)
    acceleration = -(size * frequency**2 * np.sin(angle)).sum(axis=1)
    model = pinocchio.buildModelFromUrdf(str(ARM))
    data = model.createData()
    states = zip(position, velocity, acceleration, strict=True)
    torque = np.array([pinocchio.rnea(model, data, *state) for state in states])
    torque += friction(robot, month) * (COULOMB * np.sign(velocity) + VISCOUS * velocity)
    torque += 0.02 * torque.std(axis=0) * random.standard_normal(torque.shape)
    path.parent.mkdir(parents=True, exist_ok=True)
    header = "timestamp,q1,q2,tau1,tau2"
    rows = np.column_stack([start.timestamp() + time, position, torque])
    np.savetxt(path, rows, ["%.6f", *["%.8g"] * 4], ",", header=header, comments="")


def main() -> None:
    """Write the logs, ask for their trend, draw."""
    for robot in range(1, 6):
        for month in range(6):
            write_log(OUTPUT / f"robot{robot}" / f"2026-{month + 1:02d}.csv", robot, month)
    command = [sys.executable, "-m", "hil", "trend", str(OUTPUT), "--urdf", str(ARM)]
    command += ["--robot", "{robot}/{date}.csv", "-o", str(OUTPUT / "trend.html")]
    table = OUTPUT.parent / "fleet.csv"
    subprocess.run([*command, "--table", str(table)], check=True)
    with table.open(newline="") as file:
        rows = [row for row in csv.DictReader(file) if row["quantity"] == "friction"]
    figure, axes = plt.subplots(figsize=(8, 3.5), layout="constrained")
    for robot in sorted({row["robot"] for row in rows}):
        elbow = [row for row in rows if row["robot"] == robot and row["joint"] == "elbow"]
        dates = [datetime.fromisoformat(row["when"]) for row in elbow]
        values, stds = (np.array([float(row[name]) for row in elbow]) for name in ("value", "std"))
        axes.errorbar(dates, values, 1.96 * stds, marker="o", capsize=3, label=robot)
    axes.set(ylabel="friction of the elbow [N·m]", ylim=(0, None))
    axes.legend(ncols=5, fontsize="small")
    PICTURE.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(PICTURE, dpi=90)


if __name__ == "__main__":
    main()
