"""What happened on a link, in one line for a person, and how serious it is."""

from __future__ import annotations

from drivers.events import (
    AnswersLost,
    GapSeen,
    HoldChanged,
    InitReceived,
    LinkLost,
    MotionEnded,
    MotionStarted,
    OverrideChanged,
    PacketRejected,
    Refused,
    StateChanged,
)
from drivers.exchange import (
    EventsLost,
    ExchangeEnded,
    ExchangeEvent,
    ExchangeFailed,
    ExchangeStarted,
    HoldRefused,
    Leaving,
    OverrideRefused,
    ResumeRefused,
)
from hil.archive.events import Level
from hil.plural import counted


def describe(event: ExchangeEvent) -> str:
    """One line for a person."""
    match event:
        case StateChanged():
            return f"{event.before.name} -> {event.after.name} in cycle {event.cycle}"
        case GapSeen():
            return f"{counted(event.missed, 'packet')} missed before cycle {event.cycle}"
        case AnswersLost():
            were = f"{counted(event.count, 'answer')} {'was' if event.count == 1 else 'were'}"
            return f"{were} not taken by the controller, until cycle {event.cycle}"
        case MotionStarted():
            return f"first set-point in cycle {event.cycle}"
        case OverrideChanged():
            return f"override {100.0 * event.fraction:.4g} % in cycle {event.cycle}"
        case HoldChanged():
            return f"{'held' if event.held else 'gone on with'} in cycle {event.cycle}"
        case MotionEnded():
            return f"{event.outcome} in cycle {event.cycle}: {event.reason}"
        case PacketRejected(kind="answered late"):
            return f"{counted(event.count, 'answer')} left more than a cycle after their packet"
        case PacketRejected():
            why = f" ({event.why})" if event.why else ""
            return f"{counted(event.count, f'{event.kind} packet')} got no answer{why}"
        case Refused():
            return f"{event.error}; {event.error.remedy}"
        case LinkLost(stale=stale) if stale:
            packets = f"{counted(stale, 'packet')} that cannot follow the last one"
            return f"only {packets} for {event.silence:.3f} s in state {event.state.name}"
        case LinkLost():
            return f"nothing heard for {event.silence:.3f} s in state {event.state.name}"
        case InitReceived():
            return event.unusable or "; ".join(
                ["the controller started a session", *event.differences]
            )
        case Leaving():
            return f"the exchange comes to its end: {event.reason}"
        case ExchangeEnded():
            return f"the exchange ended: {event.reason}"
        case ExchangeFailed():
            return f"the exchange failed: {event.trace.strip().splitlines()[-1]}"
        case ExchangeStarted():
            return "; ".join(["the exchange is running", *event.realtime.refused, *event.notes])
        case OverrideRefused():
            return f"no override of {event.fraction:g}: {event.reason}"
        case HoldRefused():
            return f"nothing is held: {event.reason}"
        case ResumeRefused():
            return f"the motion cannot be gone on with: {event.reason}"
        case EventsLost():
            return f"{event.count} events were overwritten before they could be archived"


def level_of(event: ExchangeEvent) -> Level:
    """How serious an event is."""
    if isinstance(event, Refused | LinkLost | ExchangeFailed | EventsLost):
        return Level.ERROR
    if isinstance(
        event,
        GapSeen | AnswersLost | PacketRejected | OverrideRefused | ResumeRefused | HoldRefused,
    ):
        return Level.WARN
    return Level.INFO
