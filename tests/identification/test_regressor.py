"""The regressor, and blocks of time of a factor."""

import gc
import weakref
from dataclasses import replace

import numpy as np
import pytest

from identification.factor.factor import Factor, joined
from identification.model.regressor import CHUNK
from identification.model.robot import RobotModel
from identification.selection.essential import eliminate
from sim_fixtures.ns16 import urdf_text
from tests.identification.robots import joint, robot
from tests.identification.two_link import MODEL, a_motion, coloured, recording


@pytest.fixture(scope="module")
def model():
    return RobotModel.from_urdf(urdf_text())


def states(m, seed=3):
    q, qd, qdd = np.random.default_rng(seed).uniform(-3.0, 3.0, (3, m, 6))
    return q, qd, qdd


class TestRegressor:
    def test_blocks_have_only_columns_that_act_on_the_joint(self, model):
        regressor = model.regressor(*states(50))
        both = zip(regressor.blocks, regressor.columns, strict=True)
        for number, (block, columns) in enumerate(both, start=1):
            names = [model.parameter_names[c] for c in columns]
            assert block.shape == (50, len(names))
            assert len(set(names)) == len(names)
            link = [int("".join(filter(str.isdigit, n.split("_")[-1]))) for n in names]
            assert min(link) >= number, "a link that the joint does not move"
            alone = [n for n in names if "_" in n or (n.endswith("m") and n[0] == "I")]
            assert all(str(number) in n for n in alone)
        # the last joint: link, rotor, friction
        assert len(regressor.columns[5]) == 8 + 3

    def test_a_prismatic_joint_has_no_inertia_columns(self):
        links = (f'<link name="{name}"/>' for name in "abc")
        slide = joint("s", "a", "b", "1 0 0", "prismatic")
        urdf = robot(*links, slide, joint("t", "b", "c", "0 1 0", "continuous"))
        model = RobotModel.from_urdf(urdf)
        random = np.random.default_rng(0).normal(size=(3, 4, 2))
        regressor = model.regressor(*random)
        names = [{model.parameter_names[c] for c in columns} for columns in regressor.columns]
        assert names[0] == {"m1", "mc2x", "mc2z", "f0_1", "f1_1", "f2_1"}
        assert names[1] == {"I2yy", "mc2x", "mc2z", "f0_2", "f1_2", "f2_2"}

    @pytest.mark.parametrize("m", [0, 1, 2, 63, 65, CHUNK - 1, CHUNK, CHUNK + 1, 2 * CHUNK + 77])
    def test_samples_are_independent(self, model, m):
        q, qd, qdd = states(m)
        whole = model.regressor(q, qd, qdd)
        assert [len(block) for block in whole.blocks] == [m] * 6
        for t in {0, m // 2, m - 1} if m else ():
            alone = model.regressor(q[t : t + 1], qd[t : t + 1], qdd[t : t + 1])
            for long, short in zip(whole.blocks, alone.blocks, strict=True):
                assert np.allclose(long[t], short[0], rtol=1e-13, atol=1e-13)

    def test_threads_do_not_share_working_arrays(self, model):
        first, second = states(300, seed=1), states(300, seed=2)
        alone = [np.concatenate([b.copy() for b in rows]) for _, rows in model.plan.chunks(*first)]
        together = []
        for (_, rows), _ in zip(model.plan.chunks(*first), model.plan.chunks(*second), strict=True):
            together.append(np.concatenate([b.copy() for b in rows]))
        assert np.array_equal(np.hstack(alone), np.hstack(together))

    @pytest.mark.parametrize("angle", [0.0, np.pi / 2, np.pi, -np.pi, 1e4])
    def test_it_is_continuous_at_all_angles(self, model, angle):
        # tan(q / 2), from which the rotation is computed, has a pole at pi
        q, qd, qdd = states(3)
        q[:] = angle
        nearby = model.regressor(q + 1e-9, qd, qdd)
        for at, near in zip(model.regressor(q, qd, qdd).blocks, nearby.blocks, strict=True):
            assert np.all(np.isfinite(at))
            assert np.allclose(at, near, atol=1e-6)

    def test_working_arrays_are_freed_with_the_model(self):
        """Without the cycle collector, which may run minutes later."""
        model = RobotModel.from_urdf(urdf_text())
        model.regressor(*states(CHUNK))
        plan = weakref.ref(model.plan)
        gc.disable()
        try:
            del model
            assert plan() is None
        finally:
            gc.enable()


@pytest.fixture(scope="module")
def samples():
    motion = a_motion(5.0)
    return recording(coloured(np.random.default_rng(7), 1000, 5e-3, 0.02), motion)


class TestBlocksOfTime:
    def test_blocks_can_be_selected_joined_and_merged(self, samples):
        phase = Factor.by_time(MODEL, samples)
        half = len(phase) // 2
        again = joined([phase.blocks(slice(0, half)), phase.blocks(slice(half, None))])
        weights = np.array([0.5, 2.0])
        np.testing.assert_array_equal(again.by_block(weights), phase.by_block(weights))
        dense = np.tensordot(weights, phase.gram, axes=1)
        for length in (1, 3, len(phase)):
            merged = phase.merged(length)
            assert len(merged) == -(-len(phase) // length)
            np.testing.assert_allclose(merged.by_block(weights).sum(axis=0), dense, rtol=1e-12)
        order = np.array([5, 0, 3])
        place = np.append(order, MODEL.n_parameters)
        some = phase.restricted(order)
        assert some.parameter_names == tuple(MODEL.parameter_names[k] for k in order)
        np.testing.assert_allclose(
            some.by_block(weights), phase.by_block(weights)[:, place[:, None], place], rtol=1e-12
        )

    def test_blocks_without_rows_change_nothing(self, samples):
        late = replace(samples, origin=samples.origin - 3.0)
        phase, same = (Factor.by_time(MODEL, one) for one in (late, samples))
        assert len(phase) == len(same) + 24
        assert len(phase.occupied()) == len(same)
        training = eliminate(MODEL, phase, same).estimate
        assert training.names == eliminate(MODEL, same, same).estimate.names
