from __future__ import annotations

import numpy as np
import pytest

from identification import ShapeError
from identification.model.robot import StandardLayout

PAIRS = ((0, 1), (1, 3))
LAYOUT = StandardLayout((True, False, True, False), rotor_inertia=True, pairs=PAIRS)


def test_joints_stand_one_behind_the_other_and_couplings_last() -> None:
    assert LAYOUT.size == len(LAYOUT.names) == len(LAYOUT.units) == 46
    assert [LAYOUT.names[k] for k in LAYOUT.rotors] == ["I1m", "I2m", "I3m", "I4m"]
    assert [LAYOUT.names[k] for k in LAYOUT.couplings] == ["I12", "I24"]
    assert [LAYOUT.names[k] for k in LAYOUT.links[2][:7]] == [
        "I3xx", "I3xy", "I3xz", "I3yy", "I3yz", "I3zz", "mc3x",
    ]  # fmt: skip
    every = np.concatenate([LAYOUT.links.ravel(), LAYOUT.rotors, LAYOUT.couplings])
    assert sorted(every.tolist()) == list(range(46))


def test_what_slides_has_a_rotor_that_weighs() -> None:
    assert [LAYOUT.units[k] for k in LAYOUT.rotors] == ["kg m²", "kg", "kg m²", "kg"]
    # Torque of a turning joint per acceleration of a sliding one; force per acceleration.
    assert [LAYOUT.units[k] for k in LAYOUT.couplings] == ["kg m", "kg"]


def test_joints_of_two_digits_are_kept_apart() -> None:
    many = StandardLayout((True,) * 12, rotor_inertia=True, pairs=((0, 11), (10, 11)))
    assert many.names[-2:] == ("I1_12", "I11_12")
    assert len(set(many.names)) == many.size


def test_the_rotors_make_a_symmetric_matrix() -> None:
    matrix = LAYOUT.rotor_matrix(np.arange(46.0))
    assert np.array_equal(matrix, matrix.T)
    assert np.array_equal(np.diag(matrix), [10.0, 21.0, 32.0, 43.0])
    assert matrix[0, 1] == 44.0
    assert matrix[1, 3] == 45.0
    assert np.count_nonzero(matrix) == 8


def test_kept_parameters_are_split_by_joint() -> None:
    links, rotors, couplings = LAYOUT.split([0, 9, 10, 25, 45])
    assert links == [[0, 9], [], [3], []]
    assert rotors == [True, False, False, False]
    assert couplings == [1]


def test_without_rotors_there_are_none() -> None:
    bare = StandardLayout((True, True), rotor_inertia=False)
    assert bare.size == 20
    assert bare.rotors.shape == bare.couplings.shape == (0,)
    assert not bare.rotor_matrix(np.ones(20)).any()
    with pytest.raises(ShapeError):
        bare.rotor_matrix(np.ones(22))
