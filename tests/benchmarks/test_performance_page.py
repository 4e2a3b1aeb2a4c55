"""The page of measured figures is written from its table, and names benchmarks that exist."""

from __future__ import annotations

import re

import pytest

from benchmarks.__main__ import listed
from benchmarks.performance_page import PAGE, figures, page
from tests.docs.typed import options

ROWS = figures()["figure"]
LISTED = frozenset(listed())


def test_the_page_is_that_of_the_table() -> None:
    assert PAGE.read_text("utf-8") == page(), "run: python -m benchmarks.performance_page"


def test_nothing_is_still_to_be_measured() -> None:
    assert not re.search(r"to be (measured|repeated)|not measured again|TODO", page())


@pytest.mark.parametrize("command", sorted({row["command"] for row in ROWS}))
def test_the_command_of_a_figure_exists(command: str) -> None:
    benchmarks = re.findall(r"python -m benchmarks\.(\w+)", command)
    assert {*benchmarks} <= LISTED
    assert benchmarks or re.search(r"`(hil|time make) ", command)
    for line in re.findall(r"`(hil [^`]*)`", command):
        assert {*re.findall(r"--[a-z-]+", line)} <= options()
