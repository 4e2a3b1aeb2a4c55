"""What messages of design, campaign and batch tell a user to type, typed.

A small simulated arm is designed for, rehearsed, run and identified by nothing but the commands
that the messages name; its folder has a blank in its name. `TYPED` says which test types which
message, and a test that every message is in it or in `ELSEWHERE`.
"""

from __future__ import annotations

import json
import re
import shlex
import shutil
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from distributed import LocalCluster

from hil.base.errors import InputError
from hil.campaign.folder import SIDES, CampaignFolder
from hil.control.simulated_cell import simulated_link
from hil.design import DesignResult
from tests.docs.sources import COMMAND, FIELD, OPTION, messages
from tests.hil.cli.remedies import message, typed
from tests.hil.fast_cell import (
    QUICK,
    QUICK_GRADIENT,
    fast_campaign,
    fast_cell,
    mirrored,
    pass_rehearsal,
)

pytestmark = pytest.mark.long

PACKAGES = re.compile(
    r"hil/(campaign|control|design|precision|batch)/|hil/cli/(run|rehearse|status|design|batch)\.py"
)
TYPED = {
    "resume it (--resume), choose another folder (-o), or add --force": (
        "test_a_folder_with_a_design"
    ),
    "start one without --resume, or give its folder (-o)": "test_nothing_to_resume",
    "see `hil design --show-settings gradient`": "test_settings_that_are_none",
    "design it again (`hil design`)": "test_a_design_that_was_edited",
    "run `hil rehearse FIELD`": "test_each_refusal_names_the_next_command",
    "the arm is simulated: accept it with `FIELD --accept-dry-run`":
        "test_a_simulated_arm_needs_no_dry_run",
    "if the motions looked right, run `FIELD --accept-dry-run`":
        "test_each_refusal_names_the_next_command",
    "`FIELD --accept-dry-runFIELD`": "test_each_refusal_names_the_next_command",
    "run {} --accept-dry-runFIELD": "test_status_names_each_command",
    "run FIELD --dry-run": "test_status_names_each_command",
    "rehearse FIELD --again": "test_a_damaged_rehearsal",
    "rehearse again (`hil rehearse FIELD --again`)": "test_a_damaged_rehearsal",
    "restore it, or rehearse again (`hil rehearse FIELD`)": "test_a_cell_edited_after_it",
    "run --dry-run first, watch the arm, then --accept-dry-run": "test_both_at_once",
    "if you know that the arm is right": "test_a_torque_against_gravity",
    "--accept-torque FIELD": "test_a_torque_against_gravity",
    'state it, for example --precision "parameters 5 %, torque 10"': "test_no_precision",
    "add --until-precise": "test_a_precision_without_an_end",
    "omit --workers, or --scheduler": "test_workers_of_a_cluster",
    "make room, or choose another folder with --cache, or none": "test_a_cache_that_is_no_folder",
    "resume with the same cell and settings, or start again (--force)":
        "test_another_cell_than_that_of_the_search",
    "give a file that `hil design` wrote": "test_the_name_of_no_design",
    "for a payload add --for payload": "test_the_mass_of_a_payload",
    "FIELD; no motion of this arm can meet it": "test_a_torque_of_uncertain_scale",
    "FIELD % of each joint's torque; recordings measure it (--given)":
        "test_an_assumed_torque_error",
    "no more repetitions; another motion adds": "test_a_precision_out_of_reach",
    "run it with --payload NAME": "test_the_mass_of_a_payload_of_a_campaign",
    "run the campaign that it was copied from": "test_a_copy_of_a_loaded_side",
    "begin a new campaign folder (`hil design`)": "test_a_link_to_another_kind_of_arm",
    "design a better excitation (`hil design`)": "test_an_excitation_that_determines_too_little",
    "FIELD workers of Dask did not start": "test_workers_that_do_not_start",
    "give --joint and --by": "test_an_axis_alone_without_a_joint",
    "leave it out, or run against `hil simulate`": "test_a_live_view_in_virtual_time",
}  # fmt: skip
ELSEWHERE = {  # files below tests/hil, and what no test can type
    "run `FIELD --dry-run`": "campaign/runs/test_dry_run.py, of a real arm",
    "find the torque constants with `hil torque-constants`": "importers/test_importers.py",
    "hil run FIELD --payload FIELD": "weighing/test_payload_campaign.py",
    "stopped before the end of the search": "design/test_design_command.py, interrupted",
    "repeat with --resume to draw it": "a picture on a full disk",
    "free disk space": "tests/disk",
    "the FIELD joints form FIELD arms": "design/test_settings.py",
    "add --urdf ARM.urdf": "identified/test_one_command.py",
    "describe the arm of logs and bags": "fleet/test_logs.py",
    "centre of mass of the payload (--payload-centre) may be": "weighing/test_payload_campaign.py",
    "weigh it under another name (--payload)": "weighing/test_payload_campaign.py",
    "add --for payload": "precision/test_precision.py",
    "add --kind FIELD": "control/test_record_command.py",
    "give one of --udp, --can and --link": "control/test_simulate.py",
    "leave --priority out, or raise the limit": "a user without the right to a priority",
    "or add --link rtde:HOST": "control/test_ur_recording.py",
    "by chance: `--again --seed 2` shows which": "an error that one rehearsal in a thousand has",
}


