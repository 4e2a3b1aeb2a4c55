from __future__ import annotations

import os
import re
import signal
from pathlib import Path

# One BLAS thread: the machine is small and results must not depend on how many cores it has.
for _variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_variable, "1")

# Whoever starts the tests may ignore these (nohup, a job in the background), and children inherit
# that: a program that is to end by them would not.
signal.signal(signal.SIGHUP, signal.SIG_DFL)
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

import pytest
from hypothesis import HealthCheck, settings

settings.register_profile(
    "hil", deadline=None, derandomize=True, suppress_health_check=[HealthCheck.too_slow]
)
settings.load_profile("hil")
settings.register_profile("quick", settings.get_profile("hil"), max_examples=30)
"""For every change; `make test-all` has all examples."""

# Tests of other folders import them, too, some before those of tests/drivers.
_OF_DRIVERS = ("transport_contract", "can_bench", "rig", "judge", "oracle", "losses")
pytest.register_assert_rewrite(
    *(f"tests.drivers.{name}" for name in _OF_DRIVERS),
    "tests.hil.importers.moving_log",
    "tests.hil.report.pages",
)


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Whether a file is of a tier that `-m` excludes: it is not even imported, half of the time."""
    if collection_path.suffix != ".py":
        return None
    excluded = excluded_tiers(config.getoption("markexpr", default=""))
    return bool(excluded & tiers_of(collection_path.read_text("utf-8"))) or None


def pytest_configure(config: pytest.Config) -> None:
    """Where long tests are left out, so are further examples of the same property."""
    if "long" in excluded_tiers(config.getoption("markexpr", default="")):
        settings.load_profile("quick")


def excluded_tiers(expression: str) -> set[str]:
    """Marks that each test must not have by an expression such as "not slow and not long"."""
    if re.search(r"\bor\b|\(", expression):
        return set()
    return set(re.findall(r"\bnot (\w+)", expression))


def tiers_of(module: str) -> set[str]:
    """Marks of all tests of a module, by its line with `pytestmark`."""
    marks = re.findall(r"^pytestmark = (.*)", module, re.MULTILINE)
    return {name for line in marks for name in re.findall(r"pytest\.mark\.(\w+)", line)}


_LONGEST = (
    "test_fault_matrix.py",
    "test_cli.py",
    "test_rounds.py",
    "test_one_sided_errors.py",
    "test_conversations.py",
    "test_record_command.py",
    "test_design_command.py",
    "test_identify.py",
    "test_study.py",
    "test_batch.py",
    "test_commands.py",
    "test_worker.py",
)
"""Files that take longest: the workers of `make test` begin with them, so that none ends alone."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    rank = {name: place for place, name in enumerate(_LONGEST)}
    # Within a file as it was.
    items.sort(key=lambda item: rank.get(item.path.name, len(rank)))


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Folder of real recordings and captures that lies beside the project, where it is present."""
    folder = Path(__file__).resolve().parents[2] / "shared" / "data"
    if not folder.is_dir():
        pytest.skip("the folder of real recordings (../shared/data) is not beside this checkout")
    return folder
