from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from planner.interpolator import Interpolator
from planner.rrs import EventKind, Status

PAGE = Path(__file__).parents[2] / "docs" / "interpolator.md"


@pytest.fixture(scope="module")
def page():
    return PAGE.read_text()


def test_the_example_runs_to_its_last_target(page):
    (code,) = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    names: dict = {}
    exec(code, names)
    assert [event.target_id for event in names["events"]] == [1, 2, 3, 4]
    assert names["events"][-1].kind is EventKind.MOTION_ENDED
    np.testing.assert_array_equal(names["set_points"][-1], [0.0, 0.0])
    assert not any(np.allclose(q, [1.0, 0.5], atol=1e-4) for q in names["set_points"])  # flown by


def test_every_service_and_code_is_on_the_page_and_no_other(page):
    services = {
        name
        for name in dir(Interpolator)
        if not name.startswith("_") and callable(getattr(Interpolator, name))
    }
    table = page.split("## Services")[1].split("## Where")[0]
    assert set(re.findall(r"`([a-z_]+)`", table)) == services
    codes = re.findall(r"^\| (-?\d+) \| ([A-Z_]+) \|", page, re.MULTILINE)
    assert [(int(code), name) for code, name in codes] == [(s.value, s.name) for s in Status]
    assert all(status.meaning for status in Status)
