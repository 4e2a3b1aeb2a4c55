"""TOML that hil writes or edits: every value is restored, comments and all else stay."""

from __future__ import annotations

import tomllib
from datetime import UTC
from decimal import Decimal
from typing import Any

import numpy as np
import pytest
import tomlkit
from hypothesis import given, settings
from hypothesis import strategies as st

from hil.base.errors import InputError
from hil.base.toml_text import Angles, degrees_text, from_text, radians_of, to_text
from hil.cell.toml_edits import with_values

texts = st.text(st.characters(codec="utf-8"))
single = (
    st.booleans()
    | st.integers(-(2**63), 2**63 - 1)
    | st.floats(allow_nan=False)
    | texts
    | st.dates()
    | st.times()
    | st.datetimes()
    | st.datetimes(timezones=st.just(UTC))
)
values = st.recursive(
    single, lambda inner: st.lists(inner) | st.dictionaries(texts, inner), max_leaves=12
)


class TestWritten:
    @given(name=texts, value=values)
    def test_every_type_of_toml_is_restored(self, name: str, value: object) -> None:
        assert tomllib.loads(to_text({name: value})) == {name: value}

    @given(st.floats(allow_nan=False))
    @settings(max_examples=1000)
    def test_a_float_is_restored_to_the_bit(self, number: float) -> None:
        back = tomllib.loads(to_text({"x": number}))["x"]
        assert np.float64(back).tobytes() == np.float64(number).tobytes()

    @pytest.mark.parametrize("value", [object(), {"inner": [None]}, [np.int64(3)]])
    def test_a_value_without_a_type_in_toml_is_refused(self, value: object) -> None:
        with pytest.raises(TypeError, match="TOML"):
            to_text({"x": value})

    def test_tables_are_commented_below_their_headers(self) -> None:
        data = {"seed": 1, "front": {"best": [1.5], "nothing": None, "by": {"a": 2}}}
        assert to_text(data, {"": "First.", "front": "One\nTwo", "front.by": "Three"}) == (
            "# First.\nseed = 1\n\n"
            "[front]\n# One\n# Two\nbest = [1.5]\n\n"
            "[front.by]\n# Three\na = 2\n"
        )

    @given(
        angles=st.lists(st.floats(-1e3, 1e3), max_size=8),
        numbers=st.lists(st.floats(allow_nan=False), max_size=4),
        name=st.text(st.characters(exclude_categories=["Cs"]), max_size=12),
        key=st.text(st.characters(exclude_categories=["Cs"]), min_size=1, max_size=6).filter(
            lambda name: not name.endswith("_deg")
        ),
    )
    def test_angles_among_all_else_are_restored_to_the_bit(
        self, angles: list[float], numbers: list[float], name: str, key: str
    ) -> None:
        data = {
            "turn": Angles(angles),
            "rows": Angles([angles, angles]),
            "numbers": numbers,
            "inner": {key: name, "below": {"yes": True, "count": 3}},
            "many": [{"angle": Angles(angle), "name": name} for angle in angles],
        }
        text = to_text(data, {"inner": "what it is"})
        tomllib.loads(text)
        back = from_text(text)
        assert repr(back["turn"]) == repr(angles) and repr(back["rows"]) == repr([angles, angles])
        assert repr(back["numbers"]) == repr(numbers)
        assert back["inner"] == data["inner"]
        assert [row["name"] for row in back["many"]] == [name] * len(angles)


class TestDegrees:
    @pytest.mark.long
    @given(st.floats(allow_nan=False, allow_infinity=False, min_value=-1e6, max_value=1e6))
    @settings(max_examples=1000)
    def test_they_restore_every_bit(self, angle: float) -> None:
        text = degrees_text(angle)
        back = radians_of(Decimal(text))
        assert np.float64(back).tobytes() == np.float64(angle).tobytes()
        assert isinstance(tomllib.loads(f"x = {text}")["x"], float)

    @pytest.mark.parametrize(
        ("text", "message"),
        [
            ("a = 1.0\na_deg = 2.0", "both 'a' and 'a_deg'"),
            ("a_deg = [1.0, true]", "a_deg: True is not a number of degrees"),
            ("a_deg = 1e9999999999999999999", "out of range"),
            ("a = " + "[" * 5000 + "]" * 5000, "nested too deep"),
        ],
    )
    def test_other_texts_are_refused(self, text: str, message: str) -> None:
        with pytest.raises(ValueError, match=message):
            from_text(text)


CELL = """\
# the arm in hall 3
[limits] # by the data sheet
upper_deg = [
  180.0, # axis 1
  95.0,  # axis 2: the hose
]
  torque = 3 # N·m

# the wall behind it
[workspace]
floor = 0.0
walls = []
"""


AXES = "180.0, # axis 1\n  95.0,"


class TestEdited:
    @pytest.mark.parametrize(
        ("name", "value", "old", "new"),
        [
            ("limits.torque", 4.5, "torque = 3 #", "torque = 4.5 #"),
            ("limits.upper_deg", [170.0, 90.0], AXES, "170.0, # axis 1\n  90.0,"),
            ("workspace.margin", 0.1, "walls = []\n", "walls = []\nmargin = 0.1\n"),
            ("limits.frame", "urdf", "N·m\n", 'N·m\nframe = "urdf"\n'),
            ("workspace.walls", [{"lower": [1.0]}], "[]", "[{lower = [1.0]}]"),
            ("workspace.floor", None, "", ""),
            ("cell.urdf", 'a "b"', "[]\n", '[]\n\n[cell]\nurdf = "a \\"b\\""\n'),
        ],
    )
    def test_comments_and_layout_stay(self, name: str, value: Any, old: str, new: str) -> None:
        changed = with_values(CELL, {name: value})
        assert changed == CELL.replace(old, new, 1)

    @pytest.mark.parametrize(
        "text", ["limits = { torque = 3, frame = 'urdf' }\n", "limits.torque = 3\nlimits.frame = 1"]
    )
    def test_a_table_needs_no_header_line(self, text: str) -> None:
        before = tomllib.loads(text)
        changed = with_values(text, {"limits.torque": 5})
        assert tomllib.loads(changed) == {"limits": {**before["limits"], "torque": 5}}

    def test_an_edit_that_would_change_another_entry_is_refused(
        self, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """A limit of the arm must not disappear because of a defect of a library."""
        dumps = tomlkit.dumps
        monkeypatch.setattr(tomlkit, "dumps", lambda document: dumps(document).replace("95.0", "9"))
        with pytest.raises(InputError, match=r"workspace\.floor cannot be changed") as caught:
            with_values(CELL, {"workspace.floor": 0.5})
        assert "[table]" in caught.value.remedy

    def test_a_value_without_a_type_in_toml_is_refused(self) -> None:
        with pytest.raises(TypeError, match="TOML"):
            with_values(CELL, {"workspace.floor": object()})
