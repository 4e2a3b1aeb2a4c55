"""The tables of docs/cell-file.md are those of the schema, and its example works."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from importlib import metadata
from pathlib import Path
from typing import Any, get_args

import pytest
from pydantic import BaseModel
from pydantic.fields import FieldInfo

from hil.cell import Cell
from hil.cell.cell import CellFile
from hil.design import preset, problem_of

DOCUMENT = Path(__file__).parents[2] / "docs" / "cell-file.md"


def tables(model: type[BaseModel], prefix: str = "") -> Iterator[tuple[str, type[BaseModel]]]:
    """Every table that a cell file may have, by its dotted name."""
    for name, info in model.model_fields.items():
        for part in parts(info.annotation):
            kind = part.model_fields.get("kind")
            full = prefix + name + ("" if kind is None else f".{get_args(kind.annotation)[0]}")
            yield full, part
            yield from tables(part, f"{full}.")


def parts(annotation: Any) -> Iterator[type[BaseModel]]:
    """The models within an annotation, such as those of a list of several kinds."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
    for part in get_args(annotation):
        yield from parts(part)


def default_text(info: FieldInfo) -> str:
    """A default as the document writes it."""
    if info.is_required():
        return "required"
    value = info.get_default(call_default_factory=True)
    if value is None:
        return "not set"
    if not isinstance(value, BaseModel):
        return f"`{json.dumps(value)}`"
    if all(not field.is_required() for field in type(value).model_fields.values()):
        return "its own"
    inline = ", ".join(f"{key} = {json.dumps(entry)}" for key, entry in value)
    return f"`{{ {inline} }}`"


def documented() -> dict[str, dict[str, str]]:
    """Of each table in a heading: its fields' defaults as the rows below say."""
    found: dict[str, dict[str, str]] = {}
    here: list[str] = []
    for line in DOCUMENT.read_text("utf-8").splitlines():
        if line.startswith("#"):
            here = re.findall(r"`\[+([a-z_.]+)\]+`", line)
            if kinds := re.findall(r"`kind = \"([a-z_]+)\"`", line):
                here = [f"{name}.{kind}" for name in here for kind in kinds]
            found |= {name: {} for name in here}
        row = re.fullmatch(r"\| `(\w+)` \| (.+?) \| (.+) \|", line)
        for name in here if row else ():
            assert row is not None
            assert row[1] not in found[name], f"{row[1]} stands twice in {name}"
            found[name][row[1]] = row[2]
    return found


def test_the_document_and_the_schema_name_the_same_fields_and_defaults() -> None:
    schema: dict[str, Any] = {
        name: {field: default_text(info) for field, info in model.model_fields.items()}
        for name, model in tables(CellFile)
    }
    assert documented() == schema


@pytest.fixture
def ur10(tmp_path: Path) -> Path:
    """The cell file of the worked example beside its URDF; meshes are where it says."""
    try:
        package = metadata.distribution("example-robot-data")
    except metadata.PackageNotFoundError:
        pytest.skip("the package example-robot-data, which has the UR10's URDF, is not installed")
    share = Path(str(package.locate_file("cmeel.prefix/share")))
    urdf = share / "example-robot-data/robots/ur_description/urdf/ur10_robot.urdf"
    (tmp_path / "ur10_robot.urdf").write_bytes(urdf.read_bytes())
    (tmp_path / "share").symlink_to(share)
    (example,) = re.findall(
        r"```toml\n(\[cell\]\nname = \"UR10\".*?)```", DOCUMENT.read_text("utf-8"), re.S
    )
    (tmp_path / "cell.toml").write_text(example, "utf-8")
    return tmp_path / "cell.toml"


def test_the_worked_example_can_be_designed_for_with_all_checks(ur10: Path) -> None:
    problem = problem_of(Cell.load(ur10), preset("b"))
    assert problem.constraints.checker is not None
    assert problem.constraints.currents is not None
    assert ("base_link", "upper_arm_link") in problem.constraints.checker.pairs
