from __future__ import annotations

from xml.etree import ElementTree

import pytest
from hypothesis import given
from hypothesis import strategies as st

from identification.errors import ModelError
from identification.export.xml_source import Element, XmlSource

TEXT = """<?xml version="1.0"?>
<!-- a > comment with <mass value="9"/> in it -->
<robot name='café "x>y"'>
  <link name="a"  ><!-- kept --><mass   value = '1.5'/></link>
  <link name="b"/>
</robot>
"""


def links(source: XmlSource) -> list[Element]:
    return [child for child in source.root.children if child.name == "link"]


def test_elements_are_found_where_they_stand() -> None:
    source = XmlSource(TEXT)
    first, second = links(source)
    data = TEXT.encode()
    assert data[first.start : first.inside] == b'<link name="a"  >'
    assert data[first.start : first.end].endswith(b"/></link>")
    assert data[second.start : second.end] == b'<link name="b"/>'
    assert source.root.attributes == {"name": 'café "x>y"'}


def test_without_edits_the_text_is_the_same() -> None:
    assert XmlSource(TEXT).edited([]) == TEXT


def test_an_attribute_changes_and_nothing_else() -> None:
    source = XmlSource(TEXT)
    mass = links(source)[0].child("mass")
    assert mass is not None
    edited = source.edited([source.with_attributes(mass, {"value": "2.0"})])
    assert edited == TEXT.replace("'1.5'", '"2.0"')


def test_a_new_attribute_is_put_behind_the_others() -> None:
    source = XmlSource(TEXT)
    mass, second = links(source)[0].child("mass"), links(source)[1]
    assert mass is not None
    edited = source.edited(
        [source.with_attributes(mass, {"unit": "kg"}), source.with_attributes(second, {"x": "1"})]
    )
    assert "<mass   value = '1.5' unit=\"kg\"/>" in edited
    assert '<link name="b" x="1"/>' in edited


def test_an_attribute_whose_name_ends_like_another_is_another() -> None:
    source = XmlSource('<dynamics mu_friction="7" friction="0"/>')
    edited = source.edited([source.with_attributes(source.root, {"friction": "3.0"})])
    assert edited == '<dynamics mu_friction="7" friction="3.0"/>'


def test_children_are_put_in_with_the_indentation_of_their_siblings() -> None:
    source = XmlSource("<a>\n\t<b/>\n</a>\n")
    assert source.edited([source.with_first_child(source.root, ["<c/>"])]) == (
        "<a>\n\t<c/>\n\t<b/>\n</a>\n"
    )


def test_an_empty_element_is_opened_for_children() -> None:
    source = XmlSource(TEXT)
    edited = source.edited([source.with_first_child(links(source)[1], ["<mass value='1'/>"])])
    assert "  <link name=\"b\">\n    <mass value='1'/>\n  </link>\n" in edited


def test_line_ends_are_kept() -> None:
    source = XmlSource("<a>\r\n  <b/>\r\n</a>\r\n")
    edited = source.edited([source.with_first_child(source.root, ["<c/>"])])
    assert "\n" not in edited.replace("\r\n", "")


def test_what_is_no_xml_is_refused() -> None:
    with pytest.raises(ModelError, match="no XML"):
        XmlSource("<a><b></a>")


@given(st.text(st.characters(codec="utf-8", exclude_categories=("Cc", "Cs"))))
def test_any_value_is_read_back(value: str) -> None:
    source = XmlSource(TEXT)
    second = links(source)[1]
    edited = source.edited([source.with_attributes(second, {"name": value})])
    assert ElementTree.fromstring(edited)[1].attrib["name"] == value
