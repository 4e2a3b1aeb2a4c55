"""`hil run --payload`: a payload weighed by a campaign, bare, loaded, loaded, bare."""

from __future__ import annotations

import json
import re
import shlex
import shutil
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from drivers.transports.simulated import SimulatedTransport
from hil.archive import open_archive
from hil.base.errors import InputError, OperatorStopError
from hil.base.progress import Silent
from hil.campaign import Campaign, CampaignFolderError, MotionRefusedError, NotRehearsedError
from hil.campaign.campaign import require_replaceable
from hil.campaign.campaign_run import RunResult
from hil.campaign.errors import RepetitionsRejectedError
from hil.campaign.folder import SIDES, CampaignFolder
from hil.cli import app
from hil.control.errors import MotionFailedError
from hil.control.motion_watch import OperatorRequest, Stop
from hil.control.planted_arm import carried, planted_truth
from hil.control.simulated_cell import simulated_controller
from hil.control.virtual_link import VirtualLink
from hil.payload.payload_run import find_payload
from hil.precision.requirements import requirements_from
from hil.weighing.messages import weighed_lines
from hil.weighing.payload_campaign import (
    MountingError,
    PayloadCampaign,
    PayloadMounting,
    assumed_payload,
    loaded_cell,
)
from hil.weighing.weighed import Weighed
from identification.estimators.payload_estimate import PayloadError
from identification.model.known_payload import Payload
from tests.hil.fast_cell import fast_campaign, fast_cell, pass_rehearsal
from tests.messages import COPY_OF_LOADED_SIDE, PAYLOAD_NAME_INVALID

pytestmark = pytest.mark.safety

MASS = 2.0
CENTRE = (0.3, 0.0, 0.05)
ASSUMED = 2.5
ORDER = ["bare 1", "loaded 1", "loaded 2", "bare 2"]


class Heard(Silent):
    """Keeps what is said."""

    def __init__(self) -> None:
        self.lines: list[str] = []

    def say(self, text: str) -> None:
        self.lines.append(text)


def campaign_in(folder: Path, repetitions: int = 6) -> Campaign:
    cell = fast_cell(folder, repetitions=repetitions)
    # The controller does not know the load: the arm sags a little when it is released.
    cell = cell.with_values({"simulation.friction_drift": 0.0, "campaign.settle_s": 0.5})
    return fast_campaign(folder / "weigh", cell)


def begun(campaign: Campaign, name: str = "weight") -> PayloadCampaign:
    assumed = assumed_payload(campaign.cell, ASSUMED, CENTRE)
    return PayloadCampaign.of(campaign, name, assumed)


def true_link(side: Campaign, session: int) -> VirtualLink:
    """The arm carries another mass than is assumed, in the loaded side only."""
    cell = side.cell
    load = Payload(MASS, CENTRE, (0.004, 0.0, 0.0, 0.006, 0.0, 0.005))
    is_loaded = cell.model.payload is not None
    truth = replace(planted_truth(cell), carried=carried(cell, load) if is_loaded else None)
    controller = simulated_controller(cell, truth=truth, session=session)
    return VirtualLink.over(SimulatedTransport(controller), cell, finish=controller.finish)


def execute(side: Campaign, choices: Mapping[str, Any]) -> RunResult:
    return side.run(**choices)


def run(weighed: PayloadCampaign, execute=execute, reporter=None, **more: Any) -> Weighed:
    reporter = reporter or Silent()
    mounting = PayloadMounting(weighed, reporter)
    return weighed.run(
        execute, mounting, reporter, links=true_link, choices={"unrehearsed": True}, **more
    )


def recorded(weighed: PayloadCampaign) -> list[str]:
    """Complete repetitions of both sides, such as "bare 1"."""
    return sorted(
        f"{side} {index + 1}"
        for side in SIDES
        for index in range(9)
        if CampaignFolder(weighed.root / side).complete_archive("excitation", index) is not None
    )


