"""A supervisor to be killed: runs a campaign over UDP on this computer and says how it went.

`python live_rig.py CAMPAIGN PORT` prints one line of JSON with the process ids when the link is up,
and one with the error when the campaign ended with one. The last records of the link, read from
its shared memory and not from the archive, are then left in `ring.npy` beside the campaign.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np

from drivers.record import RingReader
from drivers.transports.udp import UdpSpec
from hil.campaign import Campaign, stop_on_interrupt
from hil.campaign.live_link import LiveLink
from hil.errors import HilError
from hil.progress import Silent


def main() -> int:
    """Run it."""
    folder, port = Path(sys.argv[1]), int(sys.argv[2])
    campaign = Campaign.open(folder)
    spec = UdpSpec("127.0.0.1", port, "127.0.0.1")
    with stop_on_interrupt() as stop, LiveLink.open(campaign.cell, transport=spec) as link:
        say(exchange=link.exchange.pid, archive=link.archive.process.pid)
        ring = RingReader(link.exchange.ring_fd, 6, acknowledge=False)
        try:
            campaign.run(link, stop, Silent(), provenance={"simulated": "yes"}, unrehearsed=True)
        except HilError as error:
            np.save(folder.parent / "ring.npy", ring.drain())
            say(error=type(error).__name__, text=str(error))
            return error.exit_code
    return 0


def say(**facts: object) -> None:
    """One line of JSON."""
    sys.stdout.write(json.dumps(facts) + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    sys.exit(main())
