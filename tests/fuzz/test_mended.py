"""What fuzzing found, each as the shortest file that a person might really have."""

from __future__ import annotations

import json
import sqlite3
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from drivers import CyclicPacket, InitPacket
from drivers.states import State
from drivers.transports.can.bus_load import BusRates
from drivers.transports.can.ends import ControllerEnd
from hil.archive import Samples, write_samples
from hil.campaign.folder import CampaignFolder
from hil.campaign.rehearsal import Rehearsal
from hil.cell import Cell
from hil.design.result import DesignResult
from hil.errors import ArchiveError, InputError, SourceError
from hil.importers import ColumnMap, import_log, import_rosbag2
from hil.new import from_archive
from hil.plots.archive_view import _state_name, view_of
from identification.errors import ModelError
from identification.model.kinematics import chain_from_urdf
from identification.model.payload import Payload
from planner.toml_text import from_text
from tests.fault_matrix.small_cell import URDF
from tests.fuzz.targets import documents, importers
from tests.hil.fast_cell import CELL
from tests.hil.fast_cell import URDF as CELLS_URDF

JOINTS = ("shoulder", "elbow")


def archive(path: Path, **attachments: bytes) -> Path:
    """Three samples of two joints, with attachments (`_` stands for the dot of their names)."""
    return write_samples(
        path,
        Samples(np.arange(3) * 2_000_000, position=np.zeros((3, 2)), torque=np.ones((3, 2))),
        joint_names=JOINTS,
        metadata={},
        attachments={".".join(name.rsplit("_", 1)): data for name, data in attachments.items()},
        durable=False,
    )


@pytest.mark.parametrize(
    "table", [b"{", b"[1]", b"\xff", b'{"current_limit": "ab"}', b'{"current_limit": [null, 1]}',
              b'{"current_limit": [NaN, 1]}', b"[" * 9999]
)  # fmt: skip
def test_limits_in_an_archive_that_are_none_are_not_drawn(tmp_path: Path, table: bytes) -> None:
    view = view_of(archive(tmp_path / "imported.mcap", drive_train_json=table))
    assert view.quantities
    assert all(trace.high is None for one in view.quantities for trace in one.traces)


def test_a_clock_that_jumps_by_a_lifetime_costs_no_time(tmp_path: Path) -> None:
    path = write_samples(
        tmp_path / "imported.mcap",
        Samples(np.array([0, 2**60]), position=np.ones((2, 2)), torque=np.ones((2, 2))),
        joint_names=JOINTS,
        metadata={},
        durable=False,
    )
    view = view_of(path)
    assert view.stop == pytest.approx(2**60 * 1e-9)
    assert np.count_nonzero(np.isfinite(view.quantities[0].traces[0].value)) == 2


def test_a_position_too_large_for_degrees_is_missing_in_the_picture(tmp_path: Path) -> None:
    position = np.array([[0.1, 0.2], [1e307, -1e307], [0.3, 0.4]])
    path = write_samples(
        tmp_path / "imported.mcap",
        Samples(np.arange(3) * 2_000_000, position=position, torque=np.ones((3, 2))),
        joint_names=JOINTS,
        metadata={},
        durable=False,
    )
    (drawn,) = (one for one in view_of(path).quantities if one.title == "position [deg]")
    assert np.nanmax(np.abs(drawn.traces[0].value)) == pytest.approx(np.degrees(0.3))


@pytest.mark.parametrize(
    ("name", "content", "problem"),
    [
        ("cell_toml", b"[cell", "is no TOML"),
        ("cell_toml", b"a = " + b"[" * 9999, "is no TOML"),
        ("cell_toml", b"cell = 1", "'cell' is no table"),
        ("cell_toml", b"\xff", "is no text"),
        ("init_packet_bin", bytes(1200), "is no init packet"),
        ("init_packet_bin", b"short", "is no init packet"),
    ],
)
def test_a_cell_is_not_begun_from_what_an_archive_cannot_say(
    tmp_path: Path, name: str, content: bytes, problem: str
) -> None:
    with pytest.raises(ArchiveError, match=problem) as raised:
        from_archive(archive(tmp_path / "a.mcap", **{name: content}), JOINTS)
    assert raised.value.field == ".".join(name.rsplit("_", 1))
    assert raised.value.remedy


@pytest.mark.parametrize(
    ("written", "remedy"),
    [
        (
            'controller = { transport = "simulated", cycle_ms = 2 }',
            r"write \[controller\] in a line of its own",
        ),
        ("", r"controller\.cycle_ms: is missing; add it"),
    ],
)
def test_a_cell_whose_link_cannot_be_changed_says_how_to_write_it(
    tmp_path: Path, written: str, remedy: str
) -> None:
    begin, _, rest = CELL.partition("[controller]")
    path = tmp_path / "cell.toml"
    (tmp_path / "fast.urdf").write_text(CELLS_URDF)
    path.write_text(f"{written}\n{begin}{rest[rest.index('[campaign]') :]}")
    with pytest.raises(InputError, match=remedy):
        Cell.load(path).with_link(transport="udp")


@pytest.mark.parametrize("text", ["a = " + "[" * 9999, f"sample_rate = {'9' * 5000}"])
def test_a_column_map_that_cannot_be_read_is_refused(tmp_path: Path, text: str) -> None:
    (tmp_path / "map.toml").write_text(text)
    with pytest.raises(SourceError, match=r"map\.toml: cannot be read"):
        ColumnMap.load(tmp_path / "map.toml")


