"""Defects found by fuzzing, each by the shortest realistic file."""

from __future__ import annotations

import sqlite3
from collections.abc import Callable
from contextlib import closing
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from drivers import CyclicPacket
from drivers.transports.can.frames import DOWN, UP, BusRates, CanEndpoint
from hil.archive import ImportedSamples, write_samples
from hil.base.errors import ArchiveError, InputError, SourceError
from hil.base.toml_text import from_text
from hil.campaign.folder import CampaignFolder
from hil.campaign.rehearsal_record import Rehearsal
from hil.cell import Cell
from hil.design.result import DesignResult
from hil.importers.column_map import ColumnMap
from hil.importers.log import import_log
from hil.importers.rosbag2 import import_rosbag2
from hil.new import from_archive
from hil.plots.archive_view import view_of
from identification.errors import ModelError
from identification.model.kinematics import chain_from_urdf
from identification.model.known_payload import Payload
from tests.fault_matrix.small_cell import URDF
from tests.fuzz.targets import documents, importers
from tests.hil.fast_cell import CELL
from tests.hil.fast_cell import URDF as CELLS_URDF

pytestmark = pytest.mark.long

JOINTS = ("shoulder", "elbow")


def archive(path: Path, samples: ImportedSamples | None = None, /, **attachments: bytes) -> Path:
    """Three samples of two joints, with attachments (`_` stands for the dot of their names)."""
    still = ImportedSamples(
        np.arange(3) * 2_000_000, position=np.zeros((3, 2)), torque=np.ones((3, 2))
    )
    files = {".".join(name.rsplit("_", 1)): data for name, data in attachments.items()}
    return write_samples(
        path, samples or still, joint_names=JOINTS, metadata={}, attachments=files, durable=False
    )


def test_jump_of_the_clock_by_years_is_fast(tmp_path: Path) -> None:
    far = ImportedSamples(np.array([0, 2**60]), position=np.ones((2, 2)), torque=np.ones((2, 2)))
    view = view_of(archive(tmp_path / "imported.mcap", far))
    assert view.stop == pytest.approx(2**60 * 1e-9)
    assert np.count_nonzero(np.isfinite(view.quantities[0].traces[0].value)) == 2


def test_position_too_large_for_degrees_is_not_shown(tmp_path: Path) -> None:
    position = np.array([[0.1, 0.2], [1e307, -1e307], [0.3, 0.4]])
    large = ImportedSamples(np.arange(3) * 2_000_000, position=position, torque=np.ones((3, 2)))
    view = view_of(archive(tmp_path / "imported.mcap", large))
    (shown,) = (quantity for quantity in view.quantities if quantity.title == "position [deg]")
    assert np.nanmax(np.abs(shown.traces[0].value)) == pytest.approx(np.degrees(0.3))


@pytest.mark.parametrize(
    ("name", "content", "problem"),
    [
        ("cell_toml", b"[cell", "is not TOML"),
        ("cell_toml", b"a = " + b"[" * 9999, "is not TOML"),
        ("cell_toml", b"cell = 1", "'cell' is not a table"),
        ("cell_toml", b"\xff", "is not UTF-8 text"),
        ("init_packet_bin", bytes(1200), "is not an init packet"),
        ("init_packet_bin", b"short", "is not an init packet"),
    ],
)
def test_cell_from_an_invalid_archive_is_refused(
    tmp_path: Path, name: str, content: bytes, problem: str
) -> None:
    with pytest.raises(ArchiveError, match=problem) as raised:
        from_archive(archive(tmp_path / "a.mcap", **{name: content}), JOINTS)
    assert raised.value.field == ".".join(name.rsplit("_", 1))
    assert raised.value.remedy


def with_controller(folder: Path, written: str) -> Cell:
    begin, _, tail = CELL.partition("[controller]")
    path = folder / "cell.toml"
    (folder / "fast.urdf").write_text(CELLS_URDF)
    path.write_text(f"{written}\n{begin}{tail[tail.index('[campaign]') :]}")
    return Cell.load(path)


def test_cell_without_the_cycle_of_its_link_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"controller\.cycle_ms: is missing; add it"):
        with_controller(tmp_path, "").with_link(transport="udp")


def test_cell_whose_link_is_an_inline_table_is_changed(tmp_path: Path) -> None:
    cell = with_controller(tmp_path, 'controller = { transport = "simulated", cycle_ms = 2 }')
    changed = cell.with_link(transport="udp", host="127.0.0.1", port=4000)
    assert (changed.controller.transport, changed.controller.cycle_ms) == ("udp", 2)


