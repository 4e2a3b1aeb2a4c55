"""A default namespace, as Drake's descriptions have, changes nothing of what is found."""

from __future__ import annotations

from xml.etree import ElementTree

import pytest

from identification import ModelError, RobotModel
from identification.excitation import CollisionChecker, Workspace
from identification.excitation.errors import CollisionModelError
from identification.model.urdf_text import urdf_tree
from tests.identification.test_urdf_text import ARM, HINGE, SHAPE, arm

DRAKE = 'xmlns="http://drake.mit.edu"'


def drakes(text: str) -> str:
    return text.replace("<robot ", f"<robot {DRAKE} ")


def test_elements_have_the_names_that_are_written() -> None:
    text = (
        f'<robot {DRAKE} xmlns:gazebo="x" name="r"><!-- kept --><link name="a&amp;b" />'
        '<gazebo:link gazebo:name="c">1 &lt; 2</gazebo:link></robot>'
    )
    root = urdf_tree(text, comments=True)
    assert [link.get("name") for link in root.findall("link")] == ["a&b"]
    assert ElementTree.tostring(root, encoding="unicode") == text
    assert [child.tag for child in urdf_tree(text)] == ["link", "gazebo:link"]


@pytest.mark.parametrize("text", ["", "<robot>", "<robot a='\ud800'/>"])
def test_what_is_no_xml_is_refused(text: str) -> None:
    with pytest.raises(ModelError, match="no XML"):
        urdf_tree(text)


def test_in_a_namespace_a_shape_that_was_left_out_is_noticed() -> None:
    CollisionChecker(drakes(ARM), Workspace(floor=-1.0))
    second = arm("</robot>", f'<link name="l"/>{HINGE.format("j", "revolute", "upper", "l")}')
    second = second.replace('<link name="l"/>', f'<link name="l">{SHAPE}</link>') + "</robot>"
    with pytest.raises(CollisionModelError, match="of link 'upper' 0 could be read"):
        CollisionChecker(drakes(second.replace("<box ", "<capsule ", 1)), Workspace(floor=-1.0))


def test_in_a_namespace_a_closed_chain_is_refused() -> None:
    closed = arm("</robot>", HINGE.format("again", "revolute", "base", "upper") + "</robot>")
    with pytest.raises(ModelError, match="child of 2 joints: a closed chain"):
        RobotModel.from_urdf(drakes(closed))


def test_in_a_namespace_a_fault_is_still_told() -> None:
    with pytest.raises(ModelError, match="'shoulder' is of type 'revolut'"):
        RobotModel.from_urdf(drakes(arm('"revolute"', '"revolut"')))
