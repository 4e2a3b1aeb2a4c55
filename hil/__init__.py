"""Hardware-in-the-loop identification of the dynamics of industrial robots.

Campaigns:

- `Cell`: robot, drive train, controller and limits of a cell file.
- `Campaign`: a folder with one plan for one cell: rehearse, run, identify, report.
- `simulated_controller`: a simulated controller with the arm of a cell.
- `plan_move`, `send`: plan a straight motion in joint space; send a motion and archive it.
- `Stop`, `stop_on_interrupt`: stop the arm on its path, also on Ctrl-C.
- `cell_link`: open the link to the controller of a cell.
- `Screen`: the screen of a run, with its keys.
- `reporter`, `LineReporter`, `Silent`: progress bars, lines, or nothing.

Archives and other recordings:

- `open_archive`, `open_recording`: open an archive; read it as samples in SI units.
- `import_log`, `import_rosbag2`: convert text, arrays and bags to archives.
- `Robot`, `ColumnMap`: robot and columns of an imported recording.
- `identify`: from a log and a URDF to an `IdentifiedArm`: verdict, parameters, prediction, model.
- `load`: the `IdentifiedArm` in a folder of `hil identify`, without identifying it again.
- `identify_servo`: the same of an arm without torque, to an `IdentifiedServo`.
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

from typing import TYPE_CHECKING

from hil.base import errors
from hil.base.first_use import on_first_use

if TYPE_CHECKING:
    from os import PathLike

    from hil.archive import open_archive
    from hil.archive.recording_of_archive import open_recording
    from hil.base.progress import LineReporter, Reporter, Silent, reporter
    from hil.base.version import __version__ as __version__
    from hil.batch.graph import reidentify
    from hil.campaign import Campaign
    from hil.campaign.identified_campaign import identify_campaign
    from hil.campaign.screen import Screen
    from hil.cell import Cell
    from hil.control.cell_link import cell_link
    from hil.control.motion_watch import Stop, stop_on_interrupt
    from hil.control.move import plan_move, send
    from hil.control.simulated_cell import simulated_controller
    from hil.export.model_files import export_model
    from hil.identified.identified_arm import (
        IdentifiedArm,
        Recordings,
        identify_servo,
        load,
    )
    from hil.identified.identified_servo import IdentifiedServo
    from hil.importers.column_map import ColumnMap
    from hil.importers.imported_robot import Robot
    from hil.importers.log import import_log
    from hil.importers.recording_import import ImportOptions, RobotOf
    from hil.importers.rosbag2 import import_rosbag2
    from hil.pipeline.identification import identify_archives
    from hil.pipeline.options import Options
    from hil.results.results import Results
    from hil.study import run_study

__all__ = [
    "Campaign",
    "Cell",
    "ColumnMap",
    "IdentifiedArm",
    "IdentifiedServo",
    "ImportOptions",
    "LineReporter",
    "Options",
    "Results",
    "Robot",
    "Screen",
    "Silent",
    "Stop",
    "cell_link",
    "errors",
    "export_model",
    "identify",
    "identify_archives",
    "identify_campaign",
    "identify_servo",
    "import_log",
    "import_rosbag2",
    "load",
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


def identify(
    recordings: Recordings,
    *,
    urdf: str | PathLike[str] | None = None,
    robot: Robot | RobotOf | None = None,
    predict: Recordings = (),
    reading: ImportOptions | None = None,
    options: Options | None = None,
    reporter: Reporter | None = None,
) -> IdentifiedArm:
    """Identify an arm from recordings, as `hil identify` does; nothing is written before `save`.

    Args:
        recordings: logs, bags or pandas DataFrames, with the `urdf` or `robot` of their arm; or
            archives, or a campaign folder.
        urdf: description of the arm.
        robot: in place of `urdf`, with gravity, friction law or joints that were not recorded: see
            :meth:`hil.Robot.from_urdf`.
        predict: recordings of any kind to predict and not to fit. Without any, the end of a single
            recording is held out.
        reading: what the channels are, where that cannot be concluded from names and units.
        options: of the estimation.
        reporter: receives messages and progress, or None. `hil.reporter()` prints them.

    Raises:
        InputError: a recording or the URDF cannot be read, a quantity is left open, or nothing can
            be identified from it.
    """
    from hil.identified.identified_arm import arm_from  # which loads numpy

    return arm_from(recordings, urdf, robot, predict, reading, options, reporter)


if not TYPE_CHECKING:
    __getattr__, __dir__ = on_first_use(
        __name__,
        {
            "hil.archive": ("open_archive",),
            "hil.archive.recording_of_archive": ("open_recording",),
            "hil.base.progress": ("LineReporter", "Silent", "reporter"),
            "hil.base.version": ("__version__",),
            "hil.batch.graph": ("reidentify",),
            "hil.campaign": ("Campaign",),
            "hil.campaign.identified_campaign": ("identify_campaign",),
            "hil.campaign.screen": ("Screen",),
            "hil.cell": ("Cell",),
            "hil.control.cell_link": ("cell_link",),
            "hil.control.motion_watch": ("Stop", "stop_on_interrupt"),
            "hil.control.move": ("plan_move", "send"),
            "hil.control.simulated_cell": ("simulated_controller",),
            "hil.export.model_files": ("export_model",),
            "hil.identified.identified_arm": ("IdentifiedArm", "identify_servo", "load"),
            "hil.identified.identified_servo": ("IdentifiedServo",),
            "hil.importers.column_map": ("ColumnMap",),
            "hil.importers.imported_robot": ("Robot",),
            "hil.importers.log": ("import_log",),
            "hil.importers.recording_import": ("ImportOptions",),
            "hil.importers.rosbag2": ("import_rosbag2",),
            "hil.pipeline.identification": ("identify_archives",),
            "hil.pipeline.options": ("Options",),
            "hil.results.results": ("Results",),
            "hil.study": ("run_study",),
        },
    )
