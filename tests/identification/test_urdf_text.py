"""Robot descriptions that anybody may have written: refused in a sentence, never a crash."""

from __future__ import annotations

import gc
import itertools
import math
import struct
import time
from pathlib import Path

import pytest

from identification import ModelError, RobotModel
from identification.excitation import CollisionChecker, Workspace
from identification.excitation.errors import CollisionModelError
from identification.kinematics import MOST_JOINTS
from identification.urdf_text import LONGEST, MOST_LINKS, refusal

INERTIAL = (
    '<inertial><mass value="6"/><origin xyz="0.2 0 0"/>'
    '<inertia ixx="0.02" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial>'
)
SHAPE = '<collision><geometry><box size="0.3 0.1 0.1"/></geometry></collision>'
HINGE = (
    '<joint name="{0}" type="{1}"><parent link="{2}"/><child link="{3}"/><axis xyz="0 1 0"/>'
    '<limit lower="-1" upper="1" effort="1" velocity="1"/></joint>'
)
ARM = (
    f'<robot name="r"><link name="base"/><link name="upper">{INERTIAL}{SHAPE}</link>'
    f"{HINGE.format('shoulder', 'revolute', 'base', 'upper')}</robot>"
)


def arm(old: str, new: str) -> str:
    """The arm with something of it replaced."""
    assert old in ARM
    return ARM.replace(old, new)


def chain(n: int, kind: str) -> str:
    """The arm with a chain of `n` more links."""
    links = ["upper", *(f"l{i}" for i in range(n))]
    more = "".join(
        f'<link name="{after}"/>{HINGE.format(f"j_{after}", kind, before, after)}'
        for before, after in itertools.pairwise(links)
    )
    return arm("</robot>", f"{more}</robot>")


def declaring(entity: str, used: str = "") -> str:
    return f"<!DOCTYPE robot [{entity}]>" + arm('name="r"', f'name="r{used}"')


def expanding() -> str:
    """Ten entities, each ten of the one before: "a billion laughs"."""
    lines = [f'<!ENTITY e{i} "{f"&e{i - 1};" * 10}">' for i in range(1, 10)]
    return declaring('<!ENTITY e0 "ha">' + "".join(lines), "&e9;")


