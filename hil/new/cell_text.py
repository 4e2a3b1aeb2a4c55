"""Text of a new cell file; unknown values are `"?"`."""

from __future__ import annotations

import os
import re
import sys
import textwrap
import xml.etree.ElementTree as ET
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final, get_origin

import numpy as np
import tomlkit
from pydantic.fields import FieldInfo
from scipy.spatial.transform import Rotation
from tomlkit.items import Table

from drivers.drive_train import WRIST_AXES
from hil.base.arrays import Array
from hil.base.errors import InputError
from hil.base.safe_input import read_input, read_text
from hil.base.toml_text import comment_lines, inline
from hil.cell.arms import Links, joints_outside
from hil.cell.errors import UNKNOWN, WHERE, models_of
from hil.cell.gripper_names import gripper_joints, links_of
from hil.cell.schema import CellFile
from hil.importers.dh import Convention, urdf_of_dh, urdf_of_parameters
from identification.errors import ModelError
from identification.model.joint_ranges import urdf_limits
from identification.model.kinematics import (
    MAX_MOVING_JOINTS,
    Chain,
    chain_from_urdf,
    pinocchio_model,
)
from identification.model.urdf_text import urdf_tree

from .cell_values import ASSUMED, CellValues, assumed_for_design, clear_home, from_urdf
from .messages import note_lines
from .notes import (
    CellNote,
    FixedMimic,
    FixedOutside,
    FixedPrismatic,
    GripperJoints,
    LiftingJoints,
    PlainNote,
    SeveralBranches,
)


@contextmanager
def quiet_libraries() -> Iterator[None]:
    """Suppress output to file descriptor 2, such as from the C++ library urdfdom."""
    sys.stderr.flush()
    saved = os.dup(2)
    nowhere = os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nowhere, 2)
        yield
    finally:
        os.dup2(saved, 2)
        os.close(saved)
        os.close(nowhere)


_OF_MOVING: Final = ("axis", "limit", "mimic", "dynamics", "safety_controller", "calibration")


def mimics(urdf: str) -> dict[str, tuple[str, float]]:
    """Return the leading joint and offset [rad or m] of each mimic joint."""
    return {
        joint.get("name", ""): (mimic.get("joint", "?"), float(mimic.get("offset", "0")))
        for joint in urdf_tree(urdf).findall("joint")
        for mimic in joint.findall("mimic")
    }


def with_fixed(urdf: str, positions: Mapping[str, float]) -> str:
    """Return the URDF with joints fixed at positions [rad or m]; KeyError for unknown joints."""
    root = urdf_tree(urdf, comments=True)
    joints = {joint.get("name"): joint for joint in root.findall("joint")}
    for name, position in positions.items():
        _fix(joints[name], position)
    return '<?xml version="1.0"?>\n' + ET.tostring(root, encoding="unicode") + "\n"


def _fix(joint: ET.Element, position: float) -> None:
    axis = joint.find("axis")
    along = _three(None if axis is None else axis.get("xyz"), "1 0 0")
    along /= np.linalg.norm(along)
    if position:
        origin = joint.find("origin")
        if origin is None:
            origin = ET.SubElement(joint, "origin")
        place = _three(origin.get("xyz"), "0 0 0")
        turn = _three(origin.get("rpy"), "0 0 0")
        rotation = Rotation.from_euler("xyz", turn)  # URDF: roll, pitch, yaw about fixed axes
        if joint.get("type") == "prismatic":
            place = place + rotation.apply(along * position)
        else:
            rotation = rotation * Rotation.from_rotvec(along * position)
        for name, values in (("xyz", place), ("rpy", rotation.as_euler("xyz"))):
            origin.set(name, " ".join(map(repr, values.tolist())))
    joint.set("type", "fixed")
    for element in [*joint]:
        if element.tag in _OF_MOVING:
            joint.remove(element)


def _three(text: str | None, default: str) -> Array:
    return np.array([float(part) for part in (text or default).split()])


