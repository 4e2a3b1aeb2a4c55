"""Picture of a rollout: position errors over the horizon, and the band of the samples."""

from __future__ import annotations

from typing import Final

from matplotlib.figure import Figure
from matplotlib.ticker import StrMethodFormatter

from hil.plots import style
from hil.report.drawing import label
from hil.rollout_result import ArmErrors, RolloutResult

_WIDTH, _HEIGHT = 9.0, 3.4  # inch
_FLOOR: Final = 1e-3  # mrad or mm, of logarithmic axes


def draw_rollout(result: RolloutResult) -> Figure:
    """Draw errors over the horizon, and the share of measured positions in the band."""
    with style.page():
        figure = Figure((_WIDTH, _HEIGHT), layout="constrained")
        errors, band = figure.subplots(1, 2, width_ratios=(3, 2))
        for index, arm in enumerate(result.sample_errors):
            name = f"{result.samples} samples of the posterior" if index == 0 else None
            errors.loglog(result.horizons, _overall(arm), color=style.RULE, label=name)
        if result.nominal is not None:
            errors.loglog(
                result.horizons, _overall(result.nominal), color=style.LIMIT, marker="o",
                label="nominal",
            )  # fmt: skip
        errors.loglog(
            result.horizons, _overall(result.identified), color=style.POSITION, marker="o",
            label="identified",
        )  # fmt: skip
        errors.set(xlabel="horizon [s]", ylabel="position error, rms of all joints [mrad or mm]")
        errors.set_xticks(result.horizons, [f"{h:g}" for h in result.horizons], minor=False)
        errors.set_xticks([], minor=True)
        errors.legend(fontsize=style.SMALL)
        errors.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
        errors.set_title(f"{label(result.cell)}: {result.windows} windows")
        band.axhspan(88.0, 99.0, color=style.RULE)
        for joint, name in enumerate(result.joint_names):
            shares = [100.0 * at[joint] for at in result.inside]
            band.plot(range(len(shares)), shares, marker="o", label=label(name))
        band.set_xticks(range(len(result.horizons)), [f"{h:g}" for h in result.horizons])
        band.set(xlabel="horizon [s]", ylabel="measured positions in the 95 % band [%]")
        band.set_ylim(0.0, 102.0)
        band.legend(fontsize=style.SMALL)
    return figure


def _overall(arm: ArmErrors) -> list[float]:
    count = range(len(arm.joints))
    return [max(1e3 * arm.overall(k), _FLOOR) for k in count]
