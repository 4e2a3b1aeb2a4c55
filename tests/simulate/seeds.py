"""Seeds that fail."""

from __future__ import annotations

from tests.simulate.many import stage_folder
from tests.simulate.scenes import NEIGHBOURS
from tests.simulate.verdicts import Stage


def failures(group: int) -> list[str]:
    """Play the seeds of a group; a sentence for each law that was broken, with what to type."""
    with stage_folder() as root:
        stage = Stage(root)
        return [
            f"python -m tests.simulate --seed {seed}: {law}: {text}"
            for seed in range(group * NEIGHBOURS, (group + 1) * NEIGHBOURS)
            for law, text in stage.verdict(seed, shrink=False).broken
        ]
