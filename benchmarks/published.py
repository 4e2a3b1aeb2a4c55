"""Published recordings: what they are, how they are imported, and what is predicted of them.

Each file of `benchmarks/recordings` describes one robot: its URDF, its logs, the column map or the
names that the importers need, and which part of its logs predicts which.
"""

from __future__ import annotations

import importlib.metadata
import io
import tempfile
import tomllib
from collections.abc import Mapping
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any, Final, Literal, Self

from pydantic import BaseModel, ConfigDict

from hil.base.toml_text import to_text
from hil.cli import imports

CONFIGURATIONS: Final = Path(__file__).parent / "recordings"
FITTED_SHARE: Final = 0.7
SHORT_SHARE: Final = 0.4
LENGTHS: Final = (10.0, 20.0, 30.0)  # s, of what is fitted in perturbed splits
LEAST_SECONDS: Final = 5.0


class _Table(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class Split(_Table):
    """What is fitted and what is predicted.

    Attributes:
        fitted: name of a log.
        predicted: of another; None where a part of the same log is.
        part: of that log what is fitted: its first or last rows, and the rest predicted, or all of
            it, and predicted as well.
        share: of its rows that are fitted where it is a part.
        seconds: at most so much of what is fitted, from its start; None: all of it.
        every: of all rows every second one (2), or third; 1: all of them.
    """

    fitted: str
    predicted: str | None = None
    part: Literal["first", "last", "all"] = "all"
    share: float = FITTED_SHARE
    seconds: float | None = None
    every: int = 1

    @property
    def in_sample(self) -> bool:
        """Whether the very rows are predicted that were fitted."""
        return self.predicted is None and self.part == "all"

    def __str__(self) -> str:
        shortened = "" if self.seconds is None else f", {self.seconds:g} s"
        thinned = "" if self.every == 1 else f", 1 row in {self.every}"
        return f"{self._parts()}{shortened}{thinned}"

    def _parts(self) -> str:
        if self.predicted is not None:
            return f"{self.fitted} to {self.predicted}"
        if self.part == "all":
            return f"{self.fitted}: in sample"
        other = {"first": "last", "last": "first"}[self.part]
        mine = round(100 * self.share)
        theirs = round(100 * (1.0 - self.share))
        return f"{self.fitted}: {self.part} {mine} % to {other} {theirs} %"


class Source(_Table):
    """Where the recordings of a robot are from.

    Attributes:
        arm: its name, axes, rate and kind of torque.
        repository: of its publishers on GitHub.
        licence: by its SPDX name.
        converted: whether the files are not as published, but tables made from those.
        sha256: digest of each file that is needed, by name; also of a URDF in a package.
    """

    arm: str
    repository: str
    licence: str
    converted: bool = False
    sha256: dict[str, str]


class Published(_Table):
    """One robot and its logs.

    Attributes:
        folder: below that of all recordings; None: as the file of this configuration is named.
        urdf: name of the file, beside the logs or in a package.
        urdf_package: the installed package that has the URDF.
        logs: file of each log, by a short name; those that end in .db3 are bags.
        rated_payload: of the robot [kg].
        splits: what is fitted and predicted.
        map: of the columns, of logs that are no bags.
        joint_names: name in a bag by name in the URDF, where they differ.
        locked: position of joints that were not recorded [rad or m].
        smooth_bandwidth: see `benchmarks.real_data` [Hz].
        source: where the recordings are from.
    """

    folder: str | None = None
    urdf: str
    urdf_package: str | None = None
    logs: dict[str, str]
    rated_payload: float
    splits: tuple[Split, ...]
    map: dict[str, Any] = {}
    joint_names: dict[str, str] = {}
    locked: dict[str, float] = {}
    smooth_bandwidth: float | None = None
    source: Source

    @classmethod
    def named(cls, name: str) -> Self:
        """The configuration of this name.

        Raises:
            SystemExit: there is none.
        """
        if name not in known():
            raise SystemExit(f"nothing is known about {name}; known are {', '.join(known())}")
        text = (CONFIGURATIONS / f"{name}.toml").read_text(encoding="utf-8")
        return cls.model_validate(tomllib.loads(text))

    @property
    def short_splits(self) -> tuple[Split, ...]:
        """The rest of each log predicted from 40 % of it, which hardly excite the arm."""
        return tuple(
            Split(fitted=log, part=part, share=SHORT_SHARE)
            for log in self.logs
            for part in ("first", "last")
        )

    def perturbed_splits(self, seconds: Mapping[str, float]) -> tuple[Split, ...]:
        """Splits beside the configured ones, by the length of each log [s].

        Every other pair of logs that configured splits join, directly or by others; the halves of
        each log; of the first held-out split 10, 20 and 30 s, and one row in two. None fits less
        than `LEAST_SECONDS`.
        """
        joined = {log: {log} for log in self.logs}
        for split in self.splits:
            if split.predicted is not None:
                group = joined[split.fitted] | joined[split.predicted]
                joined |= dict.fromkeys(group, group)
        pairs = [
            Split(fitted=one, predicted=other)
            for one in self.logs
            for other in self.logs
            if one != other and other in joined[one]
        ]
        halves = [
            Split(fitted=log, part=part, share=0.5)
            for log in self.logs
            for part in ("first", "last")
            if 0.5 * seconds[log] >= LEAST_SECONDS
        ]
        held_out = next(split for split in self.splits if not split.in_sample)
        whole = seconds[held_out.fitted] * (1.0 if held_out.predicted else held_out.share)
        changed = [
            held_out.model_copy(update={"seconds": length}) for length in LENGTHS if length < whole
        ]
        changed.append(held_out.model_copy(update={"every": 2}))
        return tuple(each for each in (*pairs, *halves, *changed) if each not in self.splits)

    def urdf_text(self, folder: Path) -> str:
        """The URDF, beside the logs or in an installed package, with the bag's names of joints.

        Raises:
            SystemExit: the package is not installed, or has no such file.
        """
        path = folder / self.urdf
        if self.urdf_package is not None and not path.exists():
            path = self._packaged()
        text = path.read_text(encoding="utf-8")
        for ours, theirs in self.joint_names.items():
            text = text.replace(f'"{ours}"', f'"{theirs}"')
        return text

    def installed_urdf(self) -> Path | None:
        """The URDF in an installed package; None if it has none, or is not installed."""
        try:
            files = importlib.metadata.files(str(self.urdf_package)) or ()
        except importlib.metadata.PackageNotFoundError:
            files = ()
        for file in files:
            if file.name == self.urdf:
                return Path(str(file.locate()))
        return None

    def _packaged(self) -> Path:
        path = self.installed_urdf()
        if path is not None:
            return path
        raise SystemExit(f"{self.urdf} is not in the package {self.urdf_package}; is it installed?")

    def imported(self, log: str, folder: Path, output: Path) -> Path:
        """Import one of the logs in a folder into an archive, by `hil import` and its defaults."""
        source = folder / self.logs[log]
        locked = [f"{name}={position}" for name, position in self.locked.items()]
        with tempfile.TemporaryDirectory() as scratch, redirect_stdout(io.StringIO()):
            urdf = Path(scratch) / self.urdf
            urdf.write_text(self.urdf_text(folder), encoding="utf-8")
            if source.suffix == ".db3":
                imports.rosbag2(source, output, urdf=urdf, locked=locked)
            else:
                columns = Path(scratch) / "map.toml"
                columns.write_text(to_text(self.map), encoding="utf-8")
                imports.log(source, output, columns=columns, urdf=urdf, locked=locked)
        return output


def known() -> list[str]:
    """Names of the configurations."""
    return sorted(path.stem for path in CONFIGURATIONS.glob("*.toml"))
