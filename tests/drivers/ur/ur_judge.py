"""Independent check of a session with a UR controller by its frames, replies and records.

Frames are decoded here by the maker's layout; no code of `drivers.ur` is used.
"""

from __future__ import annotations

import json
import re
import struct
from collections.abc import Mapping
from typing import Any

import numpy as np

from drivers import GuardLimits, MotionEnded
from drivers.cycle_records import CycleRing
from drivers.drive_train import DriveTrain
from drivers.session import Session
from tests.drivers.set_points import SetPointLaws

FORMATS = {"DOUBLE": "d", "INT32": "i", "UINT32": "I", "VECTOR3D": "3d", "VECTOR6D": "6d",
           "VECTOR6INT32": "6i"}  # fmt: skip
STREAM, END, STOP = 1, 2, 3
WAITING, STREAMING, STOPPING = 1, 2, 3
RUNNING, PLAYING, STOPPED, NORMAL = 7, 2, 1, 1
FREEDRIVE = 4
LOSS_WINDOW = 100
"""Cycles in which more than `max_gap` set-points that were not used stop a motion."""
Frame = Mapping[str, np.ndarray]


class Frames:
    """Decodes the frames whose outputs an introduction states."""

    def __init__(self, introduction: bytes) -> None:
        outputs: dict[str, str] = json.loads(introduction)["outputs"]
        codes = {name: FORMATS[kind] for name, kind in outputs.items()}
        self._counts = {name: int(code[:-1] or 1) for name, code in codes.items()}
        self._struct = struct.Struct(">4x" + "".join(codes.values()))
        self.length = self._struct.size

    def decode(self, packet: bytes) -> Frame:
        flat = self._struct.unpack(packet)
        values, at = {}, 0
        for name, count in self._counts.items():
            values[name] = np.array(flat[at : at + count])
            at += count
        return values