@pytest.fixture(scope="module")
def designed(tmp_path_factory: pytest.TempPathFactory) -> Campaign:
    return campaign_in(tmp_path_factory.mktemp("designed"))


@pytest.fixture(scope="module")
def reported() -> list[bool]:
    """Whether each run of `done` was to report what is not checked for collisions."""
    return []


@pytest.fixture(scope="module")
def done(designed: Campaign, reported: list[bool]) -> tuple[PayloadCampaign, Weighed, list[str]]:
    weighed = begun(designed)
    order: list[str] = []

    def noting(side: Campaign, choices: Mapping[str, Any]) -> RunResult:
        before = recorded(weighed)
        reported.append(choices["say_unchecked"])
        result = execute(side, choices)
        order.extend(path for path in recorded(weighed) if path not in before)
        return result

    return weighed, run(weighed, noting), order


class TestRecording:
    def test_the_motion_runs_bare_loaded_loaded_bare(self, done) -> None:
        _, payload, order = done
        assert order == ORDER
        assert payload.pairs == 2

    @pytest.mark.usefixtures("done")
    def test_what_is_not_checked_is_reported_once(self, reported: list[bool]) -> None:
        assert len(reported) > 2
        assert reported == [True, *[False] * (len(reported) - 1)]

    def test_the_carried_mass_is_found_and_not_the_assumed_one(self, done) -> None:
        _, payload, _ = done
        low, high = payload.payload.estimate.intervals[0]
        assert low < MASS < high < ASSUMED
        assert high - low < 0.05 * MASS

    def test_headers_say_which_recordings_were_loaded_and_by_what(self, done) -> None:
        weighed, _, _ = done
        for side, name in ((weighed.bare, ""), (weighed.loaded, "weight")):
            paths = [path for path in side.folder.archives.iterdir() if path.suffix == ".mcap"]
            assert {open_archive(path).header.payload for path in paths} == {name}

    def test_the_result_is_stored_as_hil_payload_prints_it(self, done) -> None:
        weighed, payload, _ = done
        stored = json.loads((weighed.root / "payload.json").read_text())
        assert stored["figures"]["mass"]["value"] == pytest.approx(payload.payload.body.mass)
        text = (weighed.root / "payload.txt").read_text()
        assert text == "\n".join(weighed_lines(payload)) + "\n"
        assert "$TOOL_MASS := 1." in text or "$TOOL_MASS := 2." in text
        printed = CliRunner().invoke(
            app,
            [
                "payload",
                str(weighed.bare.folder.root),
                "--loaded",
                str(weighed.loaded.folder.root),
                "-v",
            ],
        )
        assert printed.stdout.split() == text.split()

    def test_the_status_of_a_weighing_asks_for_nothing(self, designed, done) -> None:
        status = designed.status()
        assert (status.weighed, status.weighing) == (("weight",), ())
        assert status.next_command == ""
        printed = CliRunner().invoke(app, ["status", str(designed.folder.root)]).stdout
        last = printed.splitlines()[-1]
        assert last.startswith("weighed: weight (in payload/); nothing is missing. To identify")

    def test_nothing_is_recorded_again(self, designed, done) -> None:
        _, payload, _ = done

        def never(*_: object) -> RunResult:
            pytest.fail("nothing was missing")

        again = PayloadCampaign.of(designed, "weight", None)
        assert run(again, never).payload.body.mass == payload.payload.body.mass

    def test_an_identification_of_the_loaded_side_warns(self, done) -> None:
        """What the assumed payload is wrong by is in the last link."""
        weighed, _, _ = done
        warnings = weighed.loaded.identify().results.verdict.warnings
        assert any("mass and centre of the payload are assumed" in warning for warning in warnings)


