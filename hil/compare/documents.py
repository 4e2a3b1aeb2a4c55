"""A comparison of campaigns as JSON."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

from hil.batch.messages import setup_words

from .comparison import ArmComparison
from .messages import campaign_words, comparison_lines, verdict_line


def comparison_document(comparison: ArmComparison) -> dict[str, Any]:
    """Return a comparison as JSON data, None for unknown values."""
    numbers = [
        asdict(change) | {"campaign": campaign_words(change.campaign)}
        for change in comparison.changes
    ]
    return {
        "arm": comparison.arm,
        "simulated": comparison.simulated,
        "dated": comparison.dated,
        "verdict": verdict_line(comparison.changed),
        "changed": bool(comparison.changed),
        "campaigns": [
            {
                "name": campaign_words(name),
                "folder": campaign.campaign,
                "when": campaign.when or None,
                "setup": setup_words(campaign.setup),
            }
            for name, campaign in zip(comparison.names, comparison.campaigns, strict=True)
        ],
        "parameters": [
            {name: None if value != value else value for name, value in row.items()}
            for row in numbers
        ],
        "warnings": comparison_lines(comparison.warnings),
    }
