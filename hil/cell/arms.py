"""Arms of a robot description: chains of joints between two links."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path
from typing import Final

from pydantic import BaseModel, ConfigDict

from hil.base.errors import InputError
from hil.base.terminal_text import typed
from hil.cell.gripper_names import links_of

LINKS_REMEDY: Final = "give links of the URDF, the tip farther from the root than the base"
MAX_NAMES: Final = 12
_MIN_ARM_JOINTS: Final = 3
"""Joints of an arm: with fewer it is the head, the lift or the wheels of a robot."""
_SIDES: Final = {"left": "left", "l": "left", "right": "right", "r": "right"}
_NUMBER_OR_MARK: Final = re.compile(r"[^a-z]+")


class Links(BaseModel):
    """The links between which an arm lies, an end that is None open; ``[arm]`` of a map.

    Attributes:
        base: link from which the arm starts; None for the root.
        tip: last link of the arm; None for every end.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    base: str | None = None
    tip: str | None = None

    def __bool__(self) -> bool:
        return self.base is not None or self.tip is not None

    def __str__(self) -> str:
        return f"{self.base or 'the root'} and {self.tip or 'every end'}"

    @property
    def options(self) -> str:
        """The options that name them."""
        named = {"--base": self.base, "--tip": self.tip}
        return " ".join(f"{option} {typed(link)}" for option, link in named.items() if link)


@dataclass(frozen=True)
class Arm:
    """A chain of joints, from the base outwards."""

    links: Links
    joints: tuple[str, ...]

    def __str__(self) -> str:
        first = self.joints[0]
        last = self.joints[-1]
        return first if first == last else f"{first} .. {last}"


def joints_between(path: Path | None, text: str, links: Links) -> list[str]:
    """Return the joints of a URDF on the way from a link to another, either end open.

    Raises:
        InputError: there is no such link, or the tip does not hang on the base.
    """
    to_link = {child: (name, parent) for name, (parent, child) in links_of(text).items()}
    names = sorted({*to_link, *(parent for _, parent in to_link.values())})
    for option, link in (("--base", links.base), ("--tip", links.tip)):
        if link is not None and link not in names:
            matches = get_close_matches(link, names, n=3)
            heading = "the nearest are" if matches else "its links are"
            remedy = f"{heading} {', '.join((matches or names)[:MAX_NAMES])}"
            raise InputError(path, f"has no link {link!r}", field=option, remedy=remedy)
    ends = [links.tip] if links.tip is not None else list(to_link)
    joints: dict[str, None] = {}
    for end in ends:
        way = list[str]()
        link = end
        while link != links.base and link in to_link:
            name, link = to_link[link]
            way.append(name)
        if links.base is None or link == links.base:
            joints |= dict.fromkeys(way)
        elif links.tip is not None:
            problem = f"link {links.tip!r} is not a descendant of link {links.base!r}"
            raise InputError(path, problem, field="--tip", remedy=LINKS_REMEDY)
    return list(joints)


def joints_outside(
    path: Path | None, text: str, links: Links, joint_names: Sequence[str]
) -> list[str]:
    """Return the moving joints that do not lie between the links.

    Args:
        path: of the file, for errors.
        text: of the URDF.
        links: between which an arm lies.
        joint_names: moving joints.

    Raises:
        InputError: no other is left, or as of :func:`joints_between`.
    """
    between = set(joints_between(path, text, links))
    outside = [name for name in joint_names if name not in between]
    if len(outside) == len(joint_names):
        problem = f"no joint moves between {links}"
        raise InputError(path, problem, field="--base, --tip", remedy=LINKS_REMEDY)
    return outside


def arms_of(text: str, joint_names: Sequence[str]) -> list[Arm]:
    """Return the chains of moving joints that may be an arm of a URDF.

    A chain starts at the root or where the joints branch, and ends before the next branches or
    where none follows: of a torso with two arms both arms, with and without the torso.
    """
    links = links_of(text)
    parents = dict(_parents(links, joint_names))
    children: dict[str | None, list[str]] = {}
    for name, parent in parents.items():
        children.setdefault(parent, []).append(name)
    arms = []
    for last in joint_names:
        if len(children.get(last, ())) == 1:
            continue
        chain = [last]
        while True:
            parent = parents[chain[-1]]
            if (parent is None or len(children[parent]) > 1) and len(chain) >= _MIN_ARM_JOINTS:
                ends = Links(base=links[chain[-1]][0], tip=links[last][1])
                arms.append(Arm(ends, tuple(reversed(chain))))
            if parent is None:
                break
            chain.append(parent)
    return arms


def _parents(
    links: dict[str, tuple[str, str]], joint_names: Collection[str]
) -> Iterator[tuple[str, str | None]]:
    """Yield each moving joint with the moving joint before it, None at the root."""
    by_child = {child: name for name, (_, child) in links.items()}
    for name in joint_names:
        parent = by_child.get(links[name][0])
        while parent is not None and parent not in joint_names:
            parent = by_child.get(links[parent][0])
        yield name, parent


def recorded_arms(
    arms: Iterable[Arm], count: int, joints: Collection[str], names: Sequence[str]
) -> list[Arm]:
    """Return the arms that may have made a recording.

    Args:
        arms: of the URDF.
        count: of recorded joints.
        joints: that the recording names, by their names in the URDF.
        names: of the recorded channels, which may say a side.
    """
    if joints:
        fitting = [arm for arm in arms if set(arm.joints) <= set(joints)]
        return [
            arm
            for arm in fitting
            if not any(set(arm.joints) < set(other.joints) for other in fitting)
        ]
    fitting = [arm for arm in arms if len(arm.joints) == count]
    side = _side(names)
    of_side = [arm for arm in fitting if side is not None and _side(arm.joints) == side]
    return of_side or fitting


def _side(names: Sequence[str]) -> str | None:
    """Return the side, left or right, that all names say; None without one."""
    sides = [
        {_SIDES[part] for part in _NUMBER_OR_MARK.split(name.lower()) if part in _SIDES}
        for name in names
    ]
    shared = set.intersection(*sides) if sides else set()
    return shared.pop() if len(shared) == 1 else None
