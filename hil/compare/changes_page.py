"""Page of a comparison of campaigns."""

from __future__ import annotations

from hil.base.version import software
from hil.batch.messages import setup_words
from hil.compare.comparison import (
    FALSE_ALARM_RATE,
    MIN_RELATIVE_CHANGE,
    MIN_REPETITIONS,
    ArmComparison,
)
from hil.compare.messages import campaign_words, comparison_lines, verdict_line
from hil.report.rendering import environment, page_bytes


def comparison_page(comparison: ArmComparison) -> bytes:
    """Return the comparison as one HTML file; the same input gives the same bytes."""
    rules = {
        "alarms": FALSE_ALARM_RATE,
        "least": MIN_RELATIVE_CHANGE,
        "repetitions": MIN_REPETITIONS,
    }
    template = environment().get_template("changes.html.j2")
    text = template.render(
        found=comparison,
        named=campaign_words,
        verdict=verdict_line(comparison.changed),
        notes=comparison_lines(comparison.warnings),
        setups=[setup_words(campaign.setup) for campaign in comparison.campaigns],
        rules=rules,
        software=software(),
    )
    return page_bytes(text)
