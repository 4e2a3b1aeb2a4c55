"""Pictures of an archive, reduced to minimum and maximum per interval."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from drivers.c4g_packets import DRIVE_ON
from hil.archive import Archive, open_archive
from hil.archive.check import Overview, read_overview
from hil.base.arrays import Array
from hil.base.errors import ArchiveError, HilError, InputError
from hil.base.terminal_text import plural
from hil.cell import AngleFrame, Cell
from hil.plots.plan_picture import wrapped
from hil.report import picture_style as style
from hil.report.chart import thinned
from identification.errors import ModelError
from identification.model.kinematics import chain_from_urdf

_BINS: Final = 4000
"""Intervals of a picture, each with its minimum and maximum."""
_LINE_BREAK_SAMPLES: Final = 10.0  # Missing samples that interrupt a line
_GAP: Final = (np.array([np.nan]), np.array([np.nan]))
_FIELDS: Final = (
    "position", "velocity", "torque", "target_current", "motor_current", "target_position",
    "status", "gap",
)  # fmt: skip
_SECONDS: Final = "time since the first sample [s]"
_COLOURS: Final = {
    "position": style.POSITION,
    "speed": style.VELOCITY,
    "motor current": style.ACCELERATION,
    "torque at the joint": "#5b3a8c",
    "following error": style.INK,
}
_MAX_SHOWN_GAPS: Final = 200


@dataclass(frozen=True, eq=False)
class PlottedTrace:
    """One quantity of one joint."""

    time: Array  #: (k,) s since the first sample of the archive; NaN interrupts the line
    value: Array  #: (k,) in the displayed unit
    limits: tuple[float, ...] = ()  #: lower and upper; empty if unknown

    @property
    def peak_share(self) -> float | None:
        """Largest magnitude over a symmetric limit; None without one."""
        if not self.limits or self.limits[0] != -self.limits[1] or not self.value.size:
            return None
        return float(np.nanmax(np.abs(self.value), initial=0.0) / self.limits[1])


@dataclass(frozen=True, eq=False)
class PlottedQuantity:
    """One quantity of all displayed joints."""

    title: str
    traces: tuple[PlottedTrace, ...]


@dataclass(frozen=True, eq=False)
class ArchiveView:
    """Content of the plot of an archive."""

    facts: Overview  #: content of `hil archive info`
    joint_names: tuple[str, ...]  #: displayed joints
    start: float  #: s since the first sample
    stop: float  #: s since the first sample
    quantities: tuple[PlottedQuantity, ...]  #: those in the archive
    #: (time [s], name, text, whether a warning or worse)
    events: tuple[tuple[float, str, str, bool], ...] = ()
    gaps: Array | None = None  #: times of missed packets [s]; None in an imported recording
    frame: str = ""  #: description of the angle frame

    @property
    def missed(self) -> str:
        """Text on missed packets; "" for imported recordings."""
        if self.gaps is None:
            return ""
        return f"missed at {plural(len(self.gaps), 'place')}" if len(self.gaps) else "none missed"


def view_of(
    path: Path,
    *,
    start: float | None = None,
    stop: float | None = None,
    joints: Sequence[str] = (),
) -> ArchiveView:
    """Read the content of a plot.

    Args:
        path: of the archive.
        start: since the first sample [s].
        stop: likewise.
        joints: names, or numbers from 1; all if empty.

    Raises:
        ArchiveError: the archive cannot be read, or has no sample in that interval.
        InputError: there is no such joint.
    """
    head = open_archive(path, fields=())
    stamp = head.columns["stamp"]
    if not len(stamp):
        raise ArchiveError(path, "contains no sample", remedy="choose another archive")
    origin = float(stamp[0]) * 1e-9
    last = float(stamp[-1] - stamp[0]) * 1e-9
    begin = 0.0 if start is None else max(start, 0.0)
    end = last if stop is None else min(stop, last)
    if not begin <= end:
        problem = f"lasts {last:.6g} s, without a sample in this interval"
        raise ArchiveError(path, problem, remedy="correct --start and --stop")
    shown = _wanted(head.joint_names, joints)
    scales = _Scales.of(head)
    archive = open_archive(path, fields=_FIELDS, start=origin + begin, stop=origin + end + 1e-6)
    columns = archive.columns
    time = archive.columns["stamp"] * 1e-9 - origin
    quantities = []
    # Values that overflow in degrees are missing in the plot.
    with np.errstate(over="ignore", invalid="ignore"):
        for title, values, limits in scales.shown(columns):
            bounds = np.zeros((0, len(head.joint_names))) if limits is None else limits
            traces = (
                PlottedTrace(*_reduced(time, values[:, j]), tuple(bounds[:, j])) for j in shown
            )
            quantities.append(PlottedQuantity(title, tuple(traces)))
    events = [
        (event.time - origin, event.name, event.text, event.level >= 30) for event in head.events
    ]
    return ArchiveView(
        facts=read_overview(path),
        joint_names=tuple(head.joint_names[j] + " [mm]" * bool(scales.slides[j]) for j in shown),
        start=begin,
        stop=end,
        quantities=tuple(quantities),
        events=tuple(event for event in events if begin <= event[0] <= end),
        gaps=time[columns["gap"] > 0] if "gap" in columns else None,
        frame=scales.frame_description,
    )


def _wanted(names: Sequence[str], joints: Sequence[str]) -> list[int]:
    index_of = {str(k + 1): k for k in range(len(names))} | {
        name: k for k, name in enumerate(names)
    }
    for joint in joints:
        if joint not in index_of:
            raise InputError(
                None,
                f"{joint!r} is not a joint",
                field="--joint",
                remedy=f"choose one of {', '.join(names)}",
            )
    return sorted({index_of[joint] for joint in joints}) or list(range(len(names)))


@dataclass(frozen=True, eq=False)
class _Scales:
    """Conversion from SI to displayed units, and limits (2, n) of the cell in the archive."""

    frame: AngleFrame
    slides: NDArray[np.bool_]
    motor_from_joint: Array | None
    limits: Mapping[str, Array]

    @classmethod
    def of(cls, archive: Archive) -> _Scales:
        n = len(archive.joint_names)
        cell = _cell(archive)
        motors = None
        frame = AngleFrame("urdf", np.ones(n), np.zeros(n))
        both = np.array([[-1.0], [1.0]])
        limits: dict[str, Array] = {}
        if cell is not None and cell.file.limits is not None:
            frame = AngleFrame.of(cell)
            bounds = cell.joint_limits
            limits["position"] = np.sort([frame.shown(bounds.lower), frame.shown(bounds.upper)], 0)
            limits["velocity"] = both * np.degrees(bounds.velocity)
            if cell.torque_limit is not None:
                limits["torque"] = both * cell.torque_limit
        if cell is not None and cell.file.drive_train is not None:
            motors = cell.drive_train.motor_from_joint
            limits["current"] = both * cell.drive_train.current_limit
            limits["following"] = both * np.array(cell.drive_table.following_error)
        return cls(frame, _slides(archive, n), motors, limits)

    @property
    def frame_description(self) -> str:
        """Description of the frame."""
        pendant = self.frame.name == "controller"
        whose = "as on the teach pendant" if pendant else "of the URDF"
        return f"angles, speeds and torques {whose}"

    def shown(
        self, columns: Mapping[str, NDArray[Any]]
    ) -> Iterator[tuple[str, Array, Array | None]]:
        """Yield title, values (m, n) in displayed units, and limits (2, n) of each quantity.

        Torque signs follow the angles.
        Following errors are in motor revolutions if the drive train is known.
        """
        limits = self.limits
        position = columns.get("position")
        if position is not None:
            shown = np.where(self.slides, 1e3 * position, self.frame.shown(position))
            yield "position [deg]", shown, limits.get("position")
        if "velocity" in columns:
            yield "speed [deg/s]", self._rate(columns["velocity"]), limits.get("velocity")
        current = columns.get("target_current", columns.get("motor_current"))
        if current is not None:
            yield "motor current [A]", current, limits.get("current")
        if "torque" in columns:
            torque = columns["torque"] * np.where(self.slides, 1.0, self.frame.sign)
            yield "torque at the joint [N·m]", torque, limits.get("torque")
        if "target_position" in columns and position is not None:
            error = columns["target_position"] - position
            unit = "motor rev"
            if self.motor_from_joint is None:
                error = self._rate(error)
                unit = "deg"
            else:
                error = error @ self.motor_from_joint.T / (2.0 * np.pi)
            # The controller reports no target with the drive off.
            driven = columns["status"] == DRIVE_ON
            error = np.where(driven[:, np.newaxis], error, np.nan)
            yield f"following error [{unit}]", error, limits.get("following")

    def _rate(self, rate: Array) -> Array:
        return np.where(self.slides, 1e3 * rate, self.frame.shown_rate(rate))


def _cell(archive: Archive) -> Cell | None:
    """Return the cell in an archive; None if it has none, or an invalid one."""
    try:
        cell = Cell.from_texts(archive.text("cell.toml"), archive.text("robot.urdf"), archive.path)
    except HilError:
        return None
    return cell if cell.joint_names == archive.joint_names else None


def _slides(archive: Archive, n: int) -> NDArray[np.bool_]:
    try:
        chain = chain_from_urdf(archive.text("robot.urdf"))
    except (ArchiveError, ModelError):
        return np.zeros(n, dtype=np.bool_)
    turns = dict(zip(chain.joint_names, chain.revolute, strict=True))
    return np.array([not turns.get(name, True) for name in archive.joint_names])


def _reduced(time: Array, values: Array) -> tuple[Array, Array]:
    """Return minimum and maximum per interval of samples (m,); NaN where nothing was recorded."""
    leap = _LINE_BREAK_SAMPLES * float(np.median(np.diff(time))) if len(time) > 1 else np.inf
    recorded = np.flatnonzero(np.isfinite(values))
    ends = np.flatnonzero((np.diff(recorded) > 1) | (np.diff(time[recorded]) > leap)) + 1
    parts = list[tuple[Array, Array]]()
    for rows in np.split(recorded, ends) if recorded.size else []:
        bins = max(2, round(_BINS * len(rows) / len(values)))
        parts += [_GAP] * bool(parts) + [thinned(time[rows], values[rows], bins)]
    if not parts:
        return np.zeros(0), np.zeros(0)
    reduced_time, reduced = map(np.concatenate, zip(*parts, strict=True))
    return reduced_time, reduced


def _share(recorded: PlottedTrace) -> str:
    share = recorded.peak_share
    return "" if share is None else "< 1" if share < 0.01 else f"{100.0 * share:.0f}"


def draw_archive(view: ArchiveView) -> Figure:
    """Draw a picture with one row per joint and one column per quantity."""
    rows = len(view.joint_names)
    columns = max(1, len(view.quantities))
    facts = view.facts
    width = 0.95 + 3.1 * columns
    height = 1.6 + 1.15 * rows
    marks = [(at, style.LIMIT if warns else style.MUTED) for at, _, _, warns in view.events]
    if view.gaps is not None:
        marks += [(float(gap), style.MUTED) for gap in view.gaps[:_MAX_SHOWN_GAPS]]
    with style.page():
        figure = Figure(figsize=(width, height))
        grid = figure.add_gridspec(
            rows, columns, left=0.95 / width, right=1.0 - 0.1 / width, top=1.0 - 1.1 / height,
            bottom=0.5 / height, hspace=0.26, wspace=0.24,
        )  # fmt: skip
        for k, quantity in enumerate(view.quantities):
            colour = _COLOURS[quantity.title.partition(" [")[0]]
            for j, trace in enumerate(quantity.traces):
                axes = figure.add_subplot(grid[j, k])
                axes.plot(trace.time, trace.value, color=colour, linewidth=1.0)
                _mark(axes, trace.limits, marks)
                axes.set_xlim(view.start, max(view.stop, view.start + 1e-9))
                axes.tick_params(labelbottom=j == rows - 1)
                share = f"{share} % of limit" if (share := _share(trace)) else ""
                # A fixed height: an exponent of the axis would move it.
                axes.set_title(share, loc="right", y=1.0, pad=2.0, fontsize=style.SMALL_FONT_SIZE)
                if j == 0:
                    axes.annotate(
                        quantity.title, (0.0, 1.0), xycoords="axes fraction", xytext=(0.0, 14.0),
                        textcoords="offset points", fontsize=style.FONT_SIZE,
                    )  # fmt: skip
                axes.set_xlabel(_SECONDS if j == rows - 1 else "")
                axes.set_ylabel("" if k else wrapped(view.joint_names[j]))
        simulated = "SIMULATED" if facts.metadata.get("simulated") == "yes" else ""
        packets = view.missed and f"packets: {view.missed}"
        parts = (simulated, view.frame, packets, facts.lost, facts.damage, "red dashes: limits")
        for text, size, at in (
            (f"{facts.path.name} · {facts.title} · {facts.outcome}", style.TITLE_FONT_SIZE, 0.3),
            (" · ".join(filter(None, parts)), style.SMALL_FONT_SIZE, 0.52),
        ):
            figure.text(0.95 / width, 1.0 - at / height, text, fontsize=size)
    return figure


def _mark(axes: Axes, limits: Sequence[float], marks: Sequence[tuple[float, str]]) -> None:
    """Draw dashed lines at limits inside the range of the axis, dotted ones at times [s]."""
    low, high = axes.get_ylim()
    if (least := 1e-3 * max(-low, high, 1e-6)) > high - low:  # noise at standstill is not magnified
        low, high = 0.5 * (low + high - least), 0.5 * (low + high + least)
    for limit in limits:
        if low <= limit <= high:
            axes.axhline(limit, color=style.LIMIT, linewidth=0.9, linestyle=(0, (5, 2)))
    for at, colour in marks:
        axes.axvline(at, color=colour, linewidth=0.8, linestyle=(0, (1, 2)))
    axes.set_ylim(low, high)
    axes.ticklabel_format(axis="y", useOffset=False)
