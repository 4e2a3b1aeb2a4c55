"""Linear algebra has one thread, whatever loaded numpy before; the environment can set others."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from threadpoolctl import threadpool_info, threadpool_limits

import hil
from hil.base.errors import InputError
from hil.base.threads import VARIABLES
from tests.hil.importers.moving_log import URDF
from tests.hil.simulated_logs import write_moving_log

READ = InputError(None, "the log was read", remedy="none")


def threads() -> set[int]:
    return {pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"}


@pytest.fixture
def while_identifying(tmp_path: Path) -> Callable[[], set[int]]:
    log = write_moving_log(tmp_path / "log.csv", URDF)

    def observed() -> set[int]:
        seen: set[int] = set()

        def robot(_: object) -> hil.Robot:
            seen.update(threads())
            raise READ

        with threadpool_limits(2, user_api="blas"):
            with pytest.raises(InputError, match="the log was read"):
                hil.identify(log, robot=robot)
            assert threads() == {2}, "those of the caller are back"
        return seen

    return observed


def test_a_notebook_has_one_thread_while_it_identifies(
    monkeypatch: pytest.MonkeyPatch, while_identifying: Callable[[], set[int]]
) -> None:
    for variable in VARIABLES:
        monkeypatch.delenv(variable, raising=False)
    assert while_identifying() == {1}


def test_the_environment_sets_another_number(
    monkeypatch: pytest.MonkeyPatch, while_identifying: Callable[[], set[int]]
) -> None:
    monkeypatch.setenv(VARIABLES[0], "2")
    assert while_identifying() == {2}
