"""The 3D view: its page where `viser` is installed."""

from __future__ import annotations

import subprocess
import sys
import urllib.request
from collections.abc import Iterator
from importlib.util import find_spec
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from hil.cell import Cell
from hil.errors import InputError
from hil.view import quaternion, require_viewer, show
from planner import plan
from sim_fixtures.ns16 import CELL_PATH

HAS_VIEWER = find_spec("viser") is not None


@given(st.integers(0, 10_000))
def test_a_quaternion_turns_as_its_matrix_does(seed):
    matrix = Rotation.random(rng=np.random.default_rng(seed)).as_matrix()
    w, *axis = quaternion(matrix)
    vector, axis = np.array([0.3, -1.2, 0.5]), np.array(axis)
    turned = vector + 2.0 * np.cross(axis, np.cross(axis, vector) + w * vector)  # q v q*
    np.testing.assert_allclose(turned, matrix @ vector, atol=1e-12)


@pytest.mark.skipif(HAS_VIEWER, reason="viser is installed")
def test_says_what_to_install_where_there_is_no_viewer():
    with pytest.raises(InputError, match=r"--view: .*viser.*; install it with: pip install"):
        require_viewer()


def test_importing_the_view_needs_no_viewer():
    code = "import sys; sys.modules['viser'] = None; import hil.view"
    subprocess.run([sys.executable, "-c", code], check=True)


@pytest.fixture
def ns16() -> Cell:
    wall = [{"lower": [1.2, 0.5, 0.0], "upper": [1.6, 1.0, 0.9]}]
    return Cell.load(CELL_PATH).with_values({"workspace.walls": wall})


@pytest.fixture
def view(ns16: Cell, capfd: pytest.CaptureFixture[str]) -> Iterator[Any]:
    """A page; nothing of it is printed."""
    away = ns16.home + np.array([0.5, 0.2, -0.3, 1.0, 0.4, 0.0])
    motion = plan(np.array([ns16.home, away]), ns16.joint_limits)
    with show(motion, ns16, open_browser=False, port=8590) as opened:
        yield opened
    assert capfd.readouterr().out == ""


@pytest.mark.skipif(not HAS_VIEWER, reason="viser is not installed")
class TestPage:
    def test_is_served_to_this_computer_alone(self, view):
        assert view.address.startswith("http://127.0.0.1:")
        with urllib.request.urlopen(view.address, timeout=10) as page:
            assert page.status == 200
        assert view._server.get_host() == "127.0.0.1"
        assert view._server.request_share_url() is None

    def test_bodies_stand_where_forward_kinematics_puts_them(self, view, ns16):
        view.advance(0.4)
        assert view.time == view._slider.value == pytest.approx(0.4)
        model = pin.buildModelFromXML(ns16.urdf)
        data = model.createData()
        pin.forwardKinematics(model, data, view._trajectory.sample_one(view.time)[0])
        for joint, frame in enumerate(view._frames, 1):
            np.testing.assert_allclose(frame.position, data.oMi[joint].translation, atol=1e-9)
            turn = quaternion(data.oMi[joint].rotation)
            assert abs(frame.wxyz @ turn) == pytest.approx(1.0, abs=1e-9)

    def test_begins_again_at_the_end_and_rests_while_paused(self, view):
        view.advance(view._trajectory.duration + 0.1)
        assert view.time == pytest.approx(0.1)
        view.playing = False
        view.advance(1.0)
        assert view.time == pytest.approx(0.1)