_DEFAULTS: Final[Mapping[str, Any]] = {
    "cell.description": "",
    "robot.gravity": [0.0, 0.0, -9.81],
    "robot.friction": {"standstill": 0.05},
    "limits.frame": "urdf",
    "limits.torque": [],
    "controller.transport": "udp",
    "controller.port": 1000,
    "controller.arm": 1,
    "controller.current_delay_cycles": 0.0,
    "nominal.uncertainty": 0.3,
    "workspace.margin": 0.05,
    "campaign.approach_speed": 0.05,
    "campaign.repetitions": 30,
    "campaign.validation_runs": 10,
}
"""Values of a new cell file, unless known; others are unknown (`WHERE`) or not written."""
_HEAD: Final = """\
{name}: cell file made by `hil new`. {sources}

"?" is an unknown value. A file with a "?" is refused, with a list of all of them and where to
find each. List values that are assumed, not measured, in `assumed`: results that depend on them
report it. An arrow (->) names the source of a value.

Lists have one entry per joint, in this order:
  {joints}
Units are SI, except where a name says degrees (_deg) or milliseconds (_ms), or a comment
revolutions.
"""
_OF_RECORDINGS: Final = ("cell", "robot")
"""Tables of a cell whose arm is identified from recordings, not moved."""
_MIN_ALIGNMENT_COSINE: Final = 0.99  # cosine of the angle between an axis and gravity
_ASSUMED: Final = ("nominal.uncertainty", "controller.current_delay_cycles")
"""Fields whose default is written as an assumption."""
_MESH: Final = re.compile(r"""filename\s*=\s*["'](package://[^"']+)["']""")
_COLLISION: Final = re.compile(r"<collision\b.*?</collision>", re.DOTALL)