class UrConduct(SetPointLaws):
    """Allowed replies to the frames of a controller.

    Args:
        limits: of the guard, following error in motor revolutions and current included.
        train: of the arm.
        period: s, the controller's cycle.
        max_gap: frames that may be missed in a row without a stop.

    Attributes:
        barrier: a motion was refused or lost, and the program has not been seen to have ended.
    """

    def __init__(self, limits: GuardLimits, train: DriveTrain, period: float, max_gap: int) -> None:
        self.limits = limits
        self.guarded = limits
        self.train = train
        self.period = period
        self.max_gap = max_gap
        self.entitled = self.stopping = self.held = self.overridden = False
        self.without_jerk_bound = 0
        self.sent = []
        self.tally = {}
        self.barrier = False
        self.token = -1
        self.number: int | None = None
        self.stamp = 0.0
        self.unused = 0
        self.lost: list[tuple[int, int]] = []

    def judge(self, frame: Frame, reply: bytes, record: np.void) -> None:
        """Check the reply to one new frame."""
        length = int.from_bytes(reply[:2], "big")
        assert (length, reply[2:4]) == (68, b"U\x01"), "no frame of inputs"
        number, demand, *values = struct.unpack(">ii7d", reply[4:length])
        q, check = np.array(values[:6]), values[6]
        assert abs(sum(values[:6]) + number - check) < 1e-9, "its sum is another one"
        self._numbered(number, float(frame["timestamp"][0]))
        if len(reply) > length:
            self._program(frame, reply[length:].decode())
        playing = self._int(frame, "runtime_state") == PLAYING
        ours = playing and self._int(frame, "output_int_register_27") == self.token
        stage = self._int(frame, "output_int_register_25") if ours else 0
        if not ours:
            self.barrier = False
        echo = np.array([frame[f"output_double_register_{24 + k}"][0] for k in range(6)])
        self._count_lost(int(record["cycle"]), self._int(frame, "output_int_register_26"), stage)
        used = echo if stage in (WAITING, STREAMING, STOPPING) else frame["target_q"]
        commanded = record["commanded_position"]
        if not (stage == STREAMING and self._normal(frame)):
            assert np.array_equal(q, used), "another target, and nothing streams"
            assert demand != STREAM or (self.entitled and not self.barrier), "asked to stream"
            known = np.isfinite(commanded)
            assert np.abs(commanded - self.train.joint_sign * q)[known].max(initial=0.0) < 1e-9
            self._over("safe")
        elif demand == STREAM:
            self._stream(frame, q, echo, record)
        else:
            assert demand in (END, STOP), "neither streams nor ends"
            if demand == STOP:
                assert np.isnan(commanded).all(), "a refused set-point was recorded as sent"
                assert np.array_equal(q, echo), "refused, and another target"
                self.barrier = True
            elif self.sent:
                assert np.abs(q - self.sent[-1]).max() < 1e-12, "leaving: not held"
                self._advance(q, 1, 0.0)
            self._count("end" if demand == END else "refused")

    def _count_lost(self, cycle: int, unused: int, stage: int) -> None:
        """More than `max_gap` set-points in `LOSS_WINDOW` that the program did not get are a stop.

        The program counts its cycles without a new one.
        """
        if stage == STREAMING and self.sent:
            self.lost.append((cycle, max(0, unused - self.unused)))
        self.unused = unused
        self.lost = [loss for loss in self.lost if loss[0] > cycle - LOSS_WINDOW]
        self.stopping = self.stopping or sum(count for _, count in self.lost) > self.max_gap

    def _numbered(self, number: int, stamp: float) -> None:
        if self.number is not None:
            steps = round((stamp - self.stamp) / self.period)
            assert number == self.number + max(steps, 1), "another number"
        self.number, self.stamp = number, stamp

    def _program(self, frame: Frame, text: str) -> None:
        assert self.entitled, "a program without a motion requested"
        assert self._normal(frame), "a program to an arm that is not ready"
        assert self._int(frame, "runtime_state") == STOPPED, "a program over another one"
        found = re.search(r"write_output_integer_register\(27, (\d+)\)", text)
        assert found is not None
        assert int(found[1]) != self.token, "the token of an earlier program"
        self.token = int(found[1])
        self.barrier = False
        self._count("program")

    def _normal(self, frame: Frame) -> bool:
        return (self._int(frame, "robot_mode"), self._int(frame, "safety_mode")) == (
            RUNNING, NORMAL,
        )  # fmt: skip

    def _stream(self, frame: Frame, q: np.ndarray, echo: np.ndarray, record: np.void) -> None:
        assert not self.barrier, "set-points although the motion was refused"
        assert not self._int(frame, "robot_status_bits") & FREEDRIVE, "against a person's hand"
        for share in ("speed_scaling", "target_speed_fraction"):
            assert abs(frame[share][0] - 1.0) <= 1e-3, "the arm is slowed down"
        ratio = np.abs(self.train.gear_ratio) / (2.0 * np.pi)
        off = ratio * np.abs(frame["actual_q"] - echo)
        assert (off <= self.guarded.following_error * (1 + 2e-6)).all(), "following error"
        current = np.abs(frame["actual_current"])
        assert (current <= self.guarded.current * (1 + 2e-6)).all(), "current"
        commanded = record["commanded_position"]
        assert np.abs(commanded - q).max() < 1e-12, "sent and recorded differ"
        if not self.sent:
            assert np.array_equal(q, echo), "the first set-point is not the target"
            self.sent = [q, q, q, q]
        elif (missed := int(record["gap"])) > self.max_gap:
            self._resume(q, missed)
        else:
            self.sent.append(q)
        self._within(q)
        del self.sent[:-3]
        self._count("set-point")

    def _resume(self, q: np.ndarray, missed: int) -> None:
        """After a long gap the motion stops from where the program's own steps have led to."""
        self.stopping = True
        step = self.sent[-1] - self.sent[-2]
        ahead = self.sent[-1] + np.arange(missed + 2)[:, np.newaxis] * step
        before = ahead[int(np.abs(q - step - ahead).max(axis=1).argmin())]
        self.sent = [before - 2 * step, before - step, before, q]
        # The steps have no acceleration, so that returning to the path is one without a bound.
        self.without_jerk_bound = min(2 * missed, round(0.03 / self.period)) + 2
        self._count("resumed")

    def _over(self, what: str) -> None:
        """End the interval in which set-points are sent, if there is one."""
        self.sent = []
        self.stopping = self.held = self.overridden = False
        self._count(what)

    @staticmethod
    def _int(frame: Frame, name: str) -> int:
        return int(frame[name][0])


