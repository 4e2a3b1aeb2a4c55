"""Help that teaches: groups, short options, examples, and the nearest name of a misspelt one."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal, get_args, get_origin

import pytest
from typer.testing import CliRunner

from hil.cli import COMMANDS, GROUPS, app, suggestions
from hil.cli.suggestions import (
    FORMER_OPTIONS,
    OTHER_COMMANDS,
    SYNONYMS,
    examples,
    with_present_names,
)
from hil.design import METHODS
from hil.design.settings import FORMER_METHODS
from hil.pipeline.estimators import ESTIMATORS
from hil.pipeline.options import FRICTION_TERMS, Options
from hil.results.results import SettingsResult

WIDTH = "100"
MOST_LINES = 3
TWO_SCREENS = 80  # lines


def invoke(*arguments: str) -> Any:
    return CliRunner().invoke(app, [*arguments], env={"COLUMNS": WIDTH, "NO_COLOR": "1"})


def paths(name: str) -> Iterator[tuple[str, ...]]:
    """A command, and those below it, as typed."""
    yield (name,)
    for below in getattr(COMMANDS[name], "commands", {}):
        yield (name, below)


EVERY = [path for name in COMMANDS for path in paths(name)]


def entries(text: str) -> dict[str, list[str]]:
    """The lines of each option in a help text, by its long name."""
    lines_of: dict[str, list[str]] = {}
    lines: list[str] = []
    for line in text.splitlines():
        if not line.startswith("│"):
            lines = []
        elif start := re.match(r"│ [* ]{0,3}\s*(--[a-z][\w-]*|-\w\b)", line):
            lines = lines_of[start[1]] = [line]
        else:
            lines.append(line)
    return lines_of


def test_the_help_of_an_identification_fits_two_screens() -> None:
    assert len(invoke("identify", "--help").output.splitlines()) <= TWO_SCREENS


@pytest.mark.parametrize("path", EVERY, ids=" ".join)
def test_an_option_has_at_most_three_lines(path: tuple[str, ...]) -> None:
    shown = invoke(*path, "--help")
    assert shown.exit_code == 0
    long = {k: len(v) for k, v in entries(shown.stdout).items() if len(v) > MOST_LINES}
    assert not long, "\n".join("\n".join(entries(shown.stdout)[name]) for name in long)


def test_commands_are_in_groups() -> None:
    shown = invoke("--help").stdout
    panels = re.findall(r"^╭─ ([A-Z][a-z ]+?) ─", shown, re.MULTILINE)
    assert panels == ["Options", *GROUPS]
    below = shown.split("╭─ ")
    for panel, names in GROUPS.items():
        (text,) = [part for part in below if part.startswith(panel)]
        assert re.findall(r"^│ ([a-z][\w-]*)", text, re.MULTILINE) == [*names]


def alternatives(option: Any) -> Iterator[str]:
    """The values of a choice."""
    annotation = option.type_descriptor.annotation
    for kind in (annotation, *get_args(annotation)):
        if get_origin(kind) is Literal:
            yield from get_args(kind)


@pytest.mark.parametrize("path", EVERY, ids=" ".join)
def test_alternatives_are_in_the_page_of_commands(path: tuple[str, ...]) -> None:
    page = (Path(__file__).parents[3] / "docs" / "commands.md").read_text("utf-8")
    command = COMMANDS[path[0]] if len(path) == 1 else COMMANDS[path[0]].commands[path[1]]
    for option in command.params:
        if getattr(option, "metavar", None):  # in place of the values
            missing = [value for value in alternatives(option) if f"`{value}`" not in page]
            assert not missing, option.name
    assert all(f"`{term.strip()}`" in page for term in FRICTION_TERMS.split(","))
    descriptions = ESTIMATORS | {name: method.help for name, method in METHODS.items()}
    for name, description in descriptions.items():
        assert f"| `{name}` | {description} |" in page


class TestMissing:
    def test_identify_says_what_it_takes_with_two_examples(self) -> None:
        refused = invoke("identify")
        assert refused.exit_code == 2
        for phrase in ("Logs or bags, with --urdf", "archives (*.mcap)", "campaign folder",
                      "Example: hil identify log.csv --urdf arm.urdf",
                      "Example: hil identify runs/demo"):  # fmt: skip
            assert phrase in refused.stderr

    def test_as_json_too(self) -> None:
        assert "hil identify log.csv --urdf arm.urdf" in invoke("identify", "--json").stdout

    @pytest.mark.parametrize("path", EVERY, ids=" ".join)
    def test_examples_are_read_from_the_help(self, path: tuple[str, ...]) -> None:
        command = COMMANDS[path[0]] if len(path) == 1 else COMMANDS[path[0]].commands[path[1]]
        if "**Example" in (command.help or ""):
            assert examples(command)[0].startswith(f"hil {' '.join(path)}")


class TestMisspelt:
    @pytest.mark.parametrize(
        ("arguments", "meant"),
        [
            (("move", "cell.toml", "--override", "10"), "--speed"),
            (("identify", "a.csv", "--urfd", "arm.urdf"), "--urdf"),
            (("identify", "a.csv", "--robot", "arm.urdf"), "--urdf"),
            (("identify", "a.csv", "--validation", "b.csv"), "--predict"),
            (("identify", "a.csv", "--torque-bandwith", "5"), "--torque-bandwidth"),
            (("export", "runs/demo", "--format", "mjcf"), "--to"),
            (("import", "log", "a.csv", "--rate", "100"), "--sample-rate"),
        ],
    )
    def test_an_option(self, arguments: tuple[str, ...], meant: str) -> None:
        refused = invoke(*arguments)
        assert refused.exit_code == 2
        assert f"Did you mean {meant}?" in " ".join(refused.stderr.split())

    def test_an_option_like_no_other(self) -> None:
        refused = invoke("identify", "a.csv", "--zzzz")
        assert "No such option: --zzzz" in refused.stderr
        assert "mean" not in refused.stderr

    @pytest.mark.parametrize(
        ("word", "meant"),
        [("identfy", "'identify'"), ("fit", "'hil identify'"), ("gripper", "'hil payload'")],
    )
    def test_a_command(self, word: str, meant: str) -> None:
        refused = invoke(word, "x")
        assert refused.exit_code == 2
        assert f"Did you mean {meant}" in refused.stderr

    def test_a_file(self, tmp_path: Path) -> None:
        (tmp_path / "arm.urdf").write_text("<robot/>")
        (tmp_path / "log.csv").write_text("t\n0\n")
        log = str(tmp_path / "log.csv")
        urdf = str(tmp_path / "amr.urdf")
        assert "arm.urdf" in str(invoke("identify", log, "--urdf", urdf).exception)
        urdf = str(tmp_path / "arm.urdf")
        (tmp_path / "arm.urdf").write_text((Path(__file__).parents[3] / "sim_fixtures" / "ns16"
                                            / "ns16.urdf").read_text())  # fmt: skip
        wrong = str(tmp_path / "lgo.csv")
        assert "log.csv" in str(invoke("identify", wrong, "--urdf", urdf).exception)

    def test_what_is_suggested_exists(self) -> None:
        options = {
            name
            for path in EVERY
            for option in (
                COMMANDS[path[0]] if len(path) == 1 else COMMANDS[path[0]].commands[path[1]]
            ).params
            for name in option.opts
        }
        assert {name for names in SYNONYMS.values() for name in names} <= options
        assert {tuple(command.split()) for command in OTHER_COMMANDS.values()} <= set(EVERY)
        assert not OTHER_COMMANDS.keys() & COMMANDS.keys()


class TestRareOptions:
    """Entries of a map: they work, and only the commands that describe channels list them."""

    NAMES = ("--command-topic", "--commands", "--calibration", "--units", "--outside-limits",
             "--drop-missing")  # fmt: skip

    @pytest.mark.parametrize("command", ["identify", "batch", "trend"])
    def test_they_work_and_are_not_in_the_help(self, command: str) -> None:
        shown = invoke(command, "--help").stdout
        options = {name: option for option in COMMANDS[command].params for name in option.opts}
        for name in self.NAMES:
            assert name not in entries(shown)
            assert options[name].hidden

    @pytest.mark.parametrize("path", [("look",), ("import", "log")], ids=" ".join)
    def test_commands_about_channels_list_them(self, path: tuple[str, ...]) -> None:
        missing = {*self.NAMES} - {*entries(invoke(*path, "--help").stdout)}
        assert missing <= ({"--outside-limits"} if path == ("look",) else set())


class TestFormerNames:
    """Of version 0.1; they work in 0.2 and say so."""

    @pytest.mark.parametrize(
        ("arguments", "notes"),
        [
            (("gains", "none.mcap"), ["hil gains is now called hil torque-constants"]),
            (("reidentify", "none", "--standstill=slow"),
             ["hil reidentify is now called hil batch",
              "--standstill is now called --exclude-rows"]),
            (("identify", "none.mcap", "--in-sample", "--standstill", "slow"),
             ["--in-sample is now called --fit-all",
              "--standstill is now called --exclude-rows"]),
            (("design", "none.toml", "--kinematic"),
             ["--kinematic is now called --limits-only"]),
        ],
    )  # fmt: skip
    def test_they_are_the_present_ones(self, arguments: tuple[str, ...], notes: list[str]) -> None:
        done = invoke(*arguments)
        assert [line for line in done.stderr.splitlines() if "now called" in line] == [
            f"note: {note}" for note in notes
        ]
        present = invoke(*with_present_names(arguments)[0])
        assert (str(done.exception), done.stdout) == (str(present.exception), present.stdout)
        assert "none" in str(present.exception)

    @pytest.mark.parametrize("method", FORMER_METHODS)
    @pytest.mark.parametrize("option", ["--method", "--show-settings"])
    @pytest.mark.parametrize("joined", [True, False])
    def test_a_former_search_method_is_the_gradient(
        self, option: str, method: str, joined: bool
    ) -> None:
        former, present = (
            ("design", "none.toml", *([f"{option}={name}"] if joined else [option, name]))
            for name in (method, "gradient")
        )
        assert set(suggestions.FORMER_METHODS) == set(FORMER_METHODS)
        note = f"the method {method} was replaced by gradient, used in this version"
        assert with_present_names(former) == (list(present), [note])
        done = invoke(*former)
        expected = invoke(*present)
        assert f"note: {note}" in done.stderr
        assert done.exit_code == expected.exit_code
        assert (str(done.exception), done.stdout) == (str(expected.exception), expected.stdout)

    def test_two_options_had_one_name(self) -> None:
        present, notes = with_present_names(("import", "log", "a.csv", "--standstill", "0.02"))
        assert present == ["import", "log", "a.csv", "--standstill-speed", "0.02"]
        assert notes == ["--standstill is now called --standstill-speed"]

    def test_options_in_python(self) -> None:
        with pytest.warns(DeprecationWarning, match="standstill is now called exclude_rows"):
            former = Options(standstill="slow")
        assert former == Options(exclude_rows="slow")

    def test_settings_of_earlier_results(self) -> None:
        stored = SettingsResult(
            archives=[], predicted=[], split=0.7, in_sample=False, estimator="wls",
            settings={"preprocessing": {"left_out": "halts"}},
        )  # fmt: skip
        assert stored.decided().preprocessing.exclude_rows == "halts"

    def test_what_follows_two_dashes_is_no_option(self) -> None:
        arguments = ("identify", "--", "--in-sample")
        assert with_present_names(arguments) == (list(arguments), [])

    def test_they_are_not_in_the_help(self) -> None:
        assert "gains" not in invoke("--help").stdout
        assert "--standstill" not in invoke("identify", "--help").stdout
        for names in FORMER_OPTIONS.values():
            for command, name in names.items():
                path = (command, "log") if command == "import" else (command,)
                assert name in entries(invoke(*path, "--help").stdout)