def log(path: Path, value: float = 0.0, kind: str = "f8", last: float = 6e-3) -> None:
    """Import a log with this position in its third row; check that no archive is left."""
    position = np.zeros((4, 2), kind)
    time = np.array([0.0, 2e-3, 4e-3, last])
    position[2, 1] = value
    np.savez(path.with_name("log.npz"), q=position, t=time)
    output = path.with_name("o.mcap")
    try:
        import_log(
            path.with_name("log.npz"), output, robot=importers.robot(), columns=importers.ARRAYS
        )
    finally:
        assert not output.exists()


def bag_whose_names_are_no_text(path: Path) -> None:
    """The message of sqlite quotes the invalid byte."""
    with closing(sqlite3.connect(path)) as database:
        database.execute("CREATE TABLE topics(id, name, type, serialization_format)")
        database.execute("CREATE TABLE messages(id, topic_id, timestamp, data)")
        database.execute("CREATE TABLE qqqq(id)")
        database.commit()
    path.write_bytes(path.read_bytes().replace(b"TABLE qqqq", b"TABL\xfa qqqq"))
    import_rosbag2(path, path.with_name("o.mcap"), robot=importers.robot())


def design_without_positions(path: Path) -> None:
    text = documents.design().replace("positions_deg", "places_deg")
    path.write_text(documents.sealed(text))
    DesignResult.load(path)


def of_text(read: Callable[[Path], object], text: str | bytes) -> Callable[[Path], object]:
    def made(path: Path) -> None:
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
        read(path)

    return made


def of_robot(was: str, put: str) -> Callable[[Path], object]:
    assert was in URDF
    return lambda _: chain_from_urdf(URDF.replace(was, put))


SIGNALLING = np.array([0x7F800001], np.uint32).view(np.float32)[0]
NESTED = "a = " + "[" * 9999
NO_NUMBER = r"position of joint ankle is \S+ in sample 2"
REFUSED: list[tuple[str, Callable[[Path], object], type[Exception], str]] = [
    ("map.toml", of_text(ColumnMap.load, NESTED), SourceError, r"map\.toml: cannot be read"),
    ("map.toml", of_text(ColumnMap.load, f"sample_rate = {'9' * 5000}"), SourceError,
     r"map\.toml: cannot be read"),
    ("log", partial(log, last=1e308), SourceError, r"spans 1.00e\+308 s; give the unit"),
    *(("log", partial(log, value=value), SourceError, NO_NUMBER)
      for value in (2.2e203, -1e13, np.inf, np.nan)),
    ("log", partial(log, value=SIGNALLING, kind="f4"), SourceError, NO_NUMBER),
    ("bag.db3", bag_whose_names_are_no_text, SourceError, r"bag\.db3: is not a rosbag2"),
    ("excitation.toml", design_without_positions, InputError,
     r"is not a designed excitation \('positions'\)"),
    ("excitation.toml", of_text(DesignResult.load, NESTED), InputError, "nested too deep"),
    ("plan.toml", lambda _: from_text("a=1e9999999999999999999"), ValueError, "out of range"),
    ("rehearsal.json",
     of_text(lambda path: Rehearsal.load(CampaignFolder(path.parent)), b'{"a": 1}\xff'),
     InputError, r"rehearsal\.json cannot be read"),
    ("robot", of_robot('<axis xyz="0 1 0"/>', '<axis xyz="0 0 0"/>'), ModelError,
     "of length zero"),
    ("robot", of_robot("<inertial>", '<inertial :="">'), ModelError, "is not XML"),
    *(("cell.toml", of_text(Cell.load, deep), InputError, r"cell\.toml.*nested too deep")
      for deep in (".".join("a" * 400) + " = 1", "a = " + "{b = [" * 60 + "1" + "]}" * 60)),
    *(("payload", lambda _, figures=figures: Payload(*figures), ModelError, "the payload")
      for figures in ((1e200, (0.0,) * 3), (1.0, (0.0, 1e200, 0.0)), (1.0, (0.0, 0.0, np.nan)))),
]  # fmt: skip


@pytest.mark.parametrize(("name", "read", "error", "why"), REFUSED)
def test_number_out_of_range_is_refused(
    name: str, read: Callable[[Path], object], error: type[Exception], why: str, tmp_path: Path
) -> None:
    with pytest.raises(error, match=why):
        read(tmp_path / name)


def test_signalling_nan_is_sent_over_can() -> None:
    """To the bit, as any other word."""
    sender = CanEndpoint(BusRates(), UP)
    receiver = CanEndpoint(BusRates(), DOWN)
    packet = CyclicPacket.zeros(11, 1)
    packet.axes.view(np.int32)[1] = 0x7F800001
    sent = packet.encode()
    assert [receiver.receive(frame, 0.0) for frame in sender.frames(sent)] == [sent]
