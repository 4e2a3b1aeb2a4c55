"""The 3D view: its clock everywhere, its page where `viser` is installed."""

from __future__ import annotations

import subprocess
import sys
import urllib.request
from collections.abc import Iterator
from importlib.util import find_spec
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from hil.cell import Cell
from hil.errors import InputError
from hil.view import require_viewer, show
from hil.view.scene import Playback, quaternion
from planner import plan
from sim_fixtures.ns16 import CELL_PATH

with_viewer = pytest.mark.skipif(find_spec("viser") is None, reason="viser is not installed")
without_viewer = pytest.mark.skipif(find_spec("viser") is not None, reason="viser is installed")


class TestPlayback:
    def test_time_goes_by_at_its_speed_and_halts_at_the_end(self):
        clock = Playback(2.0, speed=0.5)
        clock.advance(1.0)
        assert clock.time == 0.5
        clock.advance(30.0)
        assert clock.time == 2.0

    def test_begins_again_after_a_pause_at_the_end(self):
        clock = Playback(2.0, time=2.0, pause=1.0)
        clock.advance(0.9)
        assert clock.time == 2.0
        clock.advance(0.2)
        assert clock.time == 0.0

    def test_stands_still_while_paused(self):
        clock = Playback(2.0, time=0.3, playing=False)
        clock.advance(10.0)
        assert clock.time == 0.3

    @given(st.floats(-1e3, 1e3))
    def test_never_leaves_the_motion(self, time):
        clock = Playback(2.0)
        clock.seek(time)
        assert 0.0 <= clock.time <= 2.0


@given(st.integers(0, 10_000))
def test_a_quaternion_turns_as_its_matrix_does(seed):
    matrix = Rotation.random(rng=np.random.default_rng(seed)).as_matrix()
    w, *axis = quaternion(matrix)
    vector, axis = np.array([0.3, -1.2, 0.5]), np.array(axis)
    turned = vector + 2.0 * np.cross(axis, np.cross(axis, vector) + w * vector)  # q v q*
    np.testing.assert_allclose(turned, matrix @ vector, atol=1e-12)


@without_viewer
def test_says_what_to_install_where_there_is_no_viewer():
    with pytest.raises(InputError, match=r"--view: .*viser.*; install it with: pip install"):
        require_viewer()


def test_importing_the_view_needs_no_viewer():
    code = "import sys; sys.modules['viser'] = None; import hil.view"
    subprocess.run([sys.executable, "-c", code], check=True)


@pytest.fixture
def ns16() -> Cell:
    walls = "walls = [{lower = [1.2, 0.5, 0.0], upper = [1.6, 1.0, 0.9]}]"
    loaded = Cell.load(CELL_PATH)
    return Cell.from_texts(loaded.text.replace("walls = []", walls), loaded.urdf, loaded.path)


@pytest.fixture
def view(ns16: Cell) -> Iterator[Any]:
    away = ns16.home + np.array([0.5, 0.2, -0.3, 1.0, 0.4, 0.0])
    motion = plan(np.array([ns16.home, away]), ns16.joint_limits)
    with show(motion, ns16, open_browser=False, port=8590) as opened:
        yield opened


@with_viewer
class TestPage:
    def test_is_served_to_this_computer_alone(self, view, capfd):
        assert view.address.startswith("http://127.0.0.1:")
        with urllib.request.urlopen(view.address, timeout=10) as page:
            assert page.status == 200
        assert view._server.get_host() == "127.0.0.1"

    def test_opens_no_way_from_outside(self, view):
        assert view._server.request_share_url() is None

    def test_bodies_stand_where_forward_kinematics_puts_them(self, view, ns16):
        pin = pytest.importorskip("pinocchio")
        view.playback.playing = True
        view.advance(0.4)
        model = pin.buildModelFromXML(ns16.urdf)
        data = model.createData()
        pin.forwardKinematics(model, data, view._trajectory.sample_one(view.playback.time)[0])
        for joint, frame in enumerate(view._frames, 1):
            np.testing.assert_allclose(frame.position, data.oMi[joint].translation, atol=1e-9)
            turn = quaternion(data.oMi[joint].rotation)
            assert abs(frame.wxyz @ turn) == pytest.approx(1.0, abs=1e-9)

    def test_the_slider_shows_the_time(self, view):
        view.advance(0.25)
        assert view._slider.value == pytest.approx(view.playback.time, abs=1e-3)

    def test_prints_nothing(self, ns16, capfd):
        motion = plan(np.array([ns16.home, ns16.home + 0.1]), ns16.joint_limits)
        with show(motion, ns16, open_browser=False, port=8610):
            pass
        assert capfd.readouterr().out == ""