class TestInterrupted:
    @pytest.mark.usefixtures("shown_in_virtual_time")
    @pytest.mark.parametrize("stage", range(4), ids=ORDER)
    def test_a_stop_in_each_stage_is_resumed(self, tmp_path, stage: int) -> None:
        """Ctrl-C brings the arm to rest on its path; complete recordings stay."""
        campaign = campaign_in(tmp_path, repetitions=2)
        weighed = begun(campaign)
        stop = Stop()

        class Stopping:
            """Stops in the repetition of a stage, as soon as more than 100 cycles are done."""

            can_answer = False

            def show(self, status) -> None:
                moving = status.motion is not None and status.motion.cycles > 100
                if status.phase == "repetition" and moving and len(recorded(weighed)) == stage:
                    stop.requested = True

            def request(self):
                return OperatorRequest()

        def stopping(side: Campaign, choices: Mapping[str, Any]) -> RunResult:
            return side.run(stop=stop, operator=Stopping(), **choices)

        with pytest.raises(MotionFailedError, match="stopped"):
            run(weighed, stopping)
        complete = recorded(weighed)
        assert complete == sorted(ORDER[:stage])
        payload = run(PayloadCampaign.of(Campaign.open(campaign.folder.root), "weight", None))
        assert recorded(weighed) == sorted(ORDER)
        assert payload.payload.body.mass == pytest.approx(MASS, rel=0.03)
        attempts = [path.name for path in weighed.root.glob("*/archives/excitation*")]
        assert sum("_a2" in name for name in attempts) == 1

    @pytest.mark.parametrize("stage", range(4), ids=ORDER)
    def test_a_kill_in_each_stage_loses_nothing(self, tmp_path, monkeypatch, stage: int) -> None:
        """Killed between the end of a recording and its entry in the manifest."""
        campaign = campaign_in(tmp_path, repetitions=2)
        weighed = begun(campaign)
        enter = CampaignFolder.add

        def killed(folder: CampaignFolder, name: str, *rest: str) -> None:
            if name.startswith("excitation") and len(recorded(weighed)) == stage:
                raise SystemExit(137)
            enter(folder, name, *rest)

        with monkeypatch.context() as patched:
            patched.setattr(CampaignFolder, "add", killed)
            with pytest.raises(SystemExit):
                run(weighed)
        assert recorded(weighed) == sorted(ORDER[:stage])
        run(PayloadCampaign.of(Campaign.open(campaign.folder.root), "weight", None))
        assert recorded(weighed) == sorted(ORDER)
        attempts = [path.name for path in weighed.root.glob("*/archives/excitation*")]
        assert not any("_a2" in name for name in attempts)


class TestPrecision:
    def test_it_ends_when_the_mass_is_precise(self, designed) -> None:
        heard = Heard()
        found = run(
            begun(designed, "loose"),
            reporter=heard,
            requirements=requirements_from(["mass of payload 10 %"]),
        )
        assert found.pairs == 2
        assert found.precision.outcome == "met"
        assert any("precision after 2 pairs: mass" in line for line in heard.lines)
        assert "no more pairs" in weighed_lines(found)[-1]

    def test_it_ends_when_more_pairs_do_not_help(self, designed) -> None:
        weighed = begun(designed, "strict")
        found = run(weighed, requirements=requirements_from(["mass of payload 0.01 %"]))
        assert found.precision.outcome in ("out of reach", "limit")
        assert found.pairs == 3
        assert recorded(weighed) == sorted([*ORDER, "bare 3", "loaded 3"])

    def test_a_first_pair_that_determines_nothing_is_not_the_last(
        self, designed, monkeypatch
    ) -> None:
        """One pair can be too few; the next one is run, and the mass is estimated from both."""

        def of_two_pairs(bare, loaded, reporter):
            if sum("excitation" in path.name for path in loaded) < 2:
                raise PayloadError("the motion does not separate the mass from other parameters")
            return find_payload(bare, loaded, reporter)

        monkeypatch.setattr("hil.weighing.payload_campaign.find_payload", of_two_pairs)
        heard = Heard()
        weighed = begun(designed, "early")
        found = run(
            weighed, reporter=heard, requirements=requirements_from(["mass of payload 10 %"])
        )
        assert any("after 1 pair: the mass is not determined yet" in line for line in heard.lines)
        assert [look.repetitions for look in found.precision.looks] == [2, 3]
        assert found.precision.outcome == "met"

    def test_pairs_that_determine_nothing_end_with_the_reason(self, designed, monkeypatch) -> None:
        def none(bare, loaded, reporter):
            raise PayloadError("the motion does not separate the mass from other parameters")

        monkeypatch.setattr("hil.weighing.payload_campaign.find_payload", none)
        weighed = begun(designed, "never")
        with pytest.raises(PayloadError, match="does not separate"):
            run(weighed, requirements=requirements_from(["mass of payload 10 %"]))
        assert recorded(weighed) == sorted(ORDER)

    def test_other_requirements_are_refused(self, designed) -> None:
        with pytest.raises(InputError, match="not about the payload"):
            run(begun(designed, "other"), requirements=requirements_from(["torque 2"]))


