"""Pytest plugin with fixtures of a simulated cell, down to the bytes of the protocol.

pytest loads it once the package is installed; modules are imported when a fixture is used. See
`docs/simulate.md`.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from hil.campaign import Campaign, VirtualLink
    from hil.cell import Cell
    from hil.testing.faulty import UdpController
    from sim_fixtures import SimulatedController

MARKER = "controller_faults"
OPTIONS_MARKER = "controller_options"


def pytest_configure(config: pytest.Config) -> None:
    """Register the markers."""
    config.addinivalue_line(
        "markers",
        f"{MARKER}(*lines): faults of the simulated controller or its link, as for "
        '`hil simulate --fault`: "e-stop@4000", "lose@3000x3"',
    )
    config.addinivalue_line(
        "markers",
        f"{OPTIONS_MARKER}(*options): options of `hil simulate` for udp_controller: "
        '"--intervals", "1" ends the session (504) after the first motion',
    )


@pytest.fixture(scope="session")
def simulated_cell() -> Cell:
    """The simulated COMAU NS 16 with a campaign of seconds.

    Override it in your conftest.py to use your own cell, which needs a table [simulation].
    """
    from hil.cell import Cell
    from hil.testing.faulty import shortened
    from sim_fixtures.ns16 import CELL_PATH

    return shortened(Cell.load(CELL_PATH))


@pytest.fixture
def controller_faults(request: pytest.FixtureRequest) -> tuple[str, ...]:
    """Faults of the test's `controller_faults` markers."""
    return tuple(line for mark in request.node.iter_markers(MARKER) for line in mark.args)


@pytest.fixture
def simulated_controller(
    simulated_cell: Cell, controller_faults: tuple[str, ...]
) -> SimulatedController:
    """A new controller with its arm, in virtual time, reproducible by seed."""
    from hil.testing.faulty import faulty_controller

    return faulty_controller(simulated_cell, *controller_faults)


@pytest.fixture
def simulated_link(
    simulated_cell: Cell,
    simulated_controller: SimulatedController,
    controller_faults: tuple[str, ...],
) -> VirtualLink:
    """A link to `simulated_controller` for `Campaign.run`, not yet connected."""
    from hil.testing.faulty import faulty_link

    return faulty_link(simulated_cell, *controller_faults, controller=simulated_controller)


@pytest.fixture(scope="session")
def short_campaign(tmp_path_factory: pytest.TempPathFactory, simulated_cell: Cell) -> Campaign:
    """A complete campaign of `simulated_cell`. Read-only."""
    from hil.testing.faulty import run_campaign

    return run_campaign(tmp_path_factory.mktemp("hil") / "campaign", simulated_cell)


@pytest.fixture(scope="session")
def identified_campaign(
    tmp_path_factory: pytest.TempPathFactory, short_campaign: Campaign
) -> Campaign:
    """A copy of `short_campaign` with results, exports and report. Read-only."""
    import shutil

    root = tmp_path_factory.mktemp("hil") / "identified"
    shutil.copytree(short_campaign.folder.root, root)
    campaign = type(short_campaign).open(root)
    campaign.identify()
    return campaign


@pytest.fixture
def controller_options(request: pytest.FixtureRequest) -> tuple[str, ...]:
    """Options of the test's `controller_options` markers."""
    marks = request.node.iter_markers(OPTIONS_MARKER)
    return tuple(str(option) for mark in marks for option in mark.args)


@pytest.fixture
def udp_controller(
    tmp_path: Path,
    simulated_cell: Cell,
    controller_faults: tuple[str, ...],
    controller_options: tuple[str, ...],
) -> Iterator[UdpController]:
    """A simulated controller in another process, over loopback UDP, in real time."""
    from hil.testing.faulty import UdpController

    with UdpController.started(
        simulated_cell, tmp_path, faults=controller_faults, options=controller_options
    ) as controller:
        yield controller