class JudgedUrSession:
    """A session whose frames, replies and records are judged; `broken` has the broken laws."""

    def __init__(self, session: Session, ring: CycleRing, conduct: UrConduct) -> None:
        self._session = session
        self._ring = ring
        self.conduct = conduct
        self.broken: list[str] = []
        self.replies: list[bytes] = []
        self._frames: Frames | None = None
        self._last: tuple[bytes, bytes | None] = (b"", None)
        self._stamp: float | None = None
        self._events: list[Any] = []

    def __getattr__(self, name: str) -> Any:
        return getattr(self._session, name)

    def reply(self, packet: bytes, now: float) -> bytes | None:
        if now >= self._session.deadline:
            self._silent()
        before = self._ring.slot
        reply = self._session.reply(packet, now)
        self.replies.append(reply or b"")
        self._read_events()
        if not self.broken:
            try:
                self._judge(packet, reply, self._ring.slot - before)
            except AssertionError as error:
                self.broken.append(str(error).partition("\n")[0] or "an assertion")
        return reply

    def _judge(self, packet: bytes, reply: bytes | None, rows: int) -> None:
        if packet[:1] == b"{":
            self._frames = Frames(packet)
            assert not reply, "an answer to an introduction"
            return
        if packet[2:3] == b"M":
            assert reply is None, "an answer to a text"
            return
        assert self._frames is not None
        if packet == self._last[0]:
            assert reply == self._last[1] and not rows, "a duplicate answered otherwise"
            return
        if len(packet) != self._frames.length:
            assert reply is None
            return
        frame = self._frames.decode(packet)
        stamp = float(frame["timestamp"][0])
        follows = np.isfinite(stamp)
        if follows and self._stamp is not None:
            steps = (stamp - self._stamp) / self.conduct.period
            follows = steps >= 0.75 and abs(steps - round(steps)) <= 0.25
        if not follows:
            assert reply is None, "an answer to what does not follow"
            return
        self._stamp = stamp
        self._last = packet, reply
        assert reply is not None, "no answer to a frame"
        assert rows != 0, "no record of a frame"
        self.conduct.judge(frame, reply, self._ring.last(1)[0])

    def tick(self, now: float) -> None:
        if now >= self._session.deadline:
            self._silent()
        self._session.tick(now)

    def _silent(self) -> None:
        self._stamp = None  # whichever comes next is new
        self.conduct._over("silence")
        self.conduct.number = None

    def _read_events(self) -> None:
        for event in self._session.events():
            if isinstance(event, MotionEnded):
                self.conduct.entitled = False
                self.conduct.barrier = self.conduct.barrier or event.outcome in ("lost", "refused")
            self._events.append(event)

    def events(self) -> list[Any]:
        self._read_events()
        events, self._events = self._events, []
        return events

    def request(self, source: Any) -> None:
        self._session.request(source)
        self.conduct.entitled = True
        self.conduct.stopping = False

    def stop(self, reason: str) -> None:
        self._session.stop(reason)
        self._read_events()
        self.conduct.stopping = self.conduct.entitled

    def hold(self) -> None:
        self._session.hold()
        self.conduct.held = True

    def resume(self) -> None:
        self._session.resume()
        self.conduct.held = True

    def override(self, fraction: float) -> None:
        self._session.override(fraction)
        self.conduct.overridden = True
