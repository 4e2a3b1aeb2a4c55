"""`hil compare`: compare campaigns of one arm."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from hil.base.exit_status import ExitStatus
from hil.base.files import write_into
from hil.base.one_screen import brief
from hil.base.progress import reporter as make_reporter
from hil.base.terminal_text import printable
from hil.batch.cluster import Cluster
from hil.cli.arguments import JsonOption, QuietOption, VerboseOption, print_json
from hil.compare import comparison as comparing
from hil.compare.documents import comparison_document
from hil.compare.messages import campaign_words, comparison_lines, verdict_line
from identification.text import percentage, unit_text


def compare(
    campaigns: Annotated[list[str], typer.Argument(metavar="CAMPAIGN")],
    output: Annotated[Path | None, typer.Option("--output", "-o")] = None,
    fail_on_change: bool = False,
    quiet: QuietOption = False,
    verbose: VerboseOption = False,
    json: JsonOption = False,
) -> None:
    """Compare campaigns of one arm: which friction and inertial parameters changed, by axis.

    The reference is the earliest campaign, or the first one named if not all have a recording time.
    Archives are read as by `hil batch`. Exit status 0 for any result, unless --fail-on-change
    is given.

    Options:
        campaigns: Two or more campaign folders of one arm, or folders that contain campaigns.
        output: HTML file for the report. Default: no report.
        fail_on_change: Return exit status 5 if something has changed.
    """
    reporter = make_reporter(quiet=quiet or json, messages=verbose)
    with Cluster(reporter=reporter) as cluster:
        comparison = comparing.compare(campaigns, cluster, reporter)
    if output is not None:
        from hil.compare.changes_page import comparison_page  # figures are slow to import

        write_into(output.parent, {output.name: comparison_page(comparison)})
    if json:
        print_json(comparison_document(comparison))
    else:
        lines = [] if quiet else _lines(comparison)
        lines = [f"{verdict_line(comparison.changed)}.", *lines]
        if output is not None and not quiet:
            lines.append(f"{output}: every parameter before and after, for a browser")
        for line in lines if verbose else brief(lines):
            typer.echo(printable(line))
    if fail_on_change and comparison.changed:
        raise typer.Exit(ExitStatus.NEGATIVE_RESULT)


def _lines(comparison: comparing.ArmComparison) -> list[str]:
    """Return the changes, the most significant first, and what limits the comparison."""
    changes = [
        f"{change.parameter} in {campaign_words(change.campaign)}:"
        f" {change.after:.4g} instead of {change.before:.4g} {unit_text(change.unit)}, "
        f"change {change.change:+.3g} ± {change.half:.2g} (95 %), p {change.p_value:.1g}"
        for change in sorted(comparison.changed, key=lambda change: change.p_value)
    ]
    notes = [f"note: {line}" for line in comparison_lines(comparison.warnings)]
    return [*changes, *_scope(comparison), *notes]


def _scope(comparison: comparing.ArmComparison) -> list[str]:
    """Return what was compared with what, and how small a change of friction shows."""
    reference, *others = comparison.names
    kinds = [change.kind for change in comparison.changes if change.campaign == others[0]]
    inertial, friction = kinds.count("inertia"), kinds.count("friction")
    lines = [
        f"{', '.join(map(campaign_words, others))} compared with {campaign_words(reference)}:"
        f" {inertial} inertial parameters and the "
        f"friction of {friction} joints"
    ]
    if known := comparison.known_friction:
        least, most = known[0], known[-1]
        lines.append(
            "95 % interval of a change of friction: "
            f"± {percentage(least.relative_half, 2)} in {least.axis} to "
            f"± {percentage(most.relative_half, 2)} in {most.axis}; "
            f"a change below {percentage(comparing.MIN_RELATIVE_CHANGE)} is not reported"
        )
    return lines
