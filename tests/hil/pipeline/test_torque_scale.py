"""Where the uncertainty of torques is stated, and which statement counts."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from hil.archive.recording_of_archive import open_recording
from hil.base.errors import SourceError
from hil.cell import Cell
from hil.cell.errors import CellError
from hil.importers.log import import_log
from hil.pipeline.note_messages import scale_words
from hil.pipeline.torque_scale import torque_scale
from identification.signals.recording import Recording
from tests.hil.simulated_logs import JOINTS, column_map, three_joint_robot

ROOT = Path(__file__).resolve().parents[3]
EXAMPLE = ROOT / "examples" / "two_joints" / "cell.toml"


def example(**stated: str) -> Cell:
    """The example's cell with entries of its tables."""
    text = EXAMPLE.read_text()
    for table, entry in stated.items():
        if f"[{table}]\n" not in text:
            text += f"\n[{table}]\n"
        text = text.replace(f"[{table}]\n", f"[{table}]\ntorque_uncertainty = {entry}\n")
    return Cell.from_texts(text, (EXAMPLE.parent / "robot.urdf").read_text(), EXAMPLE)


def recording(provenance: dict[str, str] | None = None) -> Recording:
    still = np.zeros((3, 2))
    return Recording(
        time=np.arange(3.0),
        position=still,
        joint_names=("a", "b"),
        torque=still,
        motor_current=still,
        provenance=provenance or {},
    )


class TestWhichCounts:
    def test_without_a_statement_that_of_a_data_sheet(self) -> None:
        scale = torque_scale(example(), [recording()], simulated=False)
        assert scale.std.tolist() == [0.03, 0.03]
        assert scale_words(scale).startswith("assuming torque constants to 3 %")

    def test_a_simulated_arm_has_the_constants_of_its_cell(self) -> None:
        scale = torque_scale(example(), [recording()], simulated=True)
        assert scale.std.tolist() == [0.0, 0.0]
        assert scale_words(scale).startswith("assuming exact torques")

    @pytest.mark.parametrize("simulated", [False, True])
    def test_the_cell_comes_before_the_default(self, simulated: bool) -> None:
        cell = example(drive_train="[0.01, 0.02]")
        scale = torque_scale(cell, [recording()], simulated=simulated)
        assert scale.std.tolist() == [0.01, 0.02]

    def test_the_column_map_comes_before_the_cell(self) -> None:
        mapped = [
            recording({"torque_uncertainty": text}) for text in ("[0.004, 0.1]", "[0.005, 0]")
        ]
        cell = example(robot="0.02")
        assert torque_scale(cell, mapped[:1], simulated=False).std.tolist() == [0.004, 0.1]
        both = torque_scale(cell, [*mapped, recording()], simulated=False)
        assert both.std.tolist() == [0.02, 0.1]


class TestRefused:
    def test_two_statements_in_one_cell(self) -> None:
        with pytest.raises(CellError, match=r"stated in \[drive_train\], too"):
            example(robot="0.02", drive_train="0.01")

    @pytest.mark.parametrize("entry", ["[0.1, 0.1, 0.1]", "-0.1", "1.0", "[]"])
    @pytest.mark.parametrize("table", ["robot", "drive_train"])
    def test_a_wrong_count_or_share_in_the_cell(self, table: str, entry: str) -> None:
        with pytest.raises(CellError, match="torque_uncertainty"):
            example(**{table: entry})

    def test_a_wrong_count_in_the_map(self, tmp_path: Path) -> None:
        with pytest.raises(SourceError, match=r"torque_uncertainty.*has 2 entries"):
            imported(tmp_path, {"torque_uncertainty": [0.1, 0.1]})


def imported(folder: Path, drive: dict[str, object], joints: tuple[str, ...] = JOINTS) -> Path:
    table = "\n".join(["q1,q2,q3", *(f"{0.01 * k},0,0" for k in range(20))])
    (folder / "log.csv").write_text(table)
    columns = column_map(drive=drive, joints=list(joints))
    return import_log(
        folder / "log.csv", folder / "log.mcap", robot=three_joint_robot(folder), columns=columns
    )


def test_the_map_s_entries_are_in_the_order_of_the_robot(tmp_path: Path) -> None:
    drive: dict[str, object] = {"torque_uncertainty": [0.1, 0.2, 0.3]}
    archive = imported(tmp_path, drive, joints=(JOINTS[2], JOINTS[0], JOINTS[1]))
    assert open_recording(archive).provenance["torque_uncertainty"] == "[0.2, 0.3, 0.1]"
