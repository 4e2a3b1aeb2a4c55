from __future__ import annotations

import os
from pathlib import Path

# One BLAS thread: the machine is small and results must not depend on how many cores it has.
for _variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_variable, "1")

import pytest
from hypothesis import HealthCheck, settings

settings.register_profile(
    "hil", deadline=None, derandomize=True, suppress_health_check=[HealthCheck.too_slow]
)
settings.load_profile("hil")


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Folder of real recordings and captures that lies beside the project, where it is present."""
    folder = Path(__file__).resolve().parents[2] / "shared" / "data"
    if not folder.is_dir():
        pytest.skip("the folder of real recordings (../shared/data) is not beside this checkout")
    return folder
