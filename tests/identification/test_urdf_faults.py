from __future__ import annotations

import pytest

from identification import ModelError, RobotModel
from identification.model.kinematics import urdf_fault

LINKS = '<link name="a"/><link name="b"/>'
JOINT = (
    '<joint name="j" type="{}"><parent link="a"/><child link="{}"/><axis xyz="0 0 1"/>{}</joint>'
)
LIMIT = '<limit lower="-1" upper="1" effort="1" velocity="1"/>'


def robot(inside: str, head: str = ' name="r"') -> str:
    return f"<robot{head}>{inside}</robot>"


def xacro(inside: str) -> str:
    return robot(inside, ' name="r" xmlns:xacro="http://www.ros.org/wiki/xacro"')


FAULTS = {
    "no xml": "no XML",
    "<sdf/>": "<sdf>",
    xacro('<xacro:include filename="x"/>'): "expand it with: xacro",
    robot(LINKS, ""): "no name",
    robot(""): "no <link>",
    robot(LINKS): "'a', 'b' hang on nothing",
    robot(LINKS + '<link name="a"/>'): "2 of its links are called 'a'",
    robot(LINKS + JOINT.format("revolut", "b", LIMIT)): "'j' is of type 'revolut'",
    robot(LINKS + JOINT.format("revolute", "b", "")): "'j' is revolute and has no <limit>",
    robot(LINKS + JOINT.format("revolute", "c", LIMIT)): "child link 'c'",
    robot(LINKS + '<joint name="j" type="fixed"><parent link="a"/></joint>'): "no <child",
    robot(LINKS + JOINT.format("fixed", "b", "") + JOINT.format("fixed", "b", "").replace(
        '"j"', '"k"'
    )): "child of 2 joints",
}  # fmt: skip


@pytest.mark.parametrize("text", FAULTS)
def test_what_cannot_be_read_is_said_in_a_sentence(text: str) -> None:
    with pytest.raises(ModelError) as caught:
        RobotModel.from_urdf(text)
    message = str(caught.value)
    assert FAULTS[text] in message
    assert message.count("\n") == 0


def test_what_xacro_leaves_in_the_header_is_no_fault() -> None:
    text = xacro(LINKS + JOINT.format("continuous", "b", ""))
    assert urdf_fault(text) is None
    assert RobotModel.from_urdf(text).n_joints == 1
