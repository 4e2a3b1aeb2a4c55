"""Options of what a model has to be good for."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import Result
from typer.testing import CliRunner

from hil.base.errors import InputError
from hil.cli import app
from hil.cli.purpose_options import Required, quantity
from tests.hil.simulated_logs import simulate, urdf_path, write_log


@pytest.mark.parametrize(
    ("text", "unit", "value"),
    [("50N", "N", 50.0), ("50", "N", 50.0), ("500 g", "kg", 0.5), ("2mm", "m", 2e-3)],
)
def test_quantities_have_units(text: str, unit: str, value: float) -> None:
    assert quantity(text, unit, "--contact") == pytest.approx(value)


@pytest.mark.parametrize("text", ["50 kg", "N", "-3N", "0", "nan", "1e999N", "", "5..N"])
def test_what_is_no_force_is_refused_with_the_option(text: str) -> None:
    with pytest.raises(InputError, match="--contact"):
        quantity(text, "N", "--contact")


def test_purposes_and_limits_become_options() -> None:
    options = Required(["gravity", "contact"], contact="40N", flange_error="2mm").options()
    assert options["purposes"] == ("gravity", "contact")
    assert options["required"].contact == 40.0
    assert options["required"].distance == pytest.approx(2e-3)


@pytest.mark.parametrize("names", [["gravitation"], ["contact"], ["payload"], ["parameters"]])
def test_a_purpose_that_cannot_be_judged_is_refused(names: list[str]) -> None:
    with pytest.raises(InputError, match="--for"):
        Required(names).options()


LIMITS = {"contact": "--contact", "payload": "--payload-change", "simulation": "--flange-error"}


def identify(log: Path, *options: str) -> Result:
    """Run `hil identify` as on the command line."""
    words = ("identify", log, "--urdf", urdf_path("ur5_robot.urdf"), "--json", *options)
    return CliRunner().invoke(app, [*map(str, words)])


@pytest.fixture(scope="module")
def judged(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, dict[str, Any]]]:
    """A log of a UR5, and the purposes of its model by name."""
    made = simulate("ur5_robot.urdf", np.arange(0.0, 60.0, 0.02))
    log = tmp_path_factory.mktemp("judged") / "log.csv"
    write_log(
        log, ["t", "q{}", "v{}", "tau{}"], made.time, made.position, made.velocity, made.torque
    )
    found = json.loads(identify(log).stdout)
    return log, {purpose["name"]: purpose for purpose in found["purposes"]}


@pytest.mark.long
@pytest.mark.parametrize("purpose", LIMITS)
@pytest.mark.parametrize(("share", "status"), [(1.02, 0), (0.98, 5)])
def test_a_limit_above_or_below_the_figure_decides(
    purpose: str, share: float, status: int, judged: tuple[Path, dict[str, dict[str, Any]]]
) -> None:
    log, purposes = judged
    limit = share * purposes[purpose]["figure"]
    run = identify(
        log, "--for", purpose, LIMITS[purpose], f"{limit:.9f}{purposes[purpose]['unit']}"
    )
    assert run.exit_code == status, run.output
    (row,) = (one for one in json.loads(run.stdout)["purposes"] if one["name"] == purpose)
    assert row["good"] is (status == 0)
