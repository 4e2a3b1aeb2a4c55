"""The delay of torques in words."""

from __future__ import annotations

from identification.estimators.delay import DelayEstimate, UndeterminedDelay


def undetermined_words(estimate: DelayEstimate) -> str:
    """Return why a delay is not determined; "" if it is."""
    match estimate.reason:
        case None:
            return ""
        case UndeterminedDelay.INSEPARABLE:
            return "the motion does not separate a delay from the other parameters"
        case UndeterminedDelay.WIDE_INTERVAL:
            return (
                f"± {estimate.half_interval * 1e3:.2g} ms (95 %): torques change too slowly or are"
                " too noisy"
            )
        case UndeterminedDelay.AT_LIMIT:
            return "the residual still decreases at the longest delay tested"
        case UndeterminedDelay.OTHER_MINIMUM:
            return f"a delay of {estimate.other * 1e3:.0f} ms explains the torques as well"


def delay_line(estimate: DelayEstimate) -> str:
    """Return the delay with its interval."""
    return f"torque delay behind the position, {_delay_words(estimate)}"


def _delay_words(estimate: DelayEstimate) -> str:
    if not estimate.determined and not estimate.significant:
        return f"all axes: not determined; {undetermined_words(estimate)}"
    half = estimate.half_interval
    differs = "" if estimate.significant or estimate.unconfirmed else "not "
    return (
        f"all axes: {estimate.delay * 1e3:.3f} ms ± {half * 1e3:.3f} ms"
        f" ({estimate.delay / estimate.cycle:.2f} ± {half / estimate.cycle:.2f} cycles),"
        f" {differs}significantly different from the {estimate.assumed * 1e3:.3g} ms assumed"
    )