REFUSED = {
    "an entity of its own": (declaring('<!ENTITY x "y">', "&x;"), "declares the entity 'x'"),
    "entities without end": (expanding(), "declares the entity 'e0'"),
    "a file as an entity": (
        declaring('<!ENTITY x SYSTEM "file:///etc/passwd">', "&x;"),
        "declares the entity 'x'",
    ),
    "an address as an entity": (
        declaring('<!ENTITY % x SYSTEM "http://127.0.0.1:9/x"> %x;'),
        "declares the entity 'x'",
    ),
    "a control character": (arm("shoulder", "a\x1b[31mb"), "no XML"),
    "a zero byte": (arm("shoulder", "a\0b"), "no XML"),
    "half a character": (arm("shoulder", "a\ud800b"), "no text"),
    "a name over two lines": (arm("shoulder", "a&#10;b"), "'a\\nb' has characters"),
    "a name that turns its line round": (arm("shoulder", "a\u202eb"), "cannot be printed"),
    "elements in elements": (arm("</robot>", "<a>" * 100 + "</a>" * 100 + "</robot>"), "deep"),
    "attributes without end": (
        arm("<robot ", "<robot " + "".join(f'a{i}="" ' for i in range(100_000))),
        "attributes",
    ),
    "a chain that overflows the reader's stack": (chain(20_000, "fixed"), f"{MOST_LINKS} links"),
    "more joints than a model bears": (chain(300, "revolute"), f"at most {MOST_JOINTS}"),
    "more text than anybody writes": (" " * (LONGEST + 1), "characters"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_it_is_refused_in_a_sentence_and_at_once(case: str) -> None:
    text, why = REFUSED[case]
    began = time.process_time()
    with pytest.raises(ModelError) as caught:
        RobotModel.from_urdf(text)
    assert why in str(caught.value)
    assert str(caught.value).isprintable()
    assert time.process_time() - began < 2.0


@pytest.mark.parametrize(
    "number",
    ["6 ", "nan", "inf", "1e999", "0x6", "6,0", "1_0", "${m}", "", "\u0663", "6&#10;", "9" * 400],
)
def test_an_inertia_that_the_reader_would_leave_out_is_refused(number: str) -> None:
    with pytest.raises(ModelError, match=r"link 'upper' has value=.* in the <mass>"):
        RobotModel.from_urdf(arm('value="6"', f'value="{number}"'))


@pytest.mark.parametrize("blank", ["\t", "\n"])
def test_so_is_one_with_blanks_that_only_xml_takes_for_spaces(blank: str) -> None:
    with pytest.raises(ModelError, match="tab or line end within an attribute of the <origin>"):
        RobotModel.from_urdf(arm('xyz="0.2 0 0"', f'xyz="0.2{blank}0 0"'))


@pytest.mark.parametrize("number", ["6", " 6", "+6", "6.", "6e0", "0.6E+1", "006"])
def test_what_passes_as_a_number_is_read_as_that_number(number: str) -> None:
    model = RobotModel.from_urdf(arm('value="6"', f'value="{number}"'))
    mass = model.chain.inertial[0, list(model.layout.names).index("m1")]
    assert math.isclose(mass, 6.0)


def test_attributes_in_lines_of_their_own_are_as_good() -> None:
    assert refusal(ARM.replace('" i', '"\n\ti').replace('" value', '"\n value')) is None
    assert refusal("<!-- a > b -->\n" + arm("<mass ", "<mass\n\t")) is None


def checker(urdf: str) -> CollisionChecker:
    return CollisionChecker(urdf, Workspace(floor=-1.0))


@pytest.mark.parametrize(
    ("size", "why"),
    [
        ("0.3\t0.1 0.1", "of the 1 collision shapes of link 'upper' 0 could be read"),
        ("0.3 0.1", "of the 1 collision shapes of link 'upper' 0 could be read"),
        ("nan 0.1 0.1", "of the 1 collision shapes of link 'upper' 0 could be read"),
        ("0.3 -0.1 0.1", "a collision shape of link 'upper' has a negative size"),
    ],
)
def test_no_collision_shape_is_left_out_without_a_word(size: str, why: str) -> None:
    """A second, sound one hides the first otherwise: the arm would be thinner than it is."""
    urdf = arm(SHAPE, SHAPE.replace("0.3 0.1 0.1", size))
    both = chain(1, "revolute").replace(SHAPE, SHAPE.replace("0.3 0.1 0.1", size))
    both = both.replace('<link name="l0"/>', f'<link name="l0">{SHAPE}</link>')
    for text in (urdf, both):
        with pytest.raises(CollisionModelError, match=why):
            checker(text)
    assert RobotModel.from_urdf(urdf).n_joints == 1  # to an estimate shapes are nothing


@pytest.mark.parametrize("corner", [math.nan, math.inf, 0.0])
def test_a_mesh_that_is_no_body_is_named(corner: float, tmp_path: Path) -> None:
    """Four triangles in one point, or nowhere."""
    triangle = b"\0" * 12 + struct.pack("<9f", *[corner] * 9) + b"\0\0"
    mesh = tmp_path / "mesh.stl"
    mesh.write_bytes(b"\0" * 80 + struct.pack("<I", 4) + 4 * triangle)
    with pytest.raises(CollisionModelError) as caught:
        checker(arm('<box size="0.3 0.1 0.1"/>', f'<mesh filename="{mesh}"/>'))
    assert str(caught.value).isprintable()


@pytest.mark.parametrize("text", [ARM, ARM[:-1]])
def test_a_description_that_was_read_is_not_kept(text: str) -> None:
    """It may have 20 MB, and the cycle collector may take minutes to come."""
    refusal(text)
    gc.collect()
    gc.disable()
    try:
        refusal(text)
        assert gc.collect() == 0
    finally:
        gc.enable()
