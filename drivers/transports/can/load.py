"""Bus loads as a table: ``python -m drivers.transports.can.load``."""

from __future__ import annotations

import sys

from drivers.transports.can.bus_load import LOAD_LIMIT, BusRates


def table() -> str:
    """Loads of both profiles at both cycles, as text."""
    lines = ["profile  axes  frames  cycle   load without stuffing  worst stuffing"]
    for profile, axes in (("fd", (6,)), ("classic", (1, 2, 3, 4, 5, 6))):
        rates = BusRates("fd" if profile == "fd" else "classic")
        for n_axes in axes:
            for period in (0.001, 0.002):
                unstuffed = rates.load(n_axes, period, stuffed=False)
                worst = rates.load(n_axes, period)
                verdict = "fits" if worst <= LOAD_LIMIT else "refused"
                lines.append(
                    f"{profile:8} {n_axes:4}  {len(rates.cycle_payloads(n_axes)):6}  "
                    f"{1e3 * period:.0f} ms  {100 * unstuffed:18.1f} %  {100 * worst:13.1f} %  "
                    f"{verdict}"
                )
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    sys.stdout.write(table())