class TestMounting:
    @pytest.fixture
    def real(self, tmp_path) -> PayloadCampaign:
        """A cell with a real link: nothing mounts by itself."""
        cell = fast_cell(tmp_path).with_values({"controller.transport": "udp"})
        return begun(fast_campaign(tmp_path / "weigh", cell))

    def test_without_a_terminal_it_names_the_next_command(self, real) -> None:
        mounting = PayloadMounting(real, Silent(), mounted=False)
        mounting.require(False)
        command = r"Mount weight.*--payload weight --mounted yes --dry-run`"
        with pytest.raises(MountingError, match=command):
            mounting.require(True, "--dry-run")
        assert MountingError.exit_code == 3

    @pytest.mark.parametrize(("asks", "ending"), [(False, "weight --mounted no"), (True, "weight")])
    def test_messages_of_a_side_confirm_what_nobody_is_asked(self, real, asks, ending) -> None:
        ask = (lambda _: True) if asks else None
        mounting = PayloadMounting(real, Silent(), ask=ask, mounted=None if asks else False)
        commands: list[str] = []
        real.dry_run(
            lambda side, _: commands.append(side.folder.run_command),  # type: ignore[arg-type]
            mounting,
            {},
        )
        assert [command.endswith(ending) for command in commands] == [True]

    def test_the_operator_is_asked_only_where_it_changes(self, real) -> None:
        asked: list[str] = []

        def ask(demand: str) -> bool:
            asked.append(demand)
            return True

        mounting = PayloadMounting(real, Silent(), ask=ask)
        for loaded in (False, True, True, False):
            mounting.require(loaded)
        assert [one.split()[0] for one in asked] == ["Remove", "Mount", "Remove"]

    def test_another_answer_stops_and_names_the_command(self, real) -> None:
        mounting = PayloadMounting(real, Silent(), ask=lambda _: False)
        with pytest.raises(OperatorStopError, match=r"resume with `hil run .* --payload weight`"):
            mounting.require(True)


