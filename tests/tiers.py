"""Which tests run when: at every change, at every change of what drives an arm, or with all.

`make test` runs those of no tier, `make test-safety` those of "safety", `make test-all` all.
"""

from __future__ import annotations

from pathlib import Path, PurePosixPath
from typing import Final, Literal

Tier = Literal["safety", "long"]

_ROOT: Final = Path(__file__).parent

SAFETY: Final = (
    "disk",
    "drivers",
    "endurance",
    "fuzz/test_corpora.py",
    "hil/test_campaign.py",
    "hil/test_live_link.py",
    "hil/test_supervision.py",
    "hil/test_move.py",
    "hil/test_run.py",
    "process_death",
    "simulate",
    "untrusted",
    "test_controller_variants.py",
    "test_fault_matrix.py",
)
"""Folders and files on the way to the controller, and of what breaks it."""

LONG: Final = (
    "benchmarks",
    "docs/test_commands.py",
    "docs/test_typed_pages.py",
    "fuzz",
    "hil/test_any_robot.py",
    "hil/test_archive_process.py",
    "hil/test_batch.py",
    "hil/test_batch_cluster.py",
    "hil/test_changes.py",
    "hil/test_campaign_day.py",
    "hil/test_campaign_plan.py",
    "hil/test_cli.py",
    "hil/test_design_command.py",
    "hil/test_design_given.py",
    "hil/test_design_picture.py",
    "hil/test_design_result.py",
    "hil/test_identify.py",
    "hil/test_new_cell.py",
    "hil/test_one_sided_errors.py",
    "hil/test_payload_command.py",
    "hil/test_plan_command.py",
    "hil/test_record_command.py",
    "hil/test_rehearsal.py",
    "hil/test_report.py",
    "hil/test_report_browser.py",
    "hil/test_rollout.py",
    "hil/test_screen.py",
    "hil/test_simulate.py",
    "hil/test_study.py",
    "hil/test_testing_plugin.py",
    "hil/test_trajectory_files.py",
    "hil/test_viewers.py",
    "identification/test_gradient.py",
    "identification/test_instrumental.py",
    "identification/test_selection.py",
    "identification/test_payload.py",
    "identification/test_search.py",
    "identification/test_torque_scale.py",
    "identification/test_verdict.py",
    "independent",
    "planner/test_interpolator.py",
    "planner/test_worker.py",
)
"""Files that take too long for every change."""

QUICK: Final = (
    "drivers/test_can_profile.py",
    "drivers/test_can_transport.py",
    "drivers/test_captures.py",
    "drivers/test_guard.py",
    "drivers/test_packets.py",
    "drivers/test_session_motion.py",
    "drivers/test_simulated_transport.py",
    "drivers/test_states.py",
    "drivers/test_session_start.py",
    "drivers/test_udp.py",
)
"""Files of these folders that run at every change all the same: packets, guard and transports."""


def tier_of(path: Path) -> Tier | None:
    """The tier of a test file; None for those that run at every change."""
    place = PurePosixPath(path.relative_to(_ROOT).as_posix())
    if _within(place, QUICK):
        return None
    if _within(place, SAFETY):
        return "safety"
    return "long" if _within(place, LONG) else None


def _within(place: PurePosixPath, names: tuple[str, ...]) -> bool:
    return any(place.is_relative_to(name) for name in names)
