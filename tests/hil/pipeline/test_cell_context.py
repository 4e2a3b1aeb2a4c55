"""Clock, wrapped angles, friction law and resolution of recordings, as facts of a verdict."""

from types import SimpleNamespace

import numpy as np
import pytest

from hil.pipeline.cell_context import _friction_law, _resolution, _sampling_rate, grid_step
from hil.pipeline.options import friction_from
from identification.model.friction import FrictionLaw
from identification.model.messages import law_option
from identification.selection.questions import LOAD
from identification.selection.settings import Choice
from identification.signals.angle_wraps import (
    UNWRAPPED,
    unwrap,
    unwrapped,
)
from identification.signals.recording import (
    Recording,
)
from identification.signals.samples import Preprocessing
from identification.validation.finding_messages import Naming, worded
from tests.identification.two_link import MODEL, as_samples, one_sine

TIME = np.arange(0.0, 20.0, 0.01)
TURNING = 2.5 * np.sin(0.4 * TIME) + 2.0 * np.sin(0.13 * TIME)  # rad, beyond half a turn
SWINGING = 0.8 * np.sin(0.7 * TIME)
ANGLES = np.column_stack([SWINGING, TURNING])


class TestWrappedAngles:
    @pytest.mark.parametrize("lowest", [-np.pi, 0.0])
    def test_they_are_unwrapped(self, lowest):
        wrapped = np.mod(ANGLES[:, 1] - lowest, 2.0 * np.pi) + lowest
        assert np.abs(np.diff(wrapped)).max() > 6.0
        angles = unwrap(np.column_stack([SWINGING, wrapped]))
        turns = (angles[:, 1] - TURNING) / (2.0 * np.pi)
        np.testing.assert_allclose(turns, np.rint(turns[0]), atol=1e-12)
        np.testing.assert_array_equal(angles[:, 0], SWINGING)

    def test_the_joints_are_noted(self):
        wrapped = np.mod(ANGLES + np.pi, 2.0 * np.pi) - np.pi
        recording = unwrapped(Recording(TIME, wrapped, ("swing", "turn")))
        assert recording.provenance[UNWRAPPED] == "turn"

    def test_others_keep_every_bit(self):
        recording = Recording(TIME, ANGLES, ("swing", "turn"))
        assert unwrapped(recording) is recording

    @pytest.mark.parametrize("size", [-3.4, 4.5, 0.2])
    def test_a_jump_of_another_size_stays(self, size):
        """Such as a glitch to zero."""
        jumped = ANGLES.copy()
        jumped[800:805, 1] += size
        assert unwrap(jumped) is jumped

    def test_a_gap_alone_is_no_turn(self):
        """The arm may have turned meanwhile."""
        moved = ANGLES.copy()
        moved[1000:, 1] += 2.0 * np.pi
        assert unwrap(moved, np.arange(len(TIME)) == 1000) is moved


def friction_findings(stated, law, chosen=1):
    """Findings about the friction of recordings that state a law, fitted with another."""
    table = SimpleNamespace(**stated.table())
    cell = SimpleNamespace(
        model=SimpleNamespace(friction=SimpleNamespace(laws=(law,))),
        stated=SimpleNamespace(robot=SimpleNamespace(friction=table)),
    )
    choices = (Choice(LOAD, (), (0.2, 0.1), chosen),)
    prepared = SimpleNamespace(
        settings=SimpleNamespace(choices=choices), sources=SimpleNamespace(cell=cell)
    )
    return [*_friction_law(prepared)]


