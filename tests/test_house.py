"""The source code stays in order: see `tests.house`."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.house import CEILINGS, Sources, figures


@pytest.fixture(scope="module")
def now() -> dict[str, int]:
    return figures(Sources.read())


class TestHouse:
    @pytest.mark.parametrize("name", CEILINGS)
    def test_no_figure_exceeds_its_ceiling(self, name: str, now: dict[str, int]) -> None:
        """A ceiling is lowered, never raised."""
        remedy = "see which with `python -m tests.house --list`"
        assert now[name] <= CEILINGS[name], (
            f"{name}: {now[name]}, at most {CEILINGS[name]}: {remedy}"
        )

    def test_folders_that_import_one_another_are_a_circle(self, tmp_path: Path) -> None:
        """Files that do not may stand in them, and a package may list the names of its folders."""
        sources = {
            "arm": "from arm.links import chain",
            "arm.links": "",
            "arm.links.chain": "from arm.names import shown",
            "arm.links.size": "",
            "arm.names": "",
            "arm.names.shown": "",
            "arm.names.long": "from arm.links import size",
        }
        files = {name: tmp_path / f"{name}.py" for name in sources}
        for name, text in sources.items():
            files[name].write_text(text)
        assert not Sources(files).circles()
        assert Sources(files).folder_circles() == ["links, names, links"]
