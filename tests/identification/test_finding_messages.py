"""Findings in words."""

from __future__ import annotations

import ast
import inspect
import string
from collections.abc import Iterator
from typing import get_args

import numpy as np
import pytest

from hil.pipeline import cell_context, other_meanings, recorded_rows
from identification.hypotheses.joint_changes import Change
from identification.signals.position_steps import PositionJump
from identification.validation.finding import Finding, FindingKey, RemedyKey, RepeatedSamples
from identification.validation.finding_messages import (
    REMEDIES,
    SENTENCES,
    Naming,
    worded,
)
from identification.validation.findings import (
    diagnosis,
    errors,
    excitation,
    faults,
    form,
    patterns,
    recordings,
    references,
    sameness,
    scale,
)
from identification.validation.physical_signs import SignKind

NAMING = Naming(("one", "two", "three"))
FIRST = PositionJump("a.mcap", "one", 1.5, 0.25)
MODULES = (
    cell_context, diagnosis, errors, excitation, faults, form, other_meanings, patterns,
    recorded_rows, recordings, references, sameness, scale,
)  # fmt: skip


def test_every_finding_and_every_remedy_has_words() -> None:
    assert SENTENCES.keys() == {*get_args(FindingKey)}
    assert REMEDIES.keys() == {*get_args(RemedyKey)}


def literals() -> Iterator[str]:
    for module in MODULES:
        for node in ast.walk(ast.parse(inspect.getsource(module))):
            if isinstance(node, ast.Constant) and isinstance(node.value, str):
                yield node.value


def test_no_sentence_and_no_remedy_is_without_a_finding() -> None:
    used = {*literals(), *get_args(SignKind)}
    assert not SENTENCES.keys() - used
    assert not REMEDIES.keys() - used


@pytest.mark.parametrize("text", [*REMEDIES.values(), *(each.words for each in SENTENCES.values())])
def test_words_have_no_full_stop_and_no_capital(text: str) -> None:
    """They are put together to sentences: only names and symbols begin with a capital."""
    assert not text.endswith(".")
    words = "".join(part for part, *_ in string.Formatter().parse(text))
    assert words[0].islower() or text.startswith(("{", "Coulomb"))


