"""Former names of commands and options, and answers to misspelt and missing ones."""

from __future__ import annotations

import difflib
import re
from collections.abc import Mapping, Sequence
from typing import Any, Final

SYNONYMS: Final[Mapping[str, tuple[str, ...]]] = {
    "--override": ("--speed",),
    "--velocity": ("--speed",),
    "--out": ("--output",),
    "--outdir": ("--output",),
    "--folder": ("--output",),
    "--robot": ("--urdf",),
    "--model": ("--urdf",),
    "--validate": ("--predict",),
    "--validation": ("--predict",),
    "--test": ("--predict",),
    "--rate": ("--sample-rate",),
    "--frequency": ("--sample-rate",),
    "--fs": ("--sample-rate",),
    "--lock": ("--locked", "--fix"),
    "--filter": ("--bandwidth", "--torque-bandwidth"),
    "--cutoff": ("--bandwidth", "--torque-bandwidth"),
    "--lowpass": ("--torque-bandwidth",),
    "--format": ("--to",),
    "--overwrite": ("--force",),
    "--processes": ("--workers",),
    "--jobs": ("--workers",),
    "--payload": ("--loaded",),
    "--time": ("--duration",),
    "--silent": ("--quiet",),
}
"""Options by other words for them; the first that a command has is suggested."""

OTHER_COMMANDS: Final[Mapping[str, str]] = {
    **dict.fromkeys(("fit", "estimate", "identification", "sysid"), "identify"),
    **dict.fromkeys(("convert", "log", "csv"), "import log"),
    **dict.fromkeys(("rosbag", "rosbag2", "bag"), "import rosbag2"),
    **dict.fromkeys(("load", "gripper", "tool"), "payload"),
    **dict.fromkeys(("mujoco", "mjcf", "urdf", "sdf", "pinocchio"), "export"),
    **dict.fromkeys(("sim", "controller"), "simulate"),
    **dict.fromkeys(("info", "check", "repair"), "archive"),
    **dict.fromkeys(("jog", "goto"), "move"),
    **dict.fromkeys(("execute", "start"), "run"),
    **dict.fromkeys(("excitation", "optimize", "optimise"), "design"),
    **dict.fromkeys(("torque", "constants", "current"), "torque-constants"),
    **dict.fromkeys(("diff",), "compare"),
    **dict.fromkeys(("init",), "new"),
    **dict.fromkeys(("latency", "realtime"), "doctor"),
}
"""Commands by other words for them."""

FORMER_COMMANDS: Final[Mapping[str, str]] = {"gains": "torque-constants", "reidentify": "batch"}
"""Commands by their names in version 0.1, which work in 0.2 as well."""

FORMER_OPTIONS: Final[Mapping[str, Mapping[str, str]]] = {
    "--standstill": {
        **dict.fromkeys(("identify", "rollout", "batch"), "--exclude-rows"),
        "import": "--standstill-speed",
    },
    "--in-sample": {"identify": "--fit-all"},
    "--kinematic": {"design": "--limits-only"},
}
"""Options by their names in version 0.1: the present name in each command that has it."""

FORMER_METHODS: Final[Mapping[str, str]] = {"balanced": "gradient", "front": "gradient"}
"""Methods of `hil design` in version 0.1, and their replacements. Settings files that name
them are refused by `hil.design.settings`, whose list is the same; it is slow to load."""

_METHOD_OPTIONS: Final = ("--method", "--show-settings")  # of `hil design`
_EXAMPLES: Final = re.compile(r"\*\*Examples?:?\*\*(.*?)(?:\n\n(?!- )|\Z)", re.DOTALL)
_COMMAND: Final = re.compile(r"`(hil [^`]+)`")
_MAX_EXAMPLES: Final = 2  # examples of one error


def with_present_names(arguments: Sequence[str]) -> tuple[list[str], list[str]]:
    """Return arguments of the command line with present names, and a note for each former one."""
    present = list(arguments)
    notes = list[str]()
    index = next((k for k, word in enumerate(present) if not word.startswith("-")), None)
    if index is None:
        return present, notes
    if new := FORMER_COMMANDS.get(present[index]):
        notes.append(f"hil {present[index]} is now called hil {new}")
        present[index] = new
    end = present.index("--") if "--" in present else len(present)
    for k in range(index + 1, end):
        name, equals, value = present[k].partition("=")
        option = FORMER_OPTIONS.get(name, {}).get(present[index])
        if option is not None:
            notes.append(f"{name} is now called {option}")
            present[k] = option + equals + value
        if present[index] == "design" and name in _METHOD_OPTIONS:
            at = k if equals else k + 1
            method = value if equals else "".join(present[at : min(at + 1, end)])
            if new := FORMER_METHODS.get(method):
                notes.append(f"the method {method} was replaced by {new}, used in this version")
                present[at] = name + equals + new if equals else new
    return present, notes


def improve(error: BaseException) -> None:
    """Add to an error of the command line what was probably meant, or what is missing."""
    context: Any = getattr(error, "ctx", None)
    if context is None:
        return
    refusal: Any = error
    if hasattr(error, "possibilities"):
        refusal.message += _nearest(refusal, context.command)
        refusal.possibilities = None
    parameter: Any = getattr(error, "param", None)
    if type(error).__name__ == "MissingParameter" and parameter is not None:
        described = (getattr(parameter, "help", None) or "").rstrip(".")
        lines = [f"It takes: {described}."] if described else []
        lines += [f"Example: {example}" for example in examples(context.command)[:_MAX_EXAMPLES]]
        refusal.message = "\n".join(lines)


def _nearest(error: Any, command: Any) -> str:
    """Return the question whether an option of the command was meant."""
    options = {name for parameter in command.params for name in parameter.opts}
    synonyms = [name for name in SYNONYMS.get(error.option_name, ()) if name in options]
    bare = {name.strip("-"): name for name in options if name.startswith("--")}
    alike = difflib.get_close_matches(error.option_name.strip("-"), bare, n=1)
    nearest = [*synonyms, *(bare[name] for name in alike)]
    return f". Did you mean {nearest[0]}?" if nearest else ""


def examples(command: Any) -> list[str]:
    """Return the examples in the help of a command, each in one line."""
    section = _EXAMPLES.search(command.help or "")
    return [" ".join(line.split()) for line in _COMMAND.findall(section[1])] if section else []
