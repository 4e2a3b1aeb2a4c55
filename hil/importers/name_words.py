"""The meaning of words in a channel's name, if no table has the whole name.

Loggers put the name of a robot, of a message or of a side before the quantity, and ``measured`` or
the joint behind it: ``fr3_q1``, ``actuators[0].position``, ``MeasuredJointPosition_2``.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Final

from hil.importers.units import Kind

_WORD: Final = re.compile(r"[A-Z]+(?=[A-Z][a-z])|[A-Z]?[a-zäöü]+|[A-Z]+")
_COMPOUND: Final = re.compile(r"^(ist|soll)((?:position|winkel|\w*moment|strom|wert)\w*)$")
_MEASURED: Final = frozenset({"actual", "act", "measured", "meas", "msr", "ist"})
_QUANTITIES: Final[Mapping[Kind, frozenset[str]]] = {
    "time": frozenset({"t", "time", "times", "timestamp", "timestamps", "stamp", "zeit"}),
    "position": frozenset(
        {"q", "pos", "position", "positions", "angle", "angles", "theta", "winkel"}
    ),
    "velocity": frozenset(
        {"qd", "dq", "qdot", "vel", "velo", "velocity", "velocities", "speed", "speeds", "omega"}
    ),
    "torque": frozenset(
        {"tau", "moment", "torque", "torques", "effort", "efforts", "eff", "trq", "torq"}
        | {"drehmoment"}
    ),
    "motor_current": frozenset({"current", "currents", "cur", "curr", "amp", "strom"}),
}
_ALONE: Final = frozenset(
    {"sec", "secs", "second", "seconds", "ms", "msec", "msecs", "millis", "milliseconds"}
    | {"us", "usec", "usecs", "micros", "microseconds", "ns", "nano", "nanosec", "nanosecs"}
    | {"nsec", "nsecs", "nanoseconds", "elapsed", "uhrzeit"}
)
"""Words that say a time where a name has no others: ``velocity_per_sec`` is none."""
_COMMANDED: Final = frozenset(
    {"target", "targets", "cmd", "cmds", "command", "commands", "commanded", "desired", "des"}
    | {"setpoint", "setpoints", "ref", "reference", "goal", "goals", "soll", "action", "actions"}
)
_WANTED: Final = """
d planned plan model feedforward ff error err delta predicted estimated est nominal"""
_OUTSIDE: Final = """
ext external hat residual contact tcp ee eef tool flange cart cartesian pose gripper finger hand
wheel battery supply bus"""
_PART: Final = """
motor motors rotor gravity friction coriolis inertia ddq qdd acc acceleration dtau temp temperature
limit limits max min offset std var"""
_OTHER: Final = _COMMANDED.union(f"{_WANTED} {_OUTSIDE} {_PART}".split())
"""Words of channels that are not the measured quantity of a joint."""
_ALLOWED: Final[Mapping[Kind, frozenset[str]]] = {
    "motor_current": frozenset({"motor", "motors"}),
    "torque": frozenset({"estimated", "est"}),
}
"""Those of them that a quantity may have."""


_PLACES: Final = """
joint axis axes arm link left right raw filtered filt value signal channel motor output input side
index id nr no number utc local gmt cet cest date iso x y z base world abs rel total mean avg
robot"""
_QUALIFIERS: Final = frozenset(
    {*_MEASURED, *_OTHER, *_PLACES.split()}.union(*_QUANTITIES.values()) - {"m", "t"}
)
"""Words in brackets behind a name that are no unit."""


def words_of(name: str) -> list[str]:
    """Return the words of a name in lower case, split at marks, digits and capitals.

    ``axisQMsr`` has the words axis, q and msr.
    """
    split = re.sub(r"(?<=[a-z])([A-Z])(?=[A-Z][a-z])", r" \1 ", name)
    words = [word.lower() for word in _WORD.findall(split)]
    return [part for word in words for part in _COMPOUND.sub(r"\1 \2", word).split()]


def is_other(name: str, kind: Kind) -> bool:
    """Return whether a word says that a channel is not the measured quantity of a joint.

    A current may be called that of a motor: no other is measured. A torque may be called an
    estimate: drives without a torque sensor name so what they conclude from the current.
    """
    return not (_OTHER - _ALLOWED.get(kind, frozenset())).isdisjoint(words_of(name))


def is_qualifier(text: str) -> bool:
    """Return whether a text in brackets says which of several channels it is, and no unit."""
    return not _QUALIFIERS.isdisjoint(words_of(text))


def is_measured(name: str) -> bool:
    """Return whether a word says that a channel was measured, not wanted or computed."""
    return not _MEASURED.isdisjoint(words_of(name))


def kinds_said(name: str) -> list[Kind]:
    """Return the quantities of the words of a name, whatever denies them."""
    words = set(words_of(name))
    kinds = [kind for kind, names in _QUANTITIES.items() if names & words]
    if len(kinds) > 1 and "time" in kinds and "t" in words:
        kinds.remove("time")  # the t of an axis or a tool
    return kinds


def is_commanded_position(name: str) -> bool:
    """Return whether a name says a command, and of no other quantity than positions."""
    words = set(words_of(name))
    denied = not (_OTHER - _COMMANDED).isdisjoint(words)
    return not _COMMANDED.isdisjoint(words) and not denied and set(kinds_said(name)) <= {"position"}


def kind_by_words(name: str) -> Kind | None:
    """Return the only quantity that the words of a name say; None if another word denies it."""
    kinds = kinds_said(name.rpartition(".")[2])  # positions.timestamps
    if len(kinds) != 1:
        kinds = kinds_said(name)
    words = set(words_of(name))
    if words and words <= _ALONE:
        return "time"
    return kinds[0] if len(kinds) == 1 and not is_other(name, kinds[0]) else None
