"""The report on essential parameters and physical consistency."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pytest

from hil.identify.summary import (
    consistency_reasons,
    consistency_result,
    consistency_warnings,
    essential_result,
    essential_warnings,
)
from hil.report import page
from hil.report.figures import elimination_panels
from hil.report.rendering import environment
from hil.results import BlindResult, ConsistencyResult, EssentialResult, ParameterResult

from .identified_arm import IdentifiedArm, identified_arm
from .test_exports import TWO_LINK


@pytest.fixture(scope="module")
def arm() -> IdentifiedArm:
    return identified_arm(TWO_LINK)


class Sections:
    """What the two sections read of `hil.results.Results`."""

    def __init__(self, arm: IdentifiedArm, **changes: Any) -> None:
        estimate, rank = arm.estimate, arm.cell.model.base.rank
        self.parameters = [
            ParameterResult(
                name=name,
                expression=name,
                unit=unit,
                table2_id=None,
                estimate=value,
                std=std,
                repetition_mean=value,
                repetition_std=None,
                truth=None,
                undetermined=name in estimate.undetermined,
            )
            for name, unit, value, std in zip(
                estimate.names, estimate.units, estimate.values, estimate.std, strict=True
            )
        ]
        self.n_base = rank
        self.joint_names = list(arm.cell.model.joint_names)
        self.essential = essential_result(arm.essential)
        self.consistency = consistency_result(arm.cell.model, arm.consistency)
        for name, value in changes.items():
            setattr(self, name, value)


def rendered(sections: Any) -> str:
    source = (
        '{% from "macros.html.j2" import panels, swatch, dot, table_open %}'
        '{% include "trust.html.j2" %}{% include "consistency.html.j2" %}'
    )
    has_truth = any(one.truth is not None for one in sections.parameters)
    template = environment().from_string(source)
    return template.render(**page.trust_context(sections), results=sections, has_truth=has_truth)


def essential_part(sections: Sections) -> EssentialResult:
    assert sections.essential is not None
    return sections.essential


def test_essential_estimates_far_from_the_truth_are_marked(arm: IdentifiedArm) -> None:
    """In standard deviations, and with the marks of the table of all parameters."""
    sections = Sections(arm)
    one, other = essential_part(sections).parameters[:2]
    truths = {one.name: one.estimate - 4.0 * one.std, other.name: other.estimate + 2.5 * other.std}
    sections.parameters = [
        parameter.model_copy(update={"truth": truths.get(parameter.name)})
        for parameter in sections.parameters
    ]
    marks = re.findall(
        r'<tr( class="\w+")?><th scope="row">.*?<td class="z">([^<]*)<', rendered(sections)
    )
    assert marks[:2] == [(' class="out3"', "+4.00"), (' class="out2"', "-2.50")]
    assert {mark for mark, _ in marks[2:]} == {""}


def test_a_grade_is_by_relative_standard_deviation(arm: IdentifiedArm) -> None:
    graded = {one.name: one.grade for one in Sections(arm).parameters}
    relative = arm.estimate.std / np.abs(arm.estimate.values)
    for name, std in zip(arm.estimate.names, relative, strict=True):
        assert graded[name] == ("well" if std <= 0.1 else "roughly" if std <= 0.5 else "hardly")


def test_what_the_data_do_not_determine_is_named() -> None:
    still = identified_arm(TWO_LINK, still=(1,))
    page = rendered(Sections(still))
    assert "Not determined by these data" in page
    for name in ("f0_2", "I2m"):
        assert name in page.split("Not determined by these data")[1].split("</p>")[0]


def test_it_is_said_of_each_whether_the_data_or_the_nominal_figures_know_it(
    arm: IdentifiedArm,
) -> None:
    sections = Sections(arm)
    assert "Learned from data" not in rendered(sections)
    sections.parameters = [
        one.model_copy(update={"learned": one.name != "mc2z"}) for one in sections.parameters
    ]
    page = rendered(sections)
    assert "Learned from data" in page
    assert 'of <strong>1</strong>: <span class="muted">mc2z</span>' in page
    rows = re.findall(r'<th scope="row">(\w+)</th>.*?<td class="text">(yes|no)</td>', page)
    assert dict(rows) == {
        name: "no" if name == "mc2z" else "yes" for name in arm.essential.elimination.estimate.names
    }


def test_the_section_says_why_what_it_costs_and_what_is_kept(arm: IdentifiedArm) -> None:
    sections = Sections(arm)
    page = rendered(sections)
    part = essential_part(sections)
    text = re.sub(r"<[^>]*>", "", page)
    assert part.reason in text
    assert f"{part.by_spread_held_out:.2%}" in text
    assert part.blind is not None
    assert f"{part.blind.essential:.2%}" in text
    for parameter in part.parameters:
        assert f'<th scope="row">{parameter.name}</th>' in page


def test_the_cut_is_drawn_where_it_is(arm: IdentifiedArm) -> None:
    part = essential_part(Sections(arm))
    (errors,) = elimination_panels(part)
    left = part.steps[part.cut].left
    assert errors.note == f"cut at {left} of {part.steps[0].left}"
    assert f"with the {left} at the cut" in errors.svg
    assert errors.svg.count(">cut</") == 1
    assert "nan" not in errors.svg


def test_without_either_only_the_grades_are_left(arm: IdentifiedArm) -> None:
    page = rendered(Sections(arm, essential=None, consistency=None))
    assert 'id="trust"' in page
    assert "Essential parameters" not in page
    assert 'id="consistency"' not in page


def test_a_short_motion_has_no_blind_figure_and_says_so(arm: IdentifiedArm) -> None:
    short = essential_part(Sections(arm)).model_copy(update={"blind": None})
    assert "too short to tell" in rendered(Sections(arm, essential=short))


def test_the_blind_figure_is_not_called_better_than_it_is(arm: IdentifiedArm) -> None:
    blind = BlindResult(left=7, essential=0.0612, full=0.0534)
    part = essential_part(Sections(arm)).model_copy(update={"blind": blind})
    page = rendered(Sections(arm, essential=part))
    assert "7 parameters predict the held-out motion with an error of 6.12%, against 5.34%" in page


def consistency_part(arm: IdentifiedArm, **changes: Any) -> ConsistencyResult:
    part = consistency_result(arm.cell.model, arm.consistency)
    assert part is not None
    return part.model_copy(update=changes)


def test_consistency_names_links_costs_and_bounds(arm: IdentifiedArm) -> None:
    bound = "rotor inertia of elbow would be negative (-0.3)"
    page = rendered(Sections(arm, consistency=consistency_part(arm, bounds=[bound])))
    assert bound in page
    for joint in ("shoulder", "elbow"):
        assert f'<th scope="row">{joint}</th>' in page
    standard = arm.consistency.consistent.standard
    mass = standard[arm.cell.model.layout.links[1, 9]]
    assert f"<td>{mass:.2f}</td>" in page


def test_parameters_moved_further_than_three_deviations_are_named(arm: IdentifiedArm) -> None:
    page = rendered(Sections(arm, consistency=consistency_part(arm, moved=["mc2x", "f0_1"])))
    assert "moved by more than three standard deviations: mc2x, f0_1." in page
    assert "At odds" not in rendered(Sections(arm, consistency=consistency_part(arm, moved=[])))


def test_names_of_joints_are_text_and_nothing_else(arm: IdentifiedArm) -> None:
    part = consistency_part(arm)
    link = part.links[0].model_copy(update={"joint": "<script>alert(1)</script>"})
    page = rendered(Sections(arm, consistency=part.model_copy(update={"links": [link]})))
    assert "<script>" not in page


def test_a_machine_is_no_reason_and_no_doubt(arm: IdentifiedArm) -> None:
    assert consistency_reasons(arm.consistency) == ()
    assert (*essential_warnings(arm.essential), *consistency_warnings(arm.consistency)) == ()
    doubts = (*consistency_warnings("the solver gave up"), *essential_warnings("no motion"))
    assert len(doubts) == 2
    assert "the solver gave up" in doubts[0]


def test_a_name_on_a_page_turns_no_other_text_round() -> None:
    page = environment().from_string("{{ name }}|{{ kept }}|{{ number }}")
    name, kept = "a\u202eb\x1b[31m\u2066c\x7f", "1\u2009234\u00a0N\n\té"
    shown = page.render(name=name, kept=kept, number=3)
    assert shown == r"a\u202eb\x1b[31m\u2066c\x7f" + f"|{kept}|3"