@dataclass(frozen=True)
class NewCell:
    """Content of a new cell file."""

    name: str
    joint_names: tuple[str, ...]
    urdf: str | None  #: changed URDF text, None if the given file is used
    urdf_path: Path  #: URDF or table of DH parameters that was read
    meshes: tuple[str, ...]  #: `package://` mesh paths of the collision shapes
    values: CellValues
    design_only: bool = False
    #: prismatic joints along gravity that are identified; from recordings only, as no controller
    #: moves them
    lifting: tuple[str, ...] = ()

    def text(self, path: Path) -> tuple[str, tuple[str, ...]]:
        """Return the text of the cell file at `path`, and its unknown fields."""
        path = path.resolve()
        urdf = self.urdf_beside(path) if self.urdf is not None else self.urdf_path.resolve()
        values = dict(_DEFAULTS)
        if len(self.joint_names) < WRIST_AXES:
            values |= {f"drive_train.{name}": 0.0 for name in ("k54", "k64", "k65")}
        folders = self._mesh_folders(path.parent)
        values |= {
            "cell.name": self.name,
            "cell.urdf": os.path.relpath(urdf, path.parent),
            "cell.assumed": self._assumed(),
            **({} if folders is None else {"cell.mesh_folders": folders}),
            **self.values.values,
        }
        if values["controller.transport"] == "rtde":  # its port is in [controller.rtde]
            del values["controller.port"], values["controller.arm"]
        document = self._head()
        unknown = list[str]()
        without: Collection[str] = ("drive_train", "controller") if self.design_only else ()
        if self.lifting:
            without = {*CellFile.model_fields} - {*_OF_RECORDINGS}
        tables = [*CellFile.model_fields, *(name.partition(".")[0] for name in values)]
        for name in dict.fromkeys(tables):
            if name not in without:
                table, unknown_fields = self._table(name, values)
                unknown += unknown_fields
                if table:
                    document.append(name, table)
        return tomlkit.dumps(document), tuple(unknown)

    def _head(self) -> tomlkit.TOMLDocument:
        """Return a document with the comments at the top of the file."""
        origins = ", ".join(dict.fromkeys(self.values.origin.values()))
        head = _HEAD.format(
            name=self.name,
            sources=f"Its values are {origins}." if origins else "",
            joints=", ".join(f"{k} {name}" for k, name in enumerate(self.joint_names, 1)),
        )
        notes = [_wrapped(f"Note: {note}") for note in note_lines(self.values.notes)]
        document = tomlkit.document()
        for line in comment_lines("\n".join([head, *notes])):
            document.add(line)
        return document

    def _table(self, table: str, values: Mapping[str, Any]) -> tuple[Table, list[str]]:
        """Return a commented table of the file, and its unknown fields."""
        fields = _fields_of(table)
        others = (name for name in values if name.startswith(f"{table}."))
        written = tomlkit.table()
        unknown = list[str]()
        for name in dict.fromkeys([*fields, *others]):
            if name not in values and name not in _UNKNOWN:
                continue
            value = values.get(name)
            if value is None:
                value = UNKNOWN
                if _is_one_each(fields[name]):
                    value = [UNKNOWN] * len(self.joint_names)
            comments = _wrapped(fields[name].description or "") if name in fields else ""
            if value == UNKNOWN or (isinstance(value, list) and UNKNOWN in value):
                unknown.append(name)
                comments += "\n" + _wrapped(WHERE.get(name, ""), mark="-> ")
            for line in comment_lines(comments):
                written.add(line)
            item = inline(value)
            origin = self.values.origin.get(name)
            if origin:
                item.comment(origin)
            written.append(name.partition(".")[2], item)
        return written, unknown

    def _assumed(self) -> list[str]:
        """Return the names of assumed fields."""
        names = [name for name in _ASSUMED if name not in self.values.values]
        if self.lifting:
            return []
        if self.design_only:
            names = [name for name in names if not name.startswith("controller.")]
        assumed = [name for name, origin in self.values.origin.items() if origin == ASSUMED]
        return [*names, *(name for name in assumed if not name.startswith("campaign."))]

    def _mesh_folders(self, folder: Path) -> list[str] | None:
        """Return the folders that contain the packages of collision meshes; None without meshes."""
        if not self.meshes:
            return None
        folders: dict[str, None] = {}
        for mesh in self.meshes:
            relative = mesh.removeprefix("package://")
            above = self.urdf_path.resolve().parents
            place = next((place for place in above if (place / relative).is_file()), None)
            if place is None:
                return [UNKNOWN]
            folders[os.path.relpath(place, folder)] = None
        return list(folders)

    def for_design(self) -> NewCell:
        """Return the cell for design only, with assumed values and a clear home posture."""
        cell_values = self.values | assumed_for_design(self.values, len(self.joint_names))
        home = clear_home(self.urdf_text, cell_values, self.mesh_places)
        return replace(self, values=cell_values | home, design_only=True)

    def for_arm(self, stated: CellValues) -> NewCell:
        """Return the cell with what an arm states, and assumed values of the rest."""
        known = self.values | stated
        assumed = assumed_for_design(known, len(self.joint_names))
        made = replace(self, values=self.values | assumed | stated)
        home = made.values | clear_home(made.urdf_text, made.values, made.mesh_places)
        return replace(made, values=home)

    @property
    def urdf_text(self) -> str:
        """Text of the cell's URDF."""
        return self.urdf if self.urdf is not None else read_text(self.urdf_path)

    @property
    def mesh_places(self) -> list[str]:
        """Folders of the meshes, as seen from here."""
        beside = self.urdf_path.resolve().parent
        return [str(beside / folder) for folder in self._mesh_folders(beside) or []]

    def urdf_beside(self, path: Path) -> Path:
        """Return the path of a changed URDF: next to the cell file, different from the original."""
        beside = path.with_suffix(".urdf")
        if beside.resolve() == self.urdf_path.resolve():
            return path.with_name(f"{path.stem}_fixed.urdf")
        return beside


_UNKNOWN: Final = {name: UNKNOWN for name in WHERE if name != "cell.mesh_folders"}
"""Fields that a new cell file has even if their values are unknown."""


