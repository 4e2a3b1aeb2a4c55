"""The CAN transport on a real kernel's sockets, in an emulated machine. Opt-in: `-m qemu`."""

from __future__ import annotations

import importlib.util
import os
import re
import shlex
import shutil
import sys
from pathlib import Path

import pytest

HERE = Path(__file__).parent
REPOSITORY = HERE.parents[1]
KERNEL = "HIL_QEMU_KERNEL"
MINUTES = 10


def machine():
    spec = importlib.util.spec_from_file_location("vcan_machine", HERE / "vcan_machine.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.qemu
@pytest.mark.skipif(KERNEL not in os.environ, reason=f"{KERNEL} names no unpacked kernel package")
@pytest.mark.skipif(not shutil.which("qemu-system-x86_64"), reason="qemu is not installed")
def test_the_contract_and_a_session_hold_on_a_real_kernels_can_sockets():
    command = (
        f"cd {shlex.quote(str(REPOSITORY))} && PYTHONDONTWRITEBYTECODE=1 "
        f"{shlex.quote(sys.executable)} -m pytest -p no:cacheprovider -rs --tb=short "
        "tests/drivers/test_can_socketcan.py"
    )
    code, console = machine().run(Path(os.environ[KERNEL]), command, timeout=60.0 * MINUTES)
    assert code == 0, console
    assert re.search(r"\d+ passed", console), console
    assert "skipped" not in console, console
