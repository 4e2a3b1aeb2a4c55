"""Parquet as LeRobot writes it, and joint states in MCAP as JSON or Protobuf."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np
import pyarrow
import pytest
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from mcap.writer import Writer
from pyarrow import parquet

from hil.base.errors import SourceError
from hil.importers.imported_robot import Robot
from hil.importers.recording_import import import_recording
from tests.hil.importers.moving_log import JOINTS, POSITION, TIME, TORQUE, URDF
from tests.near import near

EPOCH = 10**18  # ns


@pytest.fixture
def robot(tmp_path: Path) -> Robot:
    path = tmp_path / "three.urdf"
    path.write_text(URDF)
    return Robot.from_urdf(path)


def read(path: Path, robot: Robot) -> Mapping[str, np.ndarray]:
    imported = import_recording(path, path.with_name("imported.mcap"), lambda _: robot)
    return imported.archive.columns


def lerobot(path: Path, **more: object) -> Path:
    table = {
        "observation.state": list(POSITION.astype(np.float32)),
        "observation.effort": list(TORQUE.astype(np.float32)),
        "action": list(POSITION.astype(np.float32)),
        "timestamp": TIME.astype(np.float32),
        "episode_index": np.zeros(len(TIME), np.int64),
        **more,
    }
    parquet.write_table(pyarrow.table(table), path)
    return path


def test_lists_in_parquet_are_joints(tmp_path: Path, robot: Robot) -> None:
    columns = read(lerobot(tmp_path / "episode.parquet"), robot)
    assert np.allclose(columns["position"], POSITION, rtol=0.0, atol=1e-6)
    assert np.allclose(columns["torque"], TORQUE, rtol=1e-6, atol=1e-6)


def test_numbers_as_text_in_parquet_are_numbers(tmp_path: Path, robot: Robot) -> None:
    table = {"t": TIME, **{f"q{k + 1}": column for k, column in enumerate(POSITION.T)}}
    table["q2"] = [f"{value:.12f}" for value in table["q2"]]
    table |= {f"tau{k + 1}": column for k, column in enumerate(TORQUE.T)}
    parquet.write_table(pyarrow.table(table), tmp_path / "log.parquet")
    assert read(tmp_path / "log.parquet", robot)["position"] == near(POSITION, abs=1e-9)


def test_several_episodes_in_one_file_are_refused(tmp_path: Path, robot: Robot) -> None:
    path = lerobot(tmp_path / "all.parquet", episode_index=np.arange(len(TIME)) // 300)
    with pytest.raises(SourceError, match="episodes, each with a clock that starts at zero"):
        read(path, robot)


def stamps() -> Iterator[tuple[int, int]]:
    return ((row, EPOCH + round(1e9 * time)) for row, time in enumerate(TIME))


def test_names_in_json_put_joints_in_order(tmp_path: Path, robot: Robot) -> None:
    path = tmp_path / "json.mcap"
    order = [2, 0, 1]
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        schema = writer.register_schema("JointState", "jsonschema", b"{}")
        channel = writer.register_channel("/joint_states", "json", schema)
        for row, stamp in stamps():
            message = {
                "header": {"stamp": {"sec": stamp // 10**9, "nsec": stamp % 10**9}},
                "name": [JOINTS[k] for k in order],
                "position": POSITION[row, order].tolist(),
                "effort": TORQUE[row, order].tolist(),
                "velocity": [],
            }
            writer.add_message(channel, 0, json.dumps(message).encode(), 0)
        writer.finish()
    columns = read(path, robot)
    assert np.allclose(columns["position"], POSITION, rtol=0.0, atol=1e-9)
    assert np.allclose(columns["torque"], TORQUE, rtol=0.0, atol=1e-9)
    assert np.ptp(columns["stamp"]) == pytest.approx(1e9 * np.ptp(TIME), abs=2)


def joint_state() -> descriptor_pb2.FileDescriptorProto:
    field = descriptor_pb2.FieldDescriptorProto
    file = descriptor_pb2.FileDescriptorProto(name="state.proto", package="arm", syntax="proto3")
    message = file.message_type.add(name="JointState")
    fields = {"name": field.TYPE_STRING, "position": field.TYPE_DOUBLE, "effort": field.TYPE_DOUBLE}
    for number, (name, kind) in enumerate(fields.items(), 1):
        message.field.add(name=name, number=number, type=kind, label=field.LABEL_REPEATED)
    return file


def test_protobuf_is_decoded_by_its_own_definition(tmp_path: Path, robot: Robot) -> None:
    path = tmp_path / "proto.mcap"
    pool = descriptor_pool.DescriptorPool()
    file = joint_state()
    pool.Add(file)
    kind = message_factory.GetMessageClass(pool.FindMessageTypeByName("arm.JointState"))
    definition = descriptor_pb2.FileDescriptorSet(file=[file]).SerializeToString()
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        schema = writer.register_schema("arm.JointState", "protobuf", definition)
        channel = writer.register_channel("/arm", "protobuf", schema)
        for row, stamp in stamps():
            message = kind(name=JOINTS, position=POSITION[row], effort=TORQUE[row])
            writer.add_message(channel, stamp, message.SerializeToString(), stamp)
        writer.finish()
    columns = read(path, robot)
    assert np.allclose(columns["position"], POSITION, rtol=0.0, atol=1e-9)
    assert np.allclose(columns["torque"], TORQUE, rtol=0.0, atol=1e-9)


def test_a_message_that_is_no_json_is_refused(tmp_path: Path, robot: Robot) -> None:
    path = tmp_path / "json.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        schema = writer.register_schema("JointState", "jsonschema", b"{}")
        channel = writer.register_channel("/joint_states", "json", schema)
        writer.add_message(channel, EPOCH, b"{position", EPOCH)
        writer.finish()
    with pytest.raises(SourceError, match="cannot be decoded"):
        read(path, robot)
