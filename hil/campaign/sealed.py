"""What exactly is going to be run: cell, URDF, plan and collision meshes, by their checksums."""

from __future__ import annotations

import hashlib
import io
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Final

from hil.reading import digest_of, toml_of
from identification.errors import ModelError
from identification.urdf_tree import urdf_tree

MESH: Final = "mesh "
"""Begins the entry of a mesh, by its name in the URDF."""
MISSING: Final = "missing"
_PACKAGE: Final = "package://"
_FILE: Final = "file://"


def checksum(content: bytes) -> str:
    """SHA-256 in hexadecimal digits."""
    return hashlib.sha256(content).hexdigest()


def checksums(contents: Mapping[str, bytes], root: Path) -> dict[str, str]:
    """Checksums of the inputs of a plan, and of the collision meshes that they name.

    Args:
        contents: of `cell.toml`, `robot.urdf` and `plan.json`, as far as they are there.
        root: folder that relative paths in them begin at.

    Returns:
        By file name; a mesh that cannot be read is "missing" (no motion is checked without).
    """
    sums = {name: checksum(content) for name, content in contents.items()}
    for mesh in _collision_meshes(contents.get("robot.urdf", b"")):
        places = _places(mesh, _mesh_folders(contents.get("cell.toml", b""), root), root)
        sums[MESH + mesh] = next(filter(None, map(_read, places)), MISSING)
    return sums


def combined(sums: Mapping[str, str]) -> str:
    """One checksum over all."""
    return checksum(json.dumps(dict(sums), sort_keys=True).encode())


def as_text(content: bytes) -> str:
    """A file's content as reading it as text gives it (UTF-8, any line ends)."""
    return io.TextIOWrapper(io.BytesIO(content), "utf-8").read()


def _collision_meshes(urdf: bytes) -> list[str]:
    try:
        root = urdf_tree(as_text(urdf))
    except (ModelError, UnicodeDecodeError):  # whoever loads it says so
        return []
    found = root.iterfind("./link/collision/geometry/mesh")
    return sorted({name for mesh in found if (name := mesh.get("filename"))})


def _mesh_folders(cell: bytes, root: Path) -> list[Path]:
    try:
        named = toml_of(as_text(cell))["cell"]["mesh_folders"]
        return [root / name for name in named]
    except (ValueError, KeyError, TypeError):  # likewise
        return []


def _places(mesh: str, folders: list[Path], root: Path) -> list[Path]:
    """Where a mesh is looked for, in that order."""
    if mesh.startswith(_PACKAGE):
        return [folder / mesh.removeprefix(_PACKAGE) for folder in folders]
    name = mesh.removeprefix(_FILE)
    return [root / name, *(folder / name for folder in folders)]


def _read(path: Path) -> str | None:
    try:
        return digest_of(path)
    except OSError:
        return None