def _fields_of(table: str) -> dict[str, FieldInfo]:
    """Return the fields of a table of the schema by dotted name; none of an unknown one."""
    if table not in CellFile.model_fields:
        return {}
    model = next(models_of(CellFile.model_fields[table].annotation))
    return {f"{table}.{name}": field for name, field in model.model_fields.items()}


def _is_one_each(field: FieldInfo) -> bool:
    """Whether a field is a list with an entry for each joint."""
    return get_origin(field.annotation) is list and not any(models_of(field.annotation))


def _wrapped(text: str, mark: str = "") -> str:
    """Return lines of a comment, the first behind a mark."""
    return textwrap.fill(text, 96, initial_indent=mark, subsequent_indent=" " * len(mark))


def cell_of_dh(path: Path, convention: Convention, fixed: Mapping[str, float]) -> NewCell:
    """Return the cell of a table of DH parameters, with a URDF to write, or raise InputError."""
    text = urdf_of_dh(path, convention)
    made = _cell_of(path, text, fixed, moved=True)
    values = CellValues(notes=(PlainNote.GEOMETRY_OF_TABLE,)) | made.values
    return replace(made, urdf=made.urdf or text, values=values)


def cell_of_parameters(
    name: str, joints: Sequence[str], parameters: Mapping[str, Sequence[float]]
) -> NewCell:
    """Return the cell of DH parameters by name (`urdf_of_parameters`), with a URDF to write."""
    text = urdf_of_parameters(name, joints, parameters)
    made = _cell_of(Path(name), text, {}, moved=True)
    return replace(
        made, urdf=text, values=CellValues(notes=(PlainNote.GEOMETRY_OF_ARM,)) | made.values
    )


def cell_of_urdf(
    path: Path,
    fixed: Mapping[str, float],
    *,
    base: str | None = None,
    tip: str | None = None,
    moved: bool = False,
) -> NewCell:
    """Return the cell of the URDF of an open chain.

    Prismatic joints are fixed at zero (or the nearest position in their range), mimic joints at
    their offset; notes report this. A prismatic joint along gravity is not fixed, unless the arm is
    to be moved or the joint is of a gripper.

    Args:
        path: of the URDF.
        fixed: positions of joints to be fixed, by name [rad or m].
        base: link below the arm; joints that do not lie between base and tip are fixed.
        tip: link above it.
        moved: whether the arm is to be moved.

    Raises:
        InputError: the URDF is not of an open chain.
    """
    text = read_input(path, "give a URDF")
    names = _moving_joints(path, text)
    links = Links(base=base, tip=tip)
    if not links:
        if len(names) > MAX_MOVING_JOINTS:
            problem = (
                f"has {len(names)} moving joints; at most {MAX_MOVING_JOINTS} can be identified"
            )
            remedy = "choose one arm with --base LINK --tip LINK"
            raise InputError(path, problem, remedy=remedy)
        return _cell_of(path, text, fixed, moved=moved)
    outside = joints_outside(path, text, links, names)
    others = [name for name in outside if name not in fixed]
    if not others:
        return _cell_of(path, text, fixed, moved=moved)
    limits = urdf_limits(text, others)
    nearest = np.clip(0.0, limits.lower, limits.upper).tolist()
    arm = with_fixed(text, dict(zip(others, nearest, strict=True)))
    made = _cell_of(path, arm, fixed, moved=moved)
    note = FixedOutside(links, tuple(others))
    return replace(made, urdf=made.urdf or arm, values=made.values | CellValues(notes=(note,)))


def _gripper(fingers: Sequence[str], chain: Chain, text: str) -> GripperJoints:
    """Return joints of a gripper, with the last link of the arm if there is one."""
    links = links_of(text)
    parents = dict(zip(chain.joint_names, chain.parents.tolist(), strict=True))
    wrists = {
        links[chain.joint_names[parents[name]]][1]
        for name in fingers
        if parents[name] >= 0 and chain.joint_names[parents[name]] not in fingers
    }
    return GripperJoints(tuple(fingers), wrists.pop() if len(wrists) == 1 else None)


