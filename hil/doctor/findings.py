"""What the checks of a PC find, as values; `messages` words them, with a remedy for each."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum, StrEnum, auto

from drivers.transports.base import CanBus, FreePort


class CheckStatus(StrEnum):
    """Result of a check: works, may cost latency, fails, is not known."""

    OK = "ok"
    WARN = "warn"
    BAD = "bad"
    UNKNOWN = "unknown"


@dataclass(frozen=True)
class Found:
    """What one check found."""


@dataclass(frozen=True)
class ProbeFailed(Found):
    """A measuring process that gave nothing."""

    probe: str  #: "permissions", or the name of a latency


@dataclass(frozen=True)
class Scheduling(Found):
    """The scheduling of a real-time process."""

    given: str  #: by the system; "" for the ordinary one
    limit: int  #: RLIMIT_RTPRIO, negative without one

    @property
    def is_real_time(self) -> bool:
        """Whether it is."""
        return "FIFO" in self.given.upper()


class LockedMemory(Enum):
    """How much of a process's memory the system locks."""

    ALL = auto()
    IN_USE_AT_START = auto()
    NONE = auto()


@dataclass(frozen=True)
class MemoryLock(Found):
    """Whether memory can be locked."""

    extent: LockedMemory
    limit: int  #: RLIMIT_MEMLOCK [bytes], negative without one


@dataclass(frozen=True)
class Governors(Found):
    """Frequency governors of the processors; none without frequency scaling."""

    names: tuple[str, ...]


@dataclass(frozen=True)
class IdleStates(Found):
    """Whether an exchange can exclude the idle states."""

    excluded: bool


@dataclass(frozen=True)
class DiskSilent(Found):
    """A disk that did not respond."""

    folder: str


@dataclass(frozen=True)
class DiskSpace(Found):
    """Free space for archives."""

    folder: str
    free: int  #: bytes
    hours: float  #: of recording


@dataclass(frozen=True)
class DiskRefused(Found):
    """A folder that could not be written to."""

    folder: str
    error: str  #: of the system


@dataclass(frozen=True)
class WriteTimes(Found):
    """Times of one write [s]."""

    middle: float
    longest: float


class CanState(Enum):
    """State of a CAN interface."""

    NOT_EXAMINED = auto()  #: no kernel device
    NO_INTERFACE = auto()
    DOWN = auto()
    VIRTUAL = auto()
    UNSTATED = auto()  #: without a bit rate
    AS_WANTED = auto()
    OTHER_RATES = auto()


@dataclass(frozen=True)
class CanInterface(Found):
    """A CAN interface, with its bit rates [bit/s] where they are known."""

    bus: CanBus
    state: CanState
    rate: int | None = None
    data_rate: int | None = None


@dataclass(frozen=True)
class Port(Found):
    """A port that was bound, or the number of the error; 0 without one."""

    wanted: FreePort
    error: int


class RouteState(Enum):
    """How the controller is reached."""

    UNKNOWN_HOST = auto()
    NO_TOOL = auto()  #: `ip` is not installed
    NONE = auto()
    LOCAL = auto()  #: this PC itself
    GATEWAY = auto()
    NO_CARRIER = auto()
    DIRECT = auto()


@dataclass(frozen=True)
class Route(Found):
    """The route to the controller."""

    host: str
    state: RouteState
    address: str = ""
    device: str = ""
    gateway: str = ""


@dataclass(frozen=True)
class NoLink(Found):
    """There is no cell, or a simulated controller."""


@dataclass(frozen=True)
class UncheckedLink(Found):
    """A link that needs nothing of this PC that could be checked."""

    description: str


@dataclass(frozen=True)
class RtdeReply(Found):
    """What a Universal Robots controller replied."""

    where: str
    version: str
    problem: str = ""  #: why motions need another one, as the driver has it


@dataclass(frozen=True)
class RtdeSilent(Found):
    """A Universal Robots controller that was not reached."""

    where: str
    error: str  #: of the connection
    remedy: str = ""  #: likewise


@dataclass(frozen=True)
class DoctorCheck:
    """The result of one check."""

    status: CheckStatus
    found: Found
