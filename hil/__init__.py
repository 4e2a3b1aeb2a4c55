"""Hardware-in-the-loop identification of an industrial robot's dynamics.

A campaign, from a cell file to a result:

- `Cell`: a robot, its drive train, controller and limits, as a cell file describes them.
- `Campaign`: a folder with one plan on one cell: rehearse, run, identify, report.
- `simulated_controller`: a controller with the cell's arm, to talk to.
- `straight_way`, `send`: a straight motion in joint space; send one motion and archive it.
- `Stop`, `stop_on_interrupt`: bring the arm to rest on its path, also on Ctrl-C.
- `reporter`, `Silent`: progress bars, or none.

From archives and other people's recordings:

- `open_archive`, `open_recording`: what is in an archive; the same as samples in SI units.
- `import_log`, `import_rosbag2`: archives from text, arrays and bags of other programs.
- `Robot`, `ColumnMap`: what an import has to know of the robot, and of the columns.
- `identify_archives`, `identify_campaign`: estimate, prediction and verdict.
- `Options`: how to estimate, where that is not to be chosen automatically.
- `Results`: what `results.json` holds.
- `reidentify`: every arm below some folders, campaign by campaign.
- `export_model`, `replay_motions`: the arm for simulators; held-out motions simulated forwards.
- `run_study`: the paper's comparison of two methods.
- `errors`: what goes wrong, with file, field and remedy.

A name is imported when it is first used, so that the command line can settle how many threads the
linear algebra may take before numpy is loaded.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from hil import errors

if TYPE_CHECKING:
    from hil.archive import open_archive
    from hil.batch.run import reidentify
    from hil.campaign import Campaign, Stop, stop_on_interrupt
    from hil.cell import Cell
    from hil.exporting import export_model
    from hil.identify import Options, identify_archives, identify_campaign
    from hil.importers import ColumnMap, Robot, import_log, import_rosbag2
    from hil.move import send, straight_way
    from hil.progress import Silent, reporter
    from hil.recordings import open_recording
    from hil.replaying import replay_motions
    from hil.results import Results
    from hil.simulation import simulated_controller
    from hil.study import run_study

_HOME = {
    **dict.fromkeys(("Campaign", "Stop", "stop_on_interrupt"), "campaign"),
    **dict.fromkeys(("Options", "identify_archives", "identify_campaign"), "identify"),
    **dict.fromkeys(("ColumnMap", "Robot", "import_log", "import_rosbag2"), "importers"),
    **dict.fromkeys(("send", "straight_way"), "move"),
    **dict.fromkeys(("Silent", "reporter"), "progress"),
    "Cell": "cell",
    "Results": "results",
    "export_model": "exporting",
    "open_archive": "archive",
    "open_recording": "recordings",
    "reidentify": "batch.run",
    "replay_motions": "replaying",
    "run_study": "study",
    "simulated_controller": "simulation",
}

__all__ = [
    "Campaign",
    "Cell",
    "ColumnMap",
    "Options",
    "Results",
    "Robot",
    "Silent",
    "Stop",
    "errors",
    "export_model",
    "identify_archives",
    "identify_campaign",
    "import_log",
    "import_rosbag2",
    "open_archive",
    "open_recording",
    "reidentify",
    "replay_motions",
    "reporter",
    "run_study",
    "send",
    "simulated_controller",
    "stop_on_interrupt",
    "straight_way",
]


def __getattr__(name: str) -> Any:
    if name in _HOME:
        return getattr(import_module(f"hil.{_HOME[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
