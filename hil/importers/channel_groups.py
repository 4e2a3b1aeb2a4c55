"""Channels of a log that differ by the number or the name of a joint only, as one group."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Final

from hil.base.arrays import Array
from hil.importers.array_files import ArrayFile
from hil.importers.channels import DRIVE_OBJECT, Channel, kind_of
from hil.importers.conclusions import NameBasis
from hil.importers.name_words import is_commanded_position, kind_by_words
from hil.importers.stated_units import without_unit
from hil.importers.text_table import TextTable
from hil.importers.units import Kind

_NUMBER: Final = re.compile(r"\d{1,2}(?=\D*$)")
_WORD_JOINT: Final = re.compile(r"^joint_(?=\D)|(?<=\D)_joint$")
_MIN_SHORT_NAME: Final = 3  # of a joint that is not written as in the URDF
_REPEATED_MARK: Final = re.compile(r"([_.-])\1+")  # around the name of a joint


@dataclass(frozen=True)
class ChannelGroup:
    """Channels that differ by the number or the name of a joint only.

    Attributes:
        pattern: their name, with ``{}`` in place of number or joint.
        kind: the quantity, None if neither name nor unit says it.
        names: in the order of the joints, without units.
        size: numbers in a sample.
        unit: that the log states for the first, None without one.
        by_joint: whether the names are of joints of the URDF.
        by_words: how words in names say the quantity; None where a whole name does.
    """

    pattern: str
    kind: Kind | None
    names: tuple[str, ...]
    size: int
    unit: str | None
    by_joint: bool = False
    by_words: NameBasis | None = None

    @property
    def label(self) -> str:
        """First and last name."""
        first = self.names[0]
        last = self.names[-1]
        return first if first == last else f"{first} .. {last}"

    def joints(self, joints: Sequence[str]) -> tuple[str, ...]:
        """Return the joints of the URDF to which the names belong."""
        if not self.by_joint:
            return ()
        named = {_joint_in(name, joints) for name in self.names}
        return tuple(joint for joint in joints if any(each and each[0] == joint for each in named))

    def numbers(self, file: TextTable | ArrayFile) -> Array:
        """Return the numbers of the channels (m, n), not converted.

        Raises:
            SourceError: a cell is not a number.
        """
        if isinstance(file, ArrayFile) and len(self.names) == 1:
            return file.matrix(self.names[0], "position")
        return file.numbers(self.names, "position", None)

    def columns(self, joints: Sequence[str]) -> str | list[str]:
        """Return `columns` of the map: the pattern where it gives these names, else the list."""
        numbers = range(len(joints) + 1)
        series = ([str(k) for k in numbers[1:]], [str(k) for k in numbers[:-1]], joints)
        if self.size == 1 or self.pattern == self.names[0]:
            return self.names[0]
        for parts in series:
            if self.names == tuple(self.pattern.replace("{}", part) for part in parts):
                return self.pattern
        return list(self.names)


def grouped(channels: Iterable[Channel], joints: Sequence[str]) -> list[ChannelGroup]:
    """Group channels by their name without number or joint, in the order of the log."""
    channels = list(channels)
    bare_names = [without_unit(channel.name)[0].strip() or channel.name for channel in channels]
    repeated = {name for name, times in Counter(bare_names).items() if times > 1}
    members: dict[tuple[str, Kind | None, bool], list[tuple[int, str, Channel]]] = {}
    for channel, bare in zip(channels, bare_names, strict=True):
        end = channel.name.strip()[len(bare) :] if bare in repeated else ""
        kind = channel.kind
        pattern = bare
        index = 0
        by_joint = False
        match = number_in(bare)
        if match is not None:
            pattern = f"{bare[: match.start()]}{{}}{bare[match.end() :]}"
            index = int(match[0])
        found = _joint_in(bare, joints)
        if found is not None:
            joint, written = found
            quantity = _REPEATED_MARK.sub(r"\1", bare.replace(written, "")).strip(" _.-/")
            of_joint = kind_of(quantity, channel.unit)[0] or kind_by_words(quantity)
            is_of_kind = of_joint is not None and (kind in (None, of_joint) or "/" in bare)
            if is_of_kind or (kind is None and is_commanded_position(quantity)):
                kind = of_joint
                by_joint = True
                pattern = bare.replace(written, "{}")
                index = list(joints).index(joint)
        entry = (index, bare + end, channel)
        members.setdefault((pattern + end, kind, by_joint), []).append(entry)
    groups = []
    for (pattern, kind, by_joint), entries in members.items():
        entries.sort(key=lambda entry: entry[0])
        names = tuple(name for _, name, _ in entries)
        size = sum(channel.size for _, _, channel in entries)
        unit = entries[0][2].unit
        whole = names[0] if len(names) == 1 else pattern
        groups.append(ChannelGroup(whole, kind, names, size, unit, by_joint))
    return groups


def number_in(name: str) -> re.Match[str] | None:
    """Return where the joint's number is in a name, None if it has none."""
    return _NUMBER.search(DRIVE_OBJECT.sub(lambda index: "_" * len(index[0]), name))


def _joint_in(name: str, joints: Sequence[str]) -> tuple[str, str] | None:
    """Return the joint with the longest name in a channel's name, and how it is written; or None.

    Without its exact name, whole words are one in other letters or marks, or without the word
    joint: ``Hip angle`` is of ``hip``, ``shoulder_pan_pos`` of ``shoulder_pan_joint``.
    """
    exact = max((joint for joint in joints if joint in name), key=len, default=None)
    if exact is not None:
        return exact, exact
    folded = _folded(name)
    best = None
    for joint in joints:
        for short in dict.fromkeys((_folded(joint), _WORD_JOINT.sub("", _folded(joint)))):
            match = re.search(rf"(?<![a-z0-9]){re.escape(short)}(?![a-z0-9])", folded)
            is_longer = best is None or len(short) > len(best[1])
            if match is not None and len(short) >= _MIN_SHORT_NAME and is_longer:
                best = joint, name[match.start() : match.end()]
    return best


def _folded(name: str) -> str:
    """Return a name in lower case with underscores for marks, of the same length."""
    return re.sub(r"[\s.-]", "_", name.lower())
