"""Which targets count as one of the set-points sent last, and how many answers were lost.

The threshold is 2 motor revolutions: a target may be 0.2 off, and 0.5 from the set-point sent last.
"""

from __future__ import annotations

import numpy as np
import pytest

from drivers import Guard
from drivers.errors import MotionNotCarriedOn, NotFinite
from drivers.open_mode import REPETITIONS, SentSetPoints
from tests.drivers.rig import PERIOD, N, limits

TURNS = np.array([40.0, -30.0, 20.0, -10.0, 5.0, -2.0])
SLOW = 0.01
"""Steps of which many lie within what a target may be off."""
STANDSTILL = 5e-4
STEP = 3.9 * STANDSTILL
"""Below four times standstill nothing is sent again."""


class Sent:
    """Set-points of a joint from TURNS on, each `step` further; the other joints stand."""

    def __init__(self, step: float, depth: int = 3, count: int = 8, joint: int = 1):
        self.taken = SentSetPoints(Guard(limits(), PERIOD), depth)
        self.step = step * np.eye(N)[joint]
        self.last = TURNS
        self.taken.begin(TURNS)
        for _ in range(count):
            self.add(1.0)

    def add(self, steps: float) -> None:
        self.last = self.last + steps * self.step
        self.taken.add(self.last)

    def check(self, ahead: float, missed: int = 0, **named) -> int:
        """A target so many steps ahead of the one sent last."""
        return self.taken.check(self.last + ahead * self.step, missed, 7, **named)

    def refuses(self, ahead: float, missed: int = 0) -> bool:
        try:
            self.check(ahead, missed)
        except MotionNotCarriedOn as error:
            assert (type(error), error.joint, error.cycle) == (MotionNotCarriedOn, 1, 7)
            return True
        return False


class TestWhere:
    def test_the_target_received_first_is_the_one_held(self):
        sent = Sent(0.1, count=0)
        assert sent.check(0.0) == 0
        assert sent.check(2.0, missed=2) == 0
        assert sent.refuses(2.01)

    @pytest.mark.parametrize("way", [-1.0, 1.0])
    def test_a_tenth_of_the_threshold_off_any_of_them(self, way):
        assert not Sent(way * 0.01).refuses(19.99)
        assert Sent(way * 0.01).refuses(20.01)
        assert Sent(way * 0.01).refuses(-19.99 - 2.02)
        assert not Sent(way * 0.01).refuses(-19.99 - 2.0)

    @pytest.mark.parametrize("depth", [1, 2, 3])
    def test_one_of_so_many_back_counts_and_none_before(self, depth):
        step = 0.24
        assert not Sent(step, depth).refuses(1.0 - depth)
        assert Sent(step, depth).refuses(-depth)

    def test_a_quarter_of_the_threshold_from_the_last_whatever_was_sent(self):
        assert not Sent(0.2499).refuses(-2.0)
        assert Sent(0.2501).refuses(-2.0)
        assert not Sent(0.2499).refuses(2.0, missed=2)
        assert Sent(0.2501).refuses(2.0, missed=2)

    def test_the_last_carried_on_by_as_many_steps_as_packets_were_missed(self):
        assert Sent(0.24).refuses(1.0, missed=0)
        assert not Sent(0.24).refuses(1.0, missed=1)
        assert Sent(0.24).refuses(2.0, missed=1)
        assert not Sent(0.24).refuses(2.0, missed=2)

    def test_the_last_is_carried_on_by_fewer_steps_than_may_be_missed(self):
        assert not Sent(0.24, depth=2).refuses(1.0, missed=5)
        assert Sent(0.24, depth=2).refuses(2.0, missed=5)

    def test_carried_on_means_by_the_last_step(self):
        sent = Sent(0.01)
        sent.add(24.0)
        assert not sent.refuses(24.0, missed=1)
        sent.add(1.0)
        assert sent.refuses(24.0, missed=1)

    @pytest.mark.parametrize("value", [np.nan, np.inf])
    def test_a_target_that_is_no_number_is_named_as_such(self, value):
        target = np.where(np.arange(N) == 4, value, TURNS)
        with pytest.raises(NotFinite) as caught:
            Sent(0.0).taken.check(target, 0, 3)
        assert (caught.value.joint, caught.value.cycle) == (4, 3)

    def test_only_the_joints_asked_for_matter(self):
        sent, others = Sent(0.24), np.arange(N) != 1
        assert sent.check(9.0, where=others) == 0
        assert sent.check(-1.0, where=others) == 0
        with pytest.raises(MotionNotCarriedOn):
            sent.check(9.0, where=~others)


