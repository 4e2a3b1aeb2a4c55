"""Foreign recordings: a conforming archive or a `SourceError`, in bounded memory."""

from __future__ import annotations

import io
import sqlite3
from contextlib import closing
from functools import lru_cache, partial
from pathlib import Path

import numpy as np
import zstandard

from hil.archive import open_archive
from hil.archive.check import check_archive
from hil.base.errors import ArchiveWriteError, InputError, SourceError
from hil.importers.column_map import ColumnMap
from hil.importers.imported_robot import Robot
from hil.importers.log import import_log
from hil.importers.rosbag2 import import_rosbag2
from tests.fuzz.draw import mutate_bytes, mutate_text
from tests.fuzz.mutate_mcap import mutate_mcap
from tests.fuzz.targets import Target, place_of
from tests.hil.importers.bags import STATE, STORE, URDF, bag, mcap, states
from tests.hil.importers.bags import many as messages

TEXT, MAP, NPZ, NPY, MATLAB, SQLITE, BAG, MESSAGES, PACKED, FIELDS = range(10)
"""First byte of an input: what the others are a file of."""
SUFFIXES = {
    TEXT: "log.csv", MAP: "map.toml", NPZ: "log.npz", NPY: "log.npy", MATLAB: "log.m",
    SQLITE: "bag.db3", BAG: "bag.mcap", MESSAGES: "log.mcap", PACKED: "bag.db3.zstd",
    FIELDS: "fields.npy",
}  # fmt: skip
COLUMNS = """[position]
columns = ["q1", "q2"]
[torque]
columns = "tau{}"
[time]
column = "t"
"""
LINES = "t,q1,q2,tau1,tau2\n" + "".join(
    f"{0.002 * k:.3f},{0.1 * k},{-0.2 * k},{k}.5,-{k}\n" for k in range(8)
)
FULL_MAP = """joints = ["ankle", "hip"]
[position]
columns = [1, 2]
unit = "deg"
offset = [0.1, 0.2]
scale = -1.0
[motor_current]
columns = ["tau1", "tau2"]
unit = "mA"
[time]
column = 0
unit = "ms"
[drive]
gear_ratio = [100.0, -80.0]
coupling = [[2, 1, 0.5]]
joint_offset = [0.0, 0.1]
torque_constant = [0.1, 0.2]
[format]
missing = "drop"
decimal = "."
"""
ARRAYS = ColumnMap.model_validate({"position": {"columns": "q"}, "time": {"column": "t"}})
ALONE = ColumnMap.model_validate({"position": {"joints_along": "columns"}, "sample_rate": 500.0})
NAMED = ColumnMap.model_validate({"position": {"columns": ["q1", "q2"]}, "time": {"column": "t"}})
TOPICS = ColumnMap.model_validate(
    {
        "position": {"columns": "/joint_states/position"},
        "time": {"column": "/joint_states/stamp", "unit": "ns"},
    }
)


folder = lru_cache(partial(place_of, "log"))


@lru_cache
def robot() -> Robot:
    path = folder() / "two.urdf"
    path.write_text(URDF)
    return Robot.from_urdf(path)


def run(data: bytes) -> bool:
    """Import it if possible; check what was written."""
    kind = data[0] % len(SUFFIXES) if data else TEXT
    source = folder() / SUFFIXES[kind]
    output = folder() / "out.mcap"
    source.write_bytes(data[1:])
    output.unlink(missing_ok=True)
    try:
        _imported(kind, source, output)
    except (SourceError, ArchiveWriteError) as error:
        assert not output.exists(), "an archive is left"
        assert isinstance(error, InputError)
        assert error.path is not None and error.problem, error
        return False
    archive = open_archive(output)
    assert archive.complete
    check = check_archive(output)
    assert check.conforms, check.faults
    assert archive.kind == "imported"
    assert np.isfinite(archive.columns["position"]).all()
    return True


def _imported(kind: int, source: Path, output: Path) -> None:
    if kind in (SQLITE, BAG, PACKED):
        import_rosbag2(source, output, robot=robot())
    elif kind == MAP:
        columns = ColumnMap.load(source)
        log = folder() / "log.csv"
        log.write_text(LINES)
        import_log(log, output, robot=robot(), columns=columns)
    else:
        columns = {
            NPY: ALONE, MESSAGES: TOPICS, NPZ: ARRAYS, MATLAB: ARRAYS, FIELDS: NAMED,
        }.get(kind, _map())  # fmt: skip
        import_log(source, output, robot=robot(), columns=columns)


@lru_cache
def _map() -> ColumnMap:
    path = folder() / "fixed.toml"
    path.write_text(COLUMNS)
    return ColumnMap.load(path)


def seeds() -> list[bytes]:
    """Return one valid input of each kind."""
    q = np.arange(16.0).reshape(8, 2)
    t = np.arange(8) * 0.002
    arrays, packed, array, typed = (io.BytesIO() for _ in range(4))
    np.savez(arrays, q=q, t=t)
    np.savez_compressed(packed, q=q, t=t)
    np.save(array, q)
    rows = np.zeros(8, [("q1", "<f8"), ("q2", "<f4"), ("at", "<M8[ns]"), ("t", "<f8")])
    rows["t"] = t
    np.save(typed, rows)
    matlab = (
        "q = [" + "; ".join(f"{a} {b}" for a, b in q) + "];\nt = [0 .02 .04 .06 .08 .1 .12 .14]';\n"
    )
    database = bag(folder() / "seed.db3", {"/joint_states": (STATE, states())})
    with closing(sqlite3.connect(database)) as connection:
        connection.execute("PRAGMA page_size = 512")
        connection.execute("VACUUM")
    sqlite = database.read_bytes()
    database.unlink()
    definition, _ = STORE.generate_msgdef(STATE, ros_version=2)
    topics = {"/joint_states": (STATE, definition, "cdr", messages()[:12])}
    foreign = mcap(folder() / "seed.mcap", topics).read_bytes()
    (folder() / "seed.mcap").unlink()
    made = {
        TEXT: (LINES.encode(), LINES.replace(",", "\t").encode()),
        MAP: (COLUMNS.encode(), FULL_MAP.encode()), NPZ: (arrays.getvalue(), packed.getvalue()),
        NPY: (array.getvalue(),), FIELDS: (typed.getvalue(),),
        MATLAB: (matlab.encode(),), SQLITE: (sqlite,),
        BAG: (foreign,), MESSAGES: (foreign,), PACKED: (zstandard.compress(sqlite),),
    }  # fmt: skip
    return [bytes((kind,)) + data for kind, files in made.items() for data in files]


def mutate(data: bytes, most: int, seed: int) -> bytes:
    """Change text or bytes, by the kind of file."""
    kind = data[0] % len(SUFFIXES) if data else TEXT
    if kind in (TEXT, MAP, MATLAB):
        change = mutate_text
    else:
        change = mutate_mcap if kind in (BAG, MESSAGES) else mutate_bytes
    return bytes((kind,)) + change(data[1:], most - 1, seed)


TARGET = Target(run, seeds, mutate, most=20_000, replayed=80)