class TestFrictionLaw:
    BASIC = FrictionLaw(third=None, offset=True)

    def test_a_term_that_nobody_stated_is_said(self):
        (finding,) = friction_findings(self.BASIC, self.BASIC.changed({"load": True}))
        assert (finding.key, finding.level) == ("chosen friction law", "information")
        assert finding.values == {"law": self.BASIC.changed({"load": True}), "stated": self.BASIC}

    @pytest.mark.parametrize("stated", [{"third": "quadratic"}, {"stribeck": 0.1}, {"load": True}])
    def test_a_stated_term_that_goes_is_a_warning(self, stated):
        (finding,) = friction_findings(self.BASIC.changed(stated), self.BASIC)
        assert finding.level == "doubtful"
        terms = {"quadratic": "quadratic", 0.1: "stribeck=0.1", True: "load"}
        (term,) = stated.values()
        option = f"--friction coulomb,viscous,{terms[term]},offset`"
        assert option in worded(finding, Naming()).next_step

    def test_coulomb_friction_that_reverses_smoothly_is_kept(self):
        (finding,) = friction_findings(self.BASIC, self.BASIC.changed({"tanh": 0.05}))
        assert finding.key == "chosen friction law"

    def test_the_option_in_the_next_step_gives_the_stated_law(self):
        stated = FrictionLaw(third="cubic", stribeck=0.1, load=True, asymmetric=True, offset=True)
        assert stated.changed(friction_from(law_option(stated))) == stated

    def test_the_stated_law_is_not_mentioned(self):
        assert friction_findings(self.BASIC, self.BASIC, chosen=0) == []


class TestResolution:
    def test_it_is_the_step_of_the_grid(self):
        assert grid_step(np.rint(SWINGING / 3e-4) * 3e-4) == pytest.approx(3e-4)

    def test_positions_in_double_precision_have_none(self):
        assert grid_step(SWINGING) is None
        noise = 1e-4 * np.random.default_rng(1).standard_normal(len(TIME))
        assert grid_step(SWINGING + noise) is None

    @pytest.mark.parametrize(("step", "named"), [(2e-4, True), (5e-5, False)])
    def test_it_is_coarse_beyond_the_presliding_displacement(self, step, named):
        """At the ends of a slow motion its rounding decides the direction of friction."""
        law = FrictionLaw(third=None, offset=True, presliding=1e-4)
        model = MODEL.with_friction_laws((law, law))
        time = np.arange(0.0, 20.0, 1e-3)
        motion = one_sine(time, size=(0.05, 0.05))
        samples = as_samples(
            model, motion, np.zeros((len(time), 2)), usable=np.ones((len(time), 2), dtype=np.bool_),
            position_bandwidth=np.full(2, 0.5),
        )  # fmt: skip
        positions = np.rint(motion.position / step) * step
        recording = Recording(time, positions, ("shoulder", "elbow"))
        cell = SimpleNamespace(joint_names=("shoulder", "elbow"), model=model)
        sources = SimpleNamespace(cell=cell, training=[SimpleNamespace(recording=recording)])
        findings = [*_resolution(SimpleNamespace(sources=sources, fitted=[samples]))]
        assert [finding.key for finding in findings] == ["coarse positions at rest"] * named
        if named:
            assert findings[0].joints == (0, 1)
            assert findings[0].each["step"] == pytest.approx((2e-4, 2e-4))
            assert findings[0].values["presliding"] == 1e-4


@pytest.mark.parametrize(
    ("every", "bandwidth", "named"), [(1, None, False), (20, None, True), (20, 5.0, False)]
)
def test_a_sampling_rate_that_folds_noise_is_named(every, bandwidth, named):
    """At 50 Hz, not at 1 kHz, nor where the torque has a low-pass."""
    time = np.arange(0.0, 20.0, 1e-3)
    motion = one_sine(time)
    torque = MODEL.torque(np.ones(MODEL.n_parameters), motion)
    noise = np.random.default_rng(1).standard_normal(torque.shape)
    torque += 0.5 * torque.std(axis=0) * (2.0 * noise + np.sin(5.0 * time)[:, None])
    rows = slice(None, None, every)
    samples = as_samples(MODEL, motion.rows(rows), torque[rows])
    prepared = SimpleNamespace(
        settings=SimpleNamespace(
            preprocessing=Preprocessing(rigid_bandwidth=10.0, torque_bandwidth=bandwidth)
        ),
        training=[samples],
        sources=SimpleNamespace(cell=SimpleNamespace(model=MODEL)),
    )
    estimate = SimpleNamespace(values=np.ones(MODEL.n_parameters))
    findings = [*_sampling_rate(prepared, estimate)]
    assert [finding.key for finding in findings] == ["folded noise"] * named
    if named:
        assert findings[0].values["rate"] == pytest.approx(50.0)