def _branches(text: str, chain: Chain) -> list[CellNote]:
    """Return a gripper and further arms among the joints that move."""
    notes = list[CellNote]()
    fingers = gripper_joints(text, chain.joint_names)
    if fingers:
        notes.append(_gripper(fingers, chain, text))
    arm = [k for k, name in enumerate(chain.joint_names) if name not in fingers]
    inner = {int(chain.parents[k]) for k in arm}
    links = links_of(text)
    ends = tuple(links[chain.joint_names[k]][1] for k in arm if k not in inner)
    if len(ends) > 1:
        notes.append(SeveralBranches(ends))
    return notes


def _lifting(text: str, chain: Chain) -> list[str]:
    """Return the prismatic joints along gravity with all joints at zero, without grippers'."""
    gripper = gripper_joints(text, chain.joint_names)
    rotations = list[Array]()
    lifting = []
    for joint, name in enumerate(chain.joint_names):
        parent = chain.parents[joint]
        outer = rotations[parent] if parent >= 0 else np.eye(3)
        rotations.append(outer @ chain.rotation[joint])
        vertical = abs((rotations[joint] @ chain.axis[joint])[2])
        if not chain.revolute[joint] and vertical > _MIN_ALIGNMENT_COSINE and name not in gripper:
            lifting.append(name)
    return lifting


def _cell_of(path: Path, text: str, fixed: Mapping[str, float], *, moved: bool) -> NewCell:
    """Return the cell of the URDF text read from `path`."""
    chain = _chain(path, text)
    names = chain.joint_names
    if unknown := sorted(set(fixed) - set(names)):
        remedy = f"it has {', '.join(names)}"
        raise InputError(path, f"has no moving joint {unknown[0]}", remedy=remedy)
    limits = urdf_limits(text, names)
    nearest = dict(zip(names, np.clip(0.0, limits.lower, limits.upper).tolist(), strict=True))
    led = mimics(text)
    lifting = [name for name in _lifting(text, chain) if name not in fixed and name not in led]
    sliding = {
        name: nearest[name]
        for name, turns in zip(names, chain.revolute, strict=True)
        if not turns and name not in fixed and (moved or name not in lifting)
    }
    following = {
        name: leader for name, leader in led.items() if name in names and name not in sliding
    }
    positions = sliding | {name: offset for name, (_, offset) in following.items()} | {**fixed}
    notes: list[CellNote] = [FixedPrismatic(*joint) for joint in sliding.items()]
    if lifting and not moved:
        notes.append(LiftingJoints(tuple(lifting)))
    notes += [FixedMimic(name, leader, positions[name]) for name, (leader, _) in following.items()]
    used = with_fixed(text, positions) if positions else text
    moving_chain = _chain(path, used)
    moving = moving_chain.joint_names
    notes += _branches(used, moving_chain)
    shapes = _COLLISION.findall(text)
    if not shapes:
        notes.append(PlainNote.NO_COLLISION_SHAPES)
    name = re.search(r"<robot\b[^>]*\bname\s*=\s*[\"']([^\"']*)[\"']", used)
    return NewCell(
        name=(name[1].strip()[:80] if name else "") or path.stem,
        joint_names=moving,
        urdf=used if positions else None,
        urdf_path=path,
        meshes=tuple(sorted({mesh for shape in shapes for mesh in _MESH.findall(shape)})),
        values=from_urdf(used, moving) | CellValues(notes=tuple(notes)),
        lifting=() if moved else tuple(lifting),
    )


def _moving_joints(path: Path, urdf: str) -> list[str]:
    """Return the names of all joints that move, also of a robot with more than an arm may have."""
    try:
        with quiet_libraries():
            return [*pinocchio_model(urdf).names][1:]
    except ModelError as error:
        raise InputError(path, str(error), remedy="correct the URDF") from error


def _chain(path: Path, urdf: str) -> Chain:
    try:
        with quiet_libraries():
            return chain_from_urdf(urdf)
    except ModelError as error:
        raise InputError(path, str(error), remedy="correct the URDF") from error