class TestHowMany:
    @pytest.mark.parametrize("lost", [1, 2, 3])
    def test_as_many_as_the_target_is_behind_one_too_many_included(self, lost):
        assert Sent(SLOW).check(-float(lost)) == lost

    @pytest.mark.parametrize("ahead", [1.0, 2.0])
    def test_a_target_carried_on_is_no_answer_lost(self, ahead):
        assert Sent(SLOW).check(ahead, missed=2) == 0

    def test_a_target_carried_on_past_where_the_joint_was_is_no_answer_lost(self):
        sent = Sent(SLOW)
        sent.add(1.0)
        sent.add(2.1)
        sent.add(-1.0)  # one more of these steps is a tenth of a step from two set-points ago
        assert sent.taken.check(sent.last - sent.step, 1, 7) == 0

    def test_what_other_joints_do_is_no_excuse_for_one_that_is_behind(self):
        """They stand where they were, which a target carried on is as well."""
        sent = Sent(SLOW)
        assert sent.check(-1.01, missed=1) == 1

    def test_each_counts_once_however_long_the_target_stays_behind(self):
        sent = Sent(STEP)
        counts = []
        for behind in (0.0, 1.0, 1.0, 2.0, 1.0, 2.0, 0.0, 1.0):
            counts.append(sent.check(-behind))
            sent.add(1.0)
        assert counts == [0, 1, 0, 1, 0, 1, 0, 1]

    def test_the_joint_furthest_behind_counts(self):
        sent = Sent(SLOW)
        sent.step = SLOW * np.array([0.0, 1.0, 0.0, 0.0, 1.0, 0.0])
        for _ in range(4):
            sent.add(1.0)
        target = sent.last - sent.step * np.array([0, 1, 0, 0, 2, 0])
        assert sent.taken.check(target, 0, 1) == 2

    def test_what_a_standing_joint_moves_hides_one(self):
        share = 0.999 * STANDSTILL
        assert Sent(share).check(-1.0) == 0
        assert Sent(share).check(-2.0) == 2
        assert Sent(1.01 * STANDSTILL).check(-1.0) == 1

    @pytest.mark.parametrize("way", [-1.0, 1.0])
    @pytest.mark.parametrize(("step", "lost"), [(0.0, 0), (1.0, 1)], ids=["at rest", "moving on"])
    def test_an_arm_that_comes_to_rest_behind_is_not_behind_twice(self, step, lost, way):
        """At rest a target one behind looks like the last; it is still the same answer lost."""
        sent = Sent(way * STEP)
        assert sent.check(-1.0) == 1
        sent.add(step)
        assert sent.check(0.0) == 0
        sent.add(1.0)
        assert sent.check(-1.0) == lost

    @pytest.mark.parametrize(("share", "again"), [(3.99, False), (4.01, True)])
    def test_only_a_step_that_is_not_small_is_sent_again(self, share, again):
        sent = Sent(share * STANDSTILL)
        assert sent.check(-1.0) == 1
        assert sent.taken.again is again

    def test_sent_again_each_cycle_is_one_more_until_it_is_taken(self):
        sent = Sent(SLOW)
        for _ in range(5):
            assert sent.check(-1.0) == 1
            assert sent.taken.again
            sent.taken.repeat()
        assert sent.check(0.0) == 0
        assert not sent.taken.again

    @pytest.mark.parametrize("stopping", [False, True])
    def test_behind_after_a_repetition_is_lost_or_on_the_way_to_rest_late(self, stopping):
        """Sent again, a set-point looks taken to whoever reports a cycle late."""
        sent = Sent(SLOW)
        sent.check(-1.0)
        sent.taken.repeat()
        sent.check(0.0)
        for _ in range(3):
            sent.add(1.0)
            assert sent.check(-1.0, stopping=stopping) == (not stopping)
            assert sent.taken.again is not stopping
            if not stopping:
                sent.taken.repeat()
                sent.check(0.0)

    def test_a_controller_that_never_takes_it_is_refused(self):
        sent = Sent(SLOW)
        for _ in range(REPETITIONS):
            sent.check(-1.0)
            sent.taken.repeat()
        assert sent.refuses(-1.0)

    def test_the_next_time_in_open_mode_begins_anew(self):
        sent = Sent(SLOW)
        assert sent.check(-1.0) == 1
        sent.taken.begin(TURNS)
        sent.last = TURNS
        sent.add(1.0)
        assert sent.check(-1.0) == 1
        assert sent.refuses(25.0)
