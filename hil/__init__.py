"""Hardware-in-the-loop identification of the dynamics of industrial robots.

Campaigns:

- `Cell`: robot, drive train, controller and limits of a cell file.
- `Campaign`: a folder with one plan for one cell: rehearse, run, identify, report.
- `simulated_controller`: a simulated controller with the arm of a cell.
- `plan_move`, `send`: plan a straight motion in joint space; send a motion and archive it.
- `Stop`, `stop_on_interrupt`: stop the arm on its path, also on Ctrl-C.
- `reporter`, `Silent`: progress bars, or none.

Archives and other recordings:

- `open_archive`, `open_recording`: open an archive; read it as samples in SI units.
- `import_log`, `import_rosbag2`: convert text, arrays and bags to archives.
- `Robot`, `ColumnMap`: robot and columns of an imported recording.
- `identify`: from a log and a URDF to an `IdentifiedArm`: verdict, parameters, prediction, model.
- `identify_archives`, `identify_campaign`: estimate, predict and judge.
- `Options`: settings of the estimation; `ImportOptions`: what the channels of a recording are.
- `Results`: content of `results.json`.
- `reidentify`: identify all arms and campaigns below some folders.
- `export_model`: file of the identified arm for simulators.
- `run_study`: comparison of the two methods of the paper.
- `errors`: exceptions, with file, field and remedy.

Names are imported on first use, so that the command line can set the number of threads of linear
algebra before numpy is loaded.
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
    from hil.identified_arm import IdentifiedArm, identify
    from hil.identify import Options, identify_archives, identify_campaign
    from hil.importers import ColumnMap, Robot, import_log, import_rosbag2
    from hil.importers.recording import ImportOptions
    from hil.move import plan_move, send
    from hil.progress import Silent, reporter
    from hil.recordings import open_recording
    from hil.results import Results
    from hil.simulation import simulated_controller
    from hil.study import run_study

_HOME = {
    **dict.fromkeys(("Campaign", "Stop", "stop_on_interrupt"), "campaign"),
    **dict.fromkeys(("Options", "identify_archives", "identify_campaign"), "identify"),
    **dict.fromkeys(("ColumnMap", "Robot", "import_log", "import_rosbag2"), "importers"),
    **dict.fromkeys(("send", "plan_move"), "move"),
    **dict.fromkeys(("Silent", "reporter"), "progress"),
    "Cell": "cell",
    "IdentifiedArm": "identified_arm",
    "ImportOptions": "importers.recording",
    "Results": "results",
    "export_model": "exporting",
    "open_archive": "archive",
    "open_recording": "recordings",
    "reidentify": "batch.run",
    "run_study": "study",
    "simulated_controller": "simulation",
}

__all__ = [
    "Campaign",
    "Cell",
    "ColumnMap",
    "IdentifiedArm",
    "ImportOptions",
    "Options",
    "Results",
    "Robot",
    "Silent",
    "Stop",
    "errors",
    "export_model",
    "identify",
    "identify_archives",
    "identify_campaign",
    "import_log",
    "import_rosbag2",
    "open_archive",
    "open_recording",
    "plan_move",
    "reidentify",
    "reporter",
    "run_study",
    "send",
    "simulated_controller",
    "stop_on_interrupt",
]


def __getattr__(name: str) -> Any:
    if name == "identify":  # a package that can be called
        return import_module("hil.identify")
    if name in _HOME:
        return getattr(import_module(f"hil.{_HOME[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    """Return all public names, also those that are not loaded yet, and the modules loaded."""
    helpers = {"Any", "TYPE_CHECKING", "annotations", "import_module"}
    return sorted({*globals(), *__all__} - helpers)