def test_times_beyond_all_clocks_are_refused(tmp_path: Path) -> None:
    np.savez(tmp_path / "log.npz", q=np.zeros((3, 2)), t=np.array([0.0, 1.0, 1e308]))
    with pytest.raises(SourceError, match=r"spans 1.00e\+308 s; give the unit"):
        import_log(
            tmp_path / "log.npz", tmp_path / "o.mcap", robot=importers.robot(),
            columns=importers.ARRAYS,
        )  # fmt: skip


def test_a_bag_whose_names_are_no_text_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "bag.db3"
    with closing(sqlite3.connect(path)) as database:
        database.execute("CREATE TABLE topics(id, name, type, serialization_format)")
        database.execute("CREATE TABLE messages(id, topic_id, timestamp, data)")
        database.execute("CREATE TABLE qqqq(id)")
        database.commit()
    # What sqlite says of it quotes the byte as it stands there.
    path.write_bytes(path.read_bytes().replace(b"TABLE qqqq", b"TABL\xfa qqqq"))
    with pytest.raises(SourceError, match=r"bag\.db3: is not a rosbag2"):
        import_rosbag2(path, tmp_path / "o.mcap", robot=importers.robot())


def test_a_signalling_nan_goes_over_can_as_any_other() -> None:
    end = ControllerEnd(BusRates("classic"))
    end.packet(InitPacket.build(1, 2, {}).encode())
    packet = CyclicPacket.zeros(11, 1)
    packet.axes.view(np.int32)[1] = 0x7F800001
    assert len(end.packet(packet.encode())) == 2


def test_a_design_whose_seal_lacks_a_digest_is_refused(tmp_path: Path) -> None:
    whole = documents.design()
    lines = [line for line in whole.splitlines() if not line.startswith("motion_sha256")]
    text = "\n".join(lines) + "\n"
    (tmp_path / "excitation.toml").write_text(documents.sealed(text))
    with pytest.raises(InputError, match=r"is not a designed excitation \('motion_sha256'\)"):
        DesignResult.load(tmp_path / "excitation.toml")


def test_a_design_that_is_nested_without_end_is_refused(tmp_path: Path) -> None:
    (tmp_path / "excitation.toml").write_text("a = " + "[" * 9999)
    with pytest.raises(InputError, match="nested too deep"):
        DesignResult.load(tmp_path / "excitation.toml")


def test_a_rehearsal_that_is_no_text_is_refused(tmp_path: Path) -> None:
    (tmp_path / "rehearsal.json").write_bytes(json.dumps({"a": 1}).encode() + b"\xff")
    with pytest.raises(InputError, match=r"rehearsal\.json cannot be read"):
        Rehearsal.load(CampaignFolder(tmp_path))


def test_numbers_beyond_all_bounds_in_a_design_are_refused() -> None:
    with pytest.raises(ValueError, match="beyond all bounds"):
        from_text("a=1e9999999999999999999")


@pytest.mark.parametrize(
    ("was", "put", "why"),
    [
        ('<axis xyz="0 1 0"/>', '<axis xyz="0 0 0"/>', "without a direction"),
        ("<inertial>", '<inertial :="">', "is no XML"),
    ],
)
def test_a_robot_that_only_some_readers_take_is_refused(was: str, put: str, why: str) -> None:
    text = URDF.replace(was, put)
    assert text != URDF
    with pytest.raises(ModelError, match=why):
        chain_from_urdf(text)


def test_an_archive_in_a_state_that_nobody_knows_is_drawn() -> None:
    assert _state_name(State.OPEN) == "open"
    assert _state_name(105) == "state 105"


@pytest.mark.parametrize("value", [2.2e203, -1e13, np.inf, np.nan])
def test_a_log_with_a_number_that_no_arm_has_is_refused_by_its_place(
    tmp_path: Path, value: float
) -> None:
    position = np.zeros((4, 2))
    position[2, 1] = value
    np.savez(tmp_path / "log.npz", q=position, t=0.002 * np.arange(4.0))
    with pytest.raises(SourceError, match=r"position of joint ankle is \S+ in sample 2"):
        import_log(
            tmp_path / "log.npz", tmp_path / "o.mcap", robot=importers.robot(),
            columns=importers.ARRAYS,
        )  # fmt: skip
    assert not (tmp_path / "o.mcap").exists()


def test_a_signalling_nan_in_a_log_is_refused_as_any_other(tmp_path: Path) -> None:
    position = np.zeros((4, 2), np.float32)
    position.view(np.uint32)[1] = 0x7F800001
    np.savez(tmp_path / "log.npz", q=position, t=0.002 * np.arange(4.0))
    with pytest.raises(SourceError, match="is nan in sample 1"):
        import_log(
            tmp_path / "log.npz", tmp_path / "o.mcap", robot=importers.robot(),
            columns=importers.ARRAYS,
        )  # fmt: skip


@pytest.mark.parametrize(
    "deep", [".".join("a" * 400) + " = 1", "a = " + "{b = [" * 60 + "1" + "]}" * 60]
)
def test_a_cell_file_whose_tables_nest_without_end_is_refused(tmp_path: Path, deep: str) -> None:
    (tmp_path / "cell.toml").write_text(deep)
    with pytest.raises(InputError, match=r"cell\.toml.*nested too deep"):
        Cell.load(tmp_path / "cell.toml")


@pytest.mark.parametrize(
    "figures", [(1e200, (0.0, 0.0, 0.0)), (1.0, (0.0, 1e200, 0.0)), (1.0, (0.0, 0.0, np.nan))]
)
def test_a_payload_that_no_arm_carries_is_refused(
    figures: tuple[float, tuple[float, float, float]],
) -> None:
    with pytest.raises(ModelError, match="the payload"):
        Payload(*figures)