class TestLimits:
    def test_a_load_beyond_a_limit_is_refused_at_once(self, designed) -> None:
        heavy = assumed_payload(designed.cell, 60.0, CENTRE)
        with pytest.raises(MotionRefusedError, match=r"60 kg.*motor.*--for payload"):
            PayloadCampaign.of(designed, "heavy", heavy)
        assert not (designed.folder.root / "payload" / "heavy").exists()

    def test_the_rehearsal_of_the_loaded_side_carries_the_payload(self, tmp_path) -> None:
        weighed = begun(campaign_in(tmp_path, repetitions=2))
        weighed.rehearse(Silent(), Stop())
        for side in (weighed.bare, weighed.loaded):
            passed = [step for step in side.status().steps if step.name == "rehearse"]
            assert passed[0].done, passed[0].sentence

    def test_a_tool_of_the_cell_is_carried_as_well(self, tmp_path) -> None:
        cell = fast_cell(tmp_path).with_values(
            {"robot.payload.mass": 1.0, "robot.payload.centre": [0.1, 0.0, 0.0]}
        )
        both = loaded_cell(cell, "weight", assumed_payload(cell, 3.0, (0.3, 0.0, 0.0)))
        payload = both.model.payload
        assert payload.mass == pytest.approx(4.0)
        assert payload.centre == pytest.approx((0.25, 0.0, 0.0))

    def test_another_assumed_mass_needs_another_name(self, designed, done) -> None:
        other = assumed_payload(designed.cell, 1.0, CENTRE)
        with pytest.raises(CampaignFolderError, match="another name"):
            PayloadCampaign.of(designed, "weight", other)

    def test_a_rejected_loaded_motion_says_what_was_stated(self, designed) -> None:
        weighed = begun(designed, "saturating")

        def rejecting(side: Campaign, choices: Mapping[str, Any]) -> RunResult:
            if side.cell.model.payload is None:
                return execute(side, choices)
            raise RepetitionsRejectedError("repetition 1", ["the current was at its limit"])

        expected = r"at its limit; .*saturating as --payload-mass and --payload-centre stated it"
        with pytest.raises(RepetitionsRejectedError, match=expected):
            run(weighed, rejecting)


class TestChanged:
    def test_an_edited_cell_of_the_campaign_is_refused(self, tmp_path) -> None:
        campaign = campaign_in(tmp_path)
        begun(campaign)
        path = campaign.folder.cell
        path.write_text(path.read_text() + "\n# edited\n")
        with pytest.raises(NotRehearsedError, match="was edited"):
            PayloadCampaign.of(campaign, "weight", None)

    def test_a_loaded_side_with_another_cell_is_refused(self, tmp_path) -> None:
        """Its motion would run within the limits of the cell of then."""
        weighed = begun(campaign_in(tmp_path))
        cell = fast_cell(tmp_path, repetitions=6).with_values({"campaign.settle_s": 0.6})
        other = fast_campaign(tmp_path / "other", cell)
        shutil.copytree(weighed.root, other.folder.root / "payload" / "weight")
        with pytest.raises(CampaignFolderError, match="begun with another cell"):
            PayloadCampaign.of(other, "weight", None)

    def test_a_design_does_not_replace_a_campaign_with_payloads(self, tmp_path) -> None:
        weighed = begun(campaign_in(tmp_path))
        with pytest.raises(CampaignFolderError, match="payload campaigns"):
            require_replaceable(weighed.root.parent.parent)

    def test_a_loaded_side_on_a_link_is_never_mounted_by_itself(self, tmp_path) -> None:
        weighed = begun(campaign_in(tmp_path))
        link = {"controller.transport": "udp", "controller.host": "192.0.2.1"}
        real = weighed.loaded.cell.with_values(link)
        mixed = replace(weighed, loaded=replace(weighed.loaded, cell=real))
        with pytest.raises(MountingError, match="Mount weight"):
            PayloadMounting(mixed, Silent()).require(True)


def invoke(root: Path, *words: str):
    return CliRunner().invoke(app, ["run", str(root), *words], catch_exceptions=False)


STATED = ("--payload", "gripper", "--payload-mass", "2", "--payload-centre", "0.3,0,0.05")