def commands(text: str) -> list[list[str]]:
    """Words behind `hil` of the commands in backticks, and of that behind "next:"."""
    lines = re.findall(r"`hil ([^`]+)`", text) + re.findall(r"next: hil (.+)", text)
    return [shlex.split(line) for line in lines]


def type_printed(text: str) -> str:
    """Type the last command that a message names; it has to succeed. Return what it prints."""
    *_, words = commands(text)
    result = typed(*words)
    assert result.exit_code == 0, (words, message(result))
    return result.output


def refusal(*words: object) -> str:
    """Type what is refused, and return its message."""
    result = typed(*words)
    assert result.exit_code != 0, message(result)
    return message(result)


def accepted(*words: object) -> str:
    result = typed(*words)
    assert result.exit_code == 0, message(result)
    return message(result)


DESIGN = ("design", "cell.toml", "--settings", "quick.toml")
PRECISE = ("design", "cell.toml", "--workers", 1, "--settings", "gradient.toml")


@pytest.fixture(scope="module")
def template(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a cell, settings of a short search, and a design of it."""
    folder = tmp_path_factory.mktemp("template")
    fast_cell(folder, repetitions=2)
    (folder / "quick.toml").write_text(QUICK)
    (folder / "gradient.toml").write_text(QUICK_GRADIENT)
    with pytest.MonkeyPatch.context() as inside:
        inside.chdir(folder)
        accepted(*DESIGN, "-o", "my runs/a")
    return folder


@pytest.fixture
def here(template: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    shutil.copytree(template, tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def designed(here: Path) -> Path:
    return here / "my runs" / "a"


@pytest.fixture
def rehearsed(designed: Path) -> Path:
    pass_rehearsal(CampaignFolder(designed))
    return designed


class TestDesign:
    def test_a_folder_with_a_design(self, designed: Path) -> None:
        assert "(--resume)" in refusal(*DESIGN, "-o", designed)
        for options in (["-o", designed, "--resume"], ["-o", "b"], ["-o", designed, "--force"]):
            accepted(*DESIGN, *options)

    def test_nothing_to_resume(self, designed: Path) -> None:
        assert "without --resume" in refusal(*DESIGN, "-o", "b", "--resume")
        accepted(*DESIGN, "-o", designed, "--resume")
        accepted(*DESIGN, "-o", "b")

    def test_settings_that_are_none(self, here: Path) -> None:
        (here / "none.toml").write_text("population =")
        text = refusal("design", "cell.toml", "--settings", "none.toml", "-o", "b")
        assert "population" in tomllib.loads(type_printed(text))["search"]

    def test_a_design_that_was_edited(self, designed: Path, here: Path) -> None:
        file = designed / "excitation.toml"
        file.write_text(file.read_text().replace("generations = 3", "generations = 4"))
        with pytest.raises(InputError, match="design it again"):
            DesignResult.load(file)
        accepted(*DESIGN, "-o", designed, "--force")
        DesignResult.load(file)

    def test_another_cell_than_that_of_the_search(self, designed: Path, here: Path) -> None:
        cell = here / "cell.toml"
        before = cell.read_text()
        cell.write_text(before.replace("[400.0, 400.0]", "[300.0, 300.0]"))
        text = refusal(*DESIGN, "-o", designed, "--resume")
        assert "resume with the same cell and settings, or start again (--force)" in text
        cell.write_text(before)
        accepted(*DESIGN, "-o", designed, "--resume")
        cell.write_text(before.replace("[400.0, 400.0]", "[300.0, 300.0]"))
        accepted(*DESIGN, "-o", designed, "--force")

    def test_the_name_of_no_design(self, designed: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr("hil.cli.demo.CELL_PATH", designed / "cell.toml")
        line = ("demo", "--repetitions", 2, "--validation", 1, "-o", "shown", "--excitation")
        assert "give a file that `hil design` wrote" in refusal(*line, "absent.toml")
        accepted(*line, designed / "excitation.toml")

    def test_the_mass_of_a_payload(self, here: Path) -> None:
        line = (*PRECISE, "--precision", "mass of payload 5 %", "-o", "b")
        text = refusal(*line)
        (options,) = re.findall(r"add (--for payload)", text)
        assert "mass of payload 5 %" in accepted(*line, *options.split())
        line = (*PRECISE, "--precision", "parameters 50 %", "-o", "c")
        assert "for the arm omit --for payload" in refusal(*line, "--for", "payload")
        accepted(*line)

    def test_a_torque_of_uncertain_scale(self, here: Path) -> None:
        """Of a load that is weighed see `tests/hil/payload/test_payload_command.py`."""
        cell = here / "cell.toml"
        before = cell.read_text()
        scale = "[drive_train]\ntorque_uncertainty = {}"
        line = (*PRECISE, "--precision", "parameters 5 % absolute", "-o")
        cell.write_text(before.replace("[drive_train]", scale.format(0.04)))
        own = (*PRECISE, "--precision", "parameters 5 %", "-o")
        assert "no motion of this arm can meet it" not in accepted(*own, "a")
        assert "no motion of this arm can meet it" in accepted(*line, "b")
        cell.write_text(before.replace("[drive_train]", scale.format(0.004)))
        assert "no motion of this arm can meet it" not in accepted(*line, "c")


@pytest.fixture(scope="module")
def repeated(template: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """A campaign that was run until more repetitions do not help, and what was printed."""
    folder = tmp_path_factory.mktemp("repeated")
    fast_campaign(folder / "two words", fast_cell(folder, repetitions=6))
    precision = ("--until-precise", "--precision", "parameters 0.01 %")
    text = accepted("run", folder / "two words", "--accept-dry-run", *precision)
    return folder / "two words", text


def pass_both_rehearsals(campaign: Path, text: str) -> None:
    """Of the sides of the payload campaign whose refused start printed the text."""
    assert "hil rehearse" in text
    for side in SIDES:
        pass_rehearsal(CampaignFolder(campaign / "payload" / "gripper" / side))


class TestPrecision:
    def test_an_assumed_torque_error(self, here: Path, repeated: tuple[Path, str]) -> None:
        """Of a real arm: that of a simulated one is known."""
        cell = fast_cell(here, repetitions=2).with_values({"controller.transport": "udp"})
        (here / "udp.toml").write_text(cell.text)
        line = ("design", "udp.toml", *PRECISE[2:], "--precision", "parameters 50 %", "-o")
        assumed = " ".join(accepted(*line, "b").split())
        assert "recordings measure it (--given)" in assumed
        text = " ".join(accepted(*line, "c", "--given", repeated[0]).split())
        assert "of the given recordings" in text and "(--given)" not in text

    def test_a_precision_out_of_reach(self, here: Path, repeated: tuple[Path, str]) -> None:
        root, text = repeated
        assert "(hil design --given, with the same --precision)" in text
        same = ("--precision", "parameters 0.01 %")
        accepted(*PRECISE, "--given", root, *same, "-o", "b")

    def test_the_mass_of_a_payload_of_a_campaign(self, rehearsed: Path) -> None:
        mass = ("--until-precise", "--precision", "mass of payload 10 %")
        text = refusal("run", rehearsed, *mass)
        assert "run it with --payload NAME" in text
        line = ("run", rehearsed, "--payload", "gripper", "--payload-mass", 2, *mass)
        pass_both_rehearsals(rehearsed, refusal(*line))
        assert "no more pairs" in accepted(*line, "--accept-dry-run")


class TestCampaign:
    def test_status_names_each_command(self, designed: Path) -> None:
        """From a design to its report."""
        text = accepted("status", designed)
        names = []
        while "next: hil" in text:
            *_, words = commands(text)
            names.append([word for word in words if word != str(designed)])
            assert len(names) < 9, names
            accepted(*words)
            text = accepted("status", designed)
        run = [["run", "--dry-run"], ["run", "--accept-dry-run"]]
        assert names[0] == ["rehearse"] and names[1:3] == run, names
        assert (designed / "report.html").exists()

    def test_each_refusal_names_the_next_command(self, designed: Path) -> None:
        type_printed(refusal("run", designed))
        accepted("run", designed, "--dry-run")
        type_printed(refusal("run", designed))
        assert (designed / "results.json").exists()

    def test_a_simulated_arm_needs_no_dry_run(self, rehearsed: Path) -> None:
        type_printed(refusal("run", rehearsed))
        assert (rehearsed / "results.json").exists()

    def test_a_cell_edited_after_it(self, designed: Path) -> None:
        accepted("rehearse", designed)
        cell = designed / "cell.toml"
        before = cell.read_text()
        cell.write_text(before.replace("repetitions = 2", "repetitions = 3"))
        text = refusal("run", designed, "--dry-run")
        type_printed(text)
        cell.write_text(before)
        accepted("rehearse", designed)
        accepted("run", designed, "--dry-run")

    def test_a_damaged_rehearsal(self, designed: Path) -> None:
        accepted("rehearse", designed)
        for ask in (lambda: accepted("status", designed), lambda: refusal("run", designed)):
            (designed / "rehearsal.json").write_text("{")
            type_printed(ask())

    def test_an_axis_alone_without_a_joint(self, here: Path) -> None:
        assert "give --joint and --by" in refusal(
            "move", "cell.toml", "--to", "start", "--only-axis"
        )
        way = ("--joint", "elbow", "--by", 2)
        accepted("move", "cell.toml", "--only-axis", *way, "--yes", "-o", "moved")

    def test_a_live_view_in_virtual_time(self, rehearsed: Path) -> None:
        text = refusal("run", rehearsed, "--dry-run", "--live", 8765)
        assert "leave it out" in text
        accepted("run", rehearsed, "--dry-run")

    def test_both_at_once(self, rehearsed: Path) -> None:
        text = refusal("run", rehearsed, "--dry-run", "--accept-dry-run")
        assert "run --dry-run first, watch the arm, then --accept-dry-run" in text
        accepted("run", rehearsed, "--dry-run")
        accepted("run", rehearsed, "--accept-dry-run")

    def test_a_torque_against_gravity(self, here: Path) -> None:
        fast_campaign(here / "m", mirrored(fast_cell(here), "[-1, 1]"))
        text = refusal("run", "m", "--accept-dry-run")
        assert "--accept-torque" in text
        accepts = [words for words in commands(text) if "--accept-torque" in words]
        typed(*accepts[-1])
        assert (here / "m" / "results.json").exists()

    def test_a_copy_of_a_loaded_side(self, rehearsed: Path, here: Path) -> None:
        line = ("run", rehearsed, "--payload", "gripper", "--payload-mass", 2, "--dry-run")
        pass_both_rehearsals(rehearsed, refusal(*line))
        shutil.copytree(rehearsed / "payload" / "gripper" / "loaded", here / "copy")
        text = refusal("run", "copy", "--dry-run")
        assert "run the campaign that it was copied from, with --payload" in text
        accepted(*line)

    def test_a_link_to_another_kind_of_arm(self, here: Path) -> None:
        """A script ran the campaign of a real arm on a simulated one."""
        cell = fast_cell(here).with_values({"controller.transport": "udp"})
        real = fast_campaign(here / "real", cell)
        simulated = simulated_link(cell, instead_of_hardware=True)
        real.run(simulated, dry_run_only=True, provenance={"simulated": "yes"})
        text = refusal("run", "real", "--dry-run")
        assert "begin a new campaign folder (`hil design`)" in text
        (here / "udp.toml").write_text(cell.text)
        accepted("design", "udp.toml", "--settings", "quick.toml", "-o", "b")
        assert "next: hil rehearse b" in accepted("status", "b")

    def test_an_excitation_that_determines_too_little(
        self, designed: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        with monkeypatch.context() as strict:
            strict.setattr("hil.campaign.rehearsal_criteria.MAX_ERROR_RATIO", 0.0)
            text = refusal("rehearse", designed)
        assert "design a better excitation (`hil design`)" in text
        accepted(*DESIGN, "-o", "b")
        accepted("rehearse", "b")

    def test_no_precision(self, rehearsed: Path) -> None:
        text = refusal("run", rehearsed, "--until-precise")
        (example,) = re.findall(r"for example (--precision \".*\")", text)
        accepted("run", rehearsed, "--dry-run")
        accepted("run", rehearsed, "--accept-dry-run", "--until-precise", *shlex.split(example))

    def test_a_precision_without_an_end(self, rehearsed: Path) -> None:
        precise = ("run", rehearsed, "--precision", "parameters 50 %")
        assert "add --until-precise" in refusal(*precise)
        accepted("run", rehearsed, "--dry-run")
        accepted(*precise, "--until-precise", "--accept-dry-run")


class TestBatch:
    @pytest.fixture
    def folder(self, here: Path) -> Path:
        fast_campaign(here / "all runs" / "a", fast_cell(here, repetitions=1))
        accepted("run", here / "all runs" / "a", "--accept-dry-run")
        return here / "all runs"

    def test_workers_of_a_cluster(self, folder: Path) -> None:
        text = refusal("batch", folder, "--workers", 1, "--scheduler", "tcp://127.0.0.1:9")
        assert "omit --workers, or --scheduler" in text
        accepted("batch", folder, "--workers", 1)

    def test_a_cache_that_is_no_folder(self, folder: Path, here: Path) -> None:
        (here / "cache").write_text("")
        text = refusal("batch", folder, "--cache", here / "cache")
        assert "choose another folder with --cache, or none" in text
        accepted("batch", folder, "--cache", here / "other")
        accepted("batch", folder, "--cache", "none")

    def test_workers_that_do_not_start(self, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        """As where memory or processes are limited."""

        def limited(n_workers: int, **options: Any) -> LocalCluster:
            if n_workers > 1:
                raise RuntimeError("Nanny failed to start.")
            return LocalCluster(n_workers=n_workers, **options)

        monkeypatch.setattr("distributed.LocalCluster", limited)
        text = refusal("batch", folder, "--workers", 2)
        assert "2 workers of Dask did not start" in text and "fewer with --workers" in text
        accepted("batch", folder, "--workers", 1)

    def test_parameters_that_are_poorly_separated(
        self, folder: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        for module in ("batch.estimates", "pipeline.estimating"):
            monkeypatch.setattr(f"hil.{module}.MAX_GRAM_CONDITION", 1.0)
        text = accepted("batch", folder, "--estimator", "wls")
        assert "`hil identify` on these archives uses QR" in text
        accepted("identify", folder / "a", "--estimator", "wls")

    def test_more_campaigns_than_are_shown(
        self, folder: Path, here: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr("hil.cli.batch._MAX_LINES", 0)
        assert "1 more: see --output and --json" in accepted("batch", folder)
        accepted("batch", folder, "--output", "tables")
        assert list((here / "tables").glob("*.csv"))
        printed = json.loads(typed("batch", folder, "--json").stdout)
        assert printed["arms"].popitem()[1]["campaigns"]


def remedies() -> Iterator[tuple[str, str]]:
    """Messages of these packages that name a command or an option to type."""
    for place, text in messages():
        names_command = COMMAND.search(text) or "`hil " in text
        is_label = re.fullmatch(r" ?--[a-z-]+", text) or text.startswith(
            ("#", FIELD + ", for `hil")
        )
        is_comment = "can read them from" in text or "names of parameters as" in text
        is_problem = text.startswith("--")
        if is_label or is_comment or is_problem or not PACKAGES.match(place):
            continue
        if names_command or OPTION.search(text):
            yield place, text


def test_every_remedy_is_typed() -> None:
    missing = [
        f"{place}: {text}"
        for place, text in remedies()
        if not any(part in text for part in (*TYPED, *ELSEWHERE))
    ]
    assert not missing, "\n".join(missing)


def test_every_test_and_message_of_the_table_exists() -> None:
    groups = (TestDesign, TestPrecision, TestCampaign, TestBatch)
    tests = {name for group in groups for name in vars(group)}
    texts = [text for _, text in remedies()]
    assert {*TYPED.values()} <= tests
    stale = [part for part in (*TYPED, *ELSEWHERE) if not any(part in text for text in texts)]
    assert not stale, stale