@pytest.mark.parametrize(
    ("finding", "words", "step"),
    [
        (
            Finding("no torque", "wrong", "resolve the torque", joints=(0, 2)),
            "the measured torque of one, three is zero or constant throughout unseen motion",
            "record the torque of one, three with sufficient resolution",
        ),
        (
            Finding(
                "axis error of little torque",
                "doubtful",
                "move faster",
                values={"limit": 0.35},
                joints=(1,),
                each={"relative": (0.6,), "torque": (0.1,), "unit": ("N·m",)},
            ),
            "the torque error on unseen motion exceeds 35 % for axes of little torque: two 60 % of"
            " 0.1 N·m",
            "move two faster and further, so that the torque exceeds the noise",
        ),
        (
            Finding("position jumps", "wrong", values={"jumps": (FIRST,) * 5}),
            "the measured position jumped faster than an arm can move: "
            + ", ".join(["one by +0.25 rad after 1.500 s of a.mcap"] * 3)
            + " and 2 more",
            "",
        ),
        (
            Finding(
                "repeated samples",
                "doubtful",
                values={"samples": (RepeatedSamples("one", 3, "a.mcap"),), "first": FIRST},
            ),
            "the log repeats or delays position samples, or lacks rows, while the arm moves: one 3"
            " in a.mcap (first: one after 1.500 s of a.mcap)",
            "",
        ),
        (
            Finding(
                "delay of the torque",
                "wrong",
                values={"size": 10.0, "half_interval": 2.0, "difference": -0.01},
            ),
            "the torque of all axes lags the position by 10 ± 2 ms less than assumed",
            "",
        ),
        (
            Finding("payload of a part", "wrong", values={"part": "A.mcap from 3 s on"}),
            "in A.mcap from 3 s on the arm carried another mass, which the motion does not"
            " determine, than in the other data",
            "",
        ),
        (
            Finding(
                "undetermined change of a part",
                "wrong",
                values={
                    "part": "A.mcap from 3 s on",
                    "alike": (
                        (Change("payload"),),
                        (Change("payload"), Change("scale", (1,))),
                        (Change("friction drift", (0, 1, 2)),),
                    ),
                },
            ),
            "A.mcap from 3 s on differs from the other data, and several explanations fit it:"
            " another load, or another load with another scale of the torque of two throughout, or"
            " friction that drifts throughout",
            "",
        ),
        (
            Finding(
                "unexplained part",
                "wrong",
                values={
                    "part": "A.mcap from 3 s on",
                    "nearest": (Change("payload"),),
                    "mass": 0.95,
                    "half_interval": 0.2,
                    "difference": 0.95,
                    "excess": 2.5,
                },
            ),
            "A.mcap from 3 s on differs from the other data; the nearest explanation is another"
            " load (0.95 ± 0.2 kg more), with which the error is still 2.5 times as large as in the"
            " other data",
            "",
        ),
        (
            Finding(
                "angle difference", "wrong", "state the coupled difference", joints=(2, 1)
            ),
            "the recorded angle of three is probably its own minus the angle of two",
            "turn one joint alone and watch which angles change; if both do, state in the column"
            " map of the log: coupled = [[3, 2, -1]] in [position] and [velocity] (columns counted"
            " from 1)",
        ),
        (
            Finding(
                "alike",
                "wrong",
                "jog and compare",
                values={
                    "change": Change("axis sign", (0,)),
                    "alike": (Change("axis sign", (0,)), Change("angle sum", (1, 0))),
                    "error": 0.5,
                },
                joints=(0,),
            ),
            "several explanations fit equally well: position and torque of one negated or the "
            "angle of two"
            " plus the angle of one; each leaves 50 % of the error on rows that were not used for"
            " the choice",
            "jog one and compare direction, order and torque with the column map",
        ),
        (
            Finding(
                "zeros",
                "wrong",
                "correct the zeros",
                values={"error": 0.25, "offsets": (0.0, 0.1)},
                joints=(1,),
                each={"degrees": (5.73,)},
            ),
            "joint zeros differ from the URDF: add two +5.7°; this leaves 25 % of the error on"
            " rows that were not used for the choice",
            "correct them: [position] offset = [0.0000, 0.1000] (rad) in the column map; compare"
            " with a posture of the arm",
        ),
        (
            Finding("commanded positions", "wrong", values={"recordings": ("a", "b")}),
            "the positions of a, b equal the commands bit for bit: the real arm lags behind them,"
            " and every speed and acceleration is the plan's, not the arm's",
            "",
        ),
        (
            Finding(
                "commanded positions", "wrong", values={"recordings": ("a",), "delay": 80.0}
            ),
            "the positions of a equal the commands bit for bit: the real arm lags behind them by"
            " about 80 ms, and every speed and acceleration is the plan's, not the arm's",
            "",
        ),
    ],
)  # fmt: skip
def test_sentences(finding: Finding, words: str, step: str) -> None:
    found = worded(finding, NAMING)
    assert (found.words, found.next_step) == (words, step)


def test_a_finding_about_joints_has_the_figures_of_these() -> None:
    finding = Finding("no torque", "wrong").about(
        np.array([False, True, True]), size=np.array([1.0, 2.0, 3.0]), unit=["a", "b", "c"]
    )
    assert finding.joints == (1, 2)
    assert finding.each == {"size": (2.0, 3.0), "unit": ("b", "c")}


def test_joint_names_may_contain_braces() -> None:
    found = worded(
        Finding("no torque", "wrong", "resolve the torque", joints=(0,)), Naming(("{one}",))
    )
    assert "of {one} is zero" in found.words and "of {one} with" in found.next_step