class TestCommand:
    def test_each_gate_names_the_next_command_to_the_end(self, tmp_path) -> None:
        campaign = campaign_in(tmp_path, repetitions=2)
        root = campaign.folder.root
        with pytest.raises(NotRehearsedError, match=r"hil rehearse .*payload/gripper/bare"):
            invoke(root, *STATED)
        for side in SIDES:
            pass_rehearsal(CampaignFolder(root / "payload" / "gripper" / side))
        result = invoke(root, "--payload", "gripper", "--dry-run")
        assert result.exit_code == 0
        assert "--payload gripper --accept-dry-run" in result.output.replace("\n", " ")
        result = invoke(root, "--payload", "gripper", "--accept-dry-run", "--json")
        assert result.exit_code == 0, result.output
        found = json.loads(result.stdout)
        low, high = found["figures"]["mass"]["interval"]
        assert low < 2.0 < high
        assert found["pairs"] == 2

    def test_without_a_terminal_each_printed_command_leads_on(self, tmp_path, monkeypatch) -> None:
        """Typed as it is printed, from the first dry run to the weighed payload."""

        class OfRealArm(PayloadMounting):
            def __init__(self, *arguments, **options) -> None:
                super().__init__(*arguments, **options)
                self._virtual = False

        monkeypatch.setattr("hil.cli.weigh.PayloadMounting", OfRealArm)
        root = campaign_in(tmp_path, repetitions=2).folder.root
        begun(Campaign.open(root), "gripper")
        for side in SIDES:
            pass_rehearsal(CampaignFolder(root / "payload" / "gripper" / side))
        words = ["--payload", "gripper", "--mounted", "no", "--dry-run"]
        typed = []
        while words:
            typed.append(words[2:])
            try:
                printed = invoke(root, *words).output.replace("\n", " ")
            except MountingError as error:
                printed = str(error)
            command = re.search(r"`hil run (\S+) ([^`]*)`", printed)
            words = [] if command is None else shlex.split(command[2])
            assert command is None or command[1] == str(root)
        no = ["--mounted", "no"]
        yes = ["--mounted", "yes"]
        accept = "--accept-dry-run"
        assert typed == [[*no, "--dry-run"], [*no, accept], [*yes, accept], [*no, accept]]
        assert (root / "payload" / "gripper" / "payload.json").exists()

    @pytest.mark.parametrize(
        ("words", "sentence"),
        [
            (("--payload", "../x", "--payload-mass", "2"), PAYLOAD_NAME_INVALID),
            (("--payload", "new"), "--payload-mass"),
            (("--payload", "new", "--payload-centre", "0,0,1"), "needs the mass"),
            (("--payload", "new", "--payload-mass", "2", "--payload-centre", "1"), "not 3 numbers"),
            (("--mounted", "yes"), "--mounted: needs a payload"),
            ((*STATED, "--precision", "torque 2"), "not about the payload"),
            ((*STATED, "--no-identify"), "--no-identify and --payload"),
        ],
    )
    def test_what_cannot_be_run_is_named(self, tmp_path, words, sentence: str) -> None:
        campaign = campaign_in(tmp_path)
        with pytest.raises(InputError, match=sentence):
            invoke(campaign.folder.root, *words)

    def test_a_copy_of_the_loaded_side_is_not_run(self, tmp_path) -> None:
        weighed = begun(campaign_in(tmp_path))
        shutil.copytree(weighed.loaded.folder.root, tmp_path / "copy")
        with pytest.raises(InputError, match=COPY_OF_LOADED_SIDE):
            invoke(tmp_path / "copy", "--dry-run")

    def test_a_campaign_in_the_place_of_a_side_is_to_be_moved(self, tmp_path) -> None:
        campaign = campaign_in(tmp_path)
        place = tmp_path / "mine" / "payload" / "gripper" / "bare"
        shutil.copytree(campaign.folder.root, place)
        with pytest.raises(InputError, match=r"mine is no campaign; move the folder"):
            invoke(place, "--dry-run")

    def test_a_terminal_is_asked_whatever_was_stated(self, tmp_path, monkeypatch) -> None:
        monkeypatch.setattr("hil.cli.weigh.can_read", lambda _: True)
        campaign = campaign_in(tmp_path)
        with pytest.raises(InputError, match="--mounted"):
            invoke(campaign.folder.root, *STATED, "--mounted", "yes")

    def test_a_side_is_not_run_alone(self, designed, done) -> None:
        weighed, _, _ = done
        with pytest.raises(InputError, match=r"run `hil run .*weigh --payload weight`"):
            invoke(weighed.loaded.folder.root)
