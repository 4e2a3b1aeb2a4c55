"""The study's statistics: what other motions and other repetitions would have changed."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import stats

from hil.study.campaigns import Execution, Plans
from hil.study.results import ComparisonResult
from hil.study.searches import AP, B0, A, B, Found, printed_sines
from hil.study.statistics import (
    FEWEST,
    bands_of,
    compared_on,
    corrected,
    spread,
    verdict_of,
)
from hil.study.tables import compared_pairs
from tests.hil.study_numbers import flagged, forms_of

Array = NDArray[np.float64]


def grams(motions: int, n: int, seed: int = 0) -> list[Array]:
    """Grams (n + 1, n + 1) of [Phi | tau] for torque that parameters of 0 predict exactly."""
    random = np.random.default_rng(seed)
    tables = random.standard_normal((motions, 40, n)) * random.uniform(1, 3, (motions, 1, 1))
    return [np.pad(table.T @ table, (0, 1)) for table in tables]


def by_hand(first: Array, second: Array, some: list[Array]) -> float:
    """Mean log ratio of the errors of two estimates (p,)."""
    ratios = [second @ g[:-1, :-1] @ second / (first @ g[:-1, :-1] @ first) for g in some]
    return float(0.5 * np.log(ratios).mean())


# Quadratic forms


def test_a_form_gives_the_error_of_any_estimate_and_of_any_mean_of_estimates() -> None:
    random = np.random.default_rng(1)
    phi, tau = random.standard_normal((50, 3)), random.standard_normal(50)
    table = np.column_stack([phi, tau])
    forms = forms_of([table.T @ table])
    values = random.standard_normal((4, 3))
    left = np.linalg.norm(tau - phi @ values.mean(axis=0))
    # The torque of these made-up motions is 1.
    assert forms.overall(values.mean(axis=0)) == pytest.approx([left])
    assert np.sqrt(forms.torque_kernels(values).mean()) == pytest.approx(left)
    one_joint = np.sqrt(forms.torque_kernels(values, 0).mean())
    assert one_joint == pytest.approx(left / np.sqrt(2.0))
    away = np.linalg.norm(phi @ (values.mean(axis=0) - 1.0))
    assert forms.own(values.mean(axis=0), np.ones(3)) == pytest.approx([away])
    assert np.sqrt(forms.own_kernels(values, np.ones(3)).mean()) == pytest.approx(away)


# Motions and repetitions drawn


def test_with_repetitions_all_alike_the_motions_alone_make_the_spread() -> None:
    random = np.random.default_rng(3)
    logs = random.normal(0.1, 0.3, 12)
    same = np.ones((12, 4, 4))
    found = spread(same, same * np.exp(2.0 * logs)[:, None, None], drifts=False, seed=0)
    assert found is not None
    assert found.freedom == pytest.approx(11.0)
    # A standard deviation of 4000 draws is known to about 1 %.
    assert found.error == pytest.approx(stats.sem(logs), rel=0.05)


def test_what_is_the_noise_of_the_estimates_does_not_vanish_with_more_motions() -> None:
    few, many = (
        spread(
            *(forms_of(grams(motions, 6)).torque_kernels(flagged(k, 6, 5, 0.2)) for k in (0, 1)),
            drifts=False,
            seed=0,
        )
        for motions in (10, 160)
    )
    assert few is not None and many is not None
    assert many.error > 0.5 * few.error  # over motions alone it would fall to a quarter


@pytest.mark.parametrize("repetitions", [3, 10])
@pytest.mark.parametrize("off", [0.0, 3.0])
def test_a_method_beside_itself_is_seldom_told_to_differ(repetitions: int, off: float) -> None:
    trials, level, told = 60, 0.95, 0
    random, some = np.random.default_rng(4), grams(10, 12)
    forms = forms_of(some)
    for trial in range(trials):
        values = [off + random.standard_normal((repetitions, 12)) for _ in range(2)]
        found = spread(*map(forms.torque_kernels, values), drifts=False, seed=trial)
        assert found is not None
        ratio = by_hand(values[0].mean(axis=0), values[1].mean(axis=0), some)
        told += abs(ratio) > found.half_width(level)
    # At 5 %, or less, so many are exceeded once in 1000 times.
    assert told <= stats.binom(trials, 1.0 - level).ppf(0.999)


def test_a_difference_that_is_there_is_told_when_repetitions_tell_it() -> None:
    forms = forms_of(grams(10, 12))
    random = np.random.default_rng(5)
    near, far = (off + 0.02 * random.standard_normal((10, 12)) for off in (1.0, 1.2))
    inner = forms.torque_kernels(near), forms.torque_kernels(far)
    one = compared_on("fly-by", ("a", "b"), inner, drifts=False)
    assert one.ratio == pytest.approx(1.2, rel=0.02)
    assert one.low is not None and one.low > 1.15
    assert (one.verdict, one.repetitions) == ("worse", [10, 10])
    back = compared_on("fly-by", ("b", "a"), inner[::-1], drifts=False)
    assert back.verdict == "better"
    zero = np.zeros(12)
    own_errors = forms.own_kernels(near, zero), forms.own_kernels(far, zero)
    own = compared_on("fly-by", ("a", "b"), own_errors, drifts=False)
    assert own.ratio == pytest.approx(one.ratio)  # these torques are those of parameters of 0


def test_repetitions_like_their_neighbours_are_drawn_in_blocks() -> None:
    forms = forms_of(grams(10, 4))
    random = np.random.default_rng(6)
    slow = np.repeat(random.standard_normal((9, 4)), 3, axis=0)
    other = 1.0 + random.standard_normal((27, 4))
    inner = forms.torque_kernels(1.0 + slow), forms.torque_kernels(other)
    single, blocks = (spread(*inner, drifts=drifts, seed=0) for drifts in (False, True))
    assert single is not None and blocks is not None
    assert blocks.error > 1.1 * single.error
    assert blocks.freedom < single.freedom


@pytest.mark.parametrize(("repetitions", "motions"), [(FEWEST - 1, 10), (1, 10), (5, 1)])
def test_too_few_repetitions_or_motions_tell_nothing(repetitions: int, motions: int) -> None:
    forms = forms_of(grams(motions, 4))
    a, b = (forms.torque_kernels(flagged(k, 4, repetitions, 0.01)) for k in range(2))
    one = compared_on("fly-by", ("a", "b"), (a, b), drifts=False)
    assert (one.verdict, one.low, one.high, one.error) == ("too few", None, None, None)
    assert not one.differs


# Verdicts


@pytest.mark.parametrize(
    ("ratio", "low", "high", "verdict"),
    [
        (0.9, 0.8, 0.99, "better"),
        (0.985, 0.98, 0.99, "slightly better"),
        (0.9, 0.8, 1.0, "none"),
        (1.01, 1.001, 1.02, "slightly worse"),
        (1.3, 1.1, 1.5, "worse"),
        (1.3, None, None, "too few"),
    ],
)
def test_the_verdict_is_that_of_the_interval(
    ratio: float, low: float | None, high: float | None, verdict: str
) -> None:
    assert verdict_of(ratio, low, high) == verdict


def compared(ratio: float, error: float) -> ComparisonResult:
    return ComparisonResult(
        motion_class="fly-by", joint=None, first="a", second="b", motions=10, repetitions=[5, 5],
        ratio=ratio, error=error, freedom=8.0, level=0.95, low=None, high=None, verdict="none",
        wins=5, p_value=0.01, p_corrected=0.01,
    )  # fmt: skip


def test_in_a_larger_table_intervals_are_wider_and_verdicts_follow_them() -> None:
    error = 0.1 / stats.t.ppf(0.985, 8.0)  # leaves out 1 at 97 %
    (alone,) = corrected([compared(np.exp(0.1), error)])
    among = corrected([compared(np.exp(0.1), error)] * 4)
    assert (alone.level, alone.verdict) == (0.95, "worse")
    assert (among[0].level, among[0].verdict) == (0.9875, "none")
    assert alone.low is not None and alone.low > 1.0
    assert among[0].low is not None and among[0].low < 1.0
    assert [one.p_corrected for one in among] == pytest.approx([0.04] * 4)


def test_the_printed_sines_are_set_beside_b_alone() -> None:
    assert compared_pairs([A, B, B0]) == [(A, B), (A, B0), (B, B0)]
    assert compared_pairs([A, B, B0, AP]) == [(A, B), (A, B0), (B, B0), (AP, B)]


# Ablations


def test_the_band_holds_what_other_repetitions_of_one_motion_give() -> None:
    forms, values = forms_of(grams(5, 4)), flagged(0, 4, 6, 0.1)
    found = bands_of("b", values, 1, {"fly-by": forms}, np.zeros(4), values[0])
    bands = {one.quantity: one for one in found}
    singles = [float(np.median(forms.overall(one))) for one in values]
    assert (bands["error"].low, bands["error"].high) == pytest.approx((min(singles), max(singles)))
    assert bands["error"].subsets == 6
    assert bands["own"].low == pytest.approx(bands["error"].low)
    assert bands["parameter_error"].low <= 1.0 <= bands["parameter_error"].high
    assert bands_of("b", values, 6, {"fly-by": forms}, np.zeros(4), values[0]) == []
    assert {one.quantity for one in bands_of("b", values, 3, {"x": forms}, None, values[0])} == {
        "error"
    }


def found(**log10_det: float) -> dict[str, Found]:
    """Searches of method A with what they found; names with underscores."""
    return {
        key.replace("_", "-"): cast(
            Found,
            SimpleNamespace(excitation=SimpleNamespace(criteria=SimpleNamespace(log10_det=d))),
        )
        for key, d in log10_det.items()
    }


def test_the_papers_own_sines_are_a_method_where_they_are_not_the_best() -> None:
    both = {"a_middle": 60.0, "a_home": 65.0}
    assert printed_sines(found(**both, a_middle_fast=80.0)) == "a-home"
    assert printed_sines(found(**both, a_middle_fast=62.0)) is None
    assert printed_sines(found(a_home_fast=62.0)) is None  # another arm has no print


def test_an_arm_that_does_not_bear_the_papers_sines_still_has_a_study(tmp_path: Path) -> None:
    one = cast(Execution, SimpleNamespace(root=tmp_path / AP))
    plans = Plans("a-middle-fast", "a-home", {}, {"plain": {AP: one}}, [])
    left = plans.without({one.root: "joint 2: drive fault"})
    assert left.executions == {"plain": {}}
    assert left.missing == ["a-printed could not be run: joint 2: drive fault"]
