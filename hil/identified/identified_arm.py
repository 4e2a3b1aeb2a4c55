"""From recordings to an identified arm: what `hil identify` and `hil.identify(...)` both run."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from html import escape
from io import BytesIO
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import ArrayLike

from hil.archive import Archive, place_of
from hil.archive.recorded_campaign import RecordedCampaign
from hil.base.arrays import Array
from hil.base.errors import InputError
from hil.base.files import make_folder, write_output
from hil.base.output_folder import SOURCES, folder_beside, sources_text
from hil.base.progress import Reporter, Silent
from hil.base.threads import one_thread
from hil.export.model_files import pinocchio_of
from hil.identified.annotate import annotate as write_annotated
from hil.identified.identified_servo import (
    IdentifiedServo,
    are_servos,
    identified_servo,
    refuse_comparison,
)
from hil.identified.staging import Staging, require_torques, staged
from hil.importers.messages import sentence
from hil.importers.recording import ImportOptions, RobotOf, is_archive
from hil.importers.robot import Robot
from hil.pipeline.identified_model import model_of
from hil.pipeline.identify_folder import identify_paths
from hil.pipeline.options import Options
from hil.pipeline.run import Identification
from hil.report.figures import MEASURED, NOMINAL, PREDICTED, RESIDUAL, joints_of, torque_charts
from hil.report.output_files import write_outcome
from hil.results.results import Results
from hil.rollout.servo_rollout import without_torque
from identification.export.observer import MomentumObserver
from identification.model.motion import Motion
from identification.text import percentage
from identification.validation.verdict import Verdict

if TYPE_CHECKING:
    import pandas
    import pinocchio
    from matplotlib.figure import Figure

PathOrPaths = str | PathLike[str] | Sequence[str | PathLike[str]]

_DOTS: Final = 100  # per inch, of a picture in a notebook


@dataclass(frozen=True, eq=False, repr=False)
class IdentifiedArm:
    """An identified arm, not written anywhere yet.

    A notebook shows its verdict, its errors by joint, and measured and predicted torque.

    Attributes:
        recordings: files that were fitted, or a folder of archives.
        predicted: recordings that were predicted and not fitted.
        identification: the estimate, and everything that it was computed from.
        channels: a line for each group of channels of imported recordings: what it is, and why.
        staging: imported recordings, whose archives are written with the result.
    """

    recordings: tuple[Path, ...]
    predicted: tuple[Path, ...]
    identification: Identification
    channels: tuple[str, ...]
    staging: Staging | None = None

    def __repr__(self) -> str:
        return f"<IdentifiedArm {self.results.cell}: {self.verdict.line}>"

    @property
    def verdict(self) -> Verdict:
        """Whether the model may be used (`good`), the summary (`line`), findings, next steps."""
        return self.identification.verdict

    @property
    def results(self) -> Results:
        """Content of `results.json`, without what only the written files have."""
        return self.identification.results

    @cached_property
    def parameters(self) -> pandas.DataFrame:
        """Base parameters, friction and elements by name.

        Estimate, ends of its 95 % interval and standard deviation in the unit of the row, as
        measured by the torque of this arm; the standard deviation with the uncertainty of the scale
        of that torque; whether the motion leaves the parameter undetermined; and its expression in
        parameters of the bodies.
        """
        import pandas  # only for this table

        parameters = self.results.parameters
        factor = self.results.uncertainty.interval_factor
        return pandas.DataFrame(
            {
                "estimate": [parameter.estimate for parameter in parameters],
                "lower": [parameter.estimate - factor * parameter.std for parameter in parameters],
                "upper": [parameter.estimate + factor * parameter.std for parameter in parameters],
                "std": [parameter.std for parameter in parameters],
                "absolute_std": [parameter.absolute_std for parameter in parameters],
                "unit": [parameter.unit for parameter in parameters],
                "undetermined": [parameter.undetermined for parameter in parameters],
                "expression": [parameter.expression for parameter in parameters],
            },
            index=pandas.Index([parameter.name for parameter in parameters], name="parameter"),
        )

    def predict(self, q: ArrayLike, v: ArrayLike, a: ArrayLike) -> Array:
        """Return the torque [N·m, N] at positions, velocities and accelerations.

        Arrays are of shape (n,) or (m, n) in rad, rad/s, rad/s² (m, m/s, m/s² of prismatic joints),
        joints in the order of `results.joint_names`. Dry friction has the sign of the velocity; a
        known payload and known springs are in it, a low-pass of the recorded torque is not.

        Raises:
            ShapeError: an array has another shape.
        """
        model = self.identification.cell.model
        states = [np.asarray(values, dtype=np.float64) for values in (q, v, a)]
        motion = Motion.of_states(*map(np.atleast_2d, states))
        values = self.identification.estimate.pooled.values
        torque = model.torque(values, motion) + model.load_torque(motion)
        return torque.reshape(states[0].shape)

    @property
    def model(self) -> pinocchio.Model:
        """The arm for pinocchio: consistent bodies, armature, damping and dry friction.

        Raises:
            InputError: there are no physically consistent parameters.
        """
        return pinocchio_of(self.identification)

    def observer(self, gain: float, dt: float) -> MomentumObserver:
        """Return an observer of the torque from outside, such as that of a contact.

        Args:
            gain: 1 over the time constant of the estimate [1/s], such as 25.
            dt: time between two cycles [s].

        Raises:
            InputError: there are no physically consistent parameters.
            ModelError: gain or dt is not positive.
        """
        return MomentumObserver(model_of(self.identification).arm, gain, dt)

    def plot(self) -> Figure:
        """Draw measured torque of the held-out motion, and that of identified and nominal model."""
        from hil.plots.chart_picture import draw_charts  # only for this picture

        charts = torque_charts(self.identification.series, joints_of(self.results))
        return draw_charts([charts], [MEASURED, PREDICTED, NOMINAL, RESIDUAL])

    def save(
        self,
        folder: str | PathLike[str] | None = None,
        *,
        annotate: bool = False,
        reporter: Reporter | None = None,
    ) -> Path:
        """Write what `hil identify` writes: results, report, model, archives and column maps.

        Args:
            folder: for the files. None: that of a campaign or of archives, else one named after
                the first recording, beside it; see :func:`hil.base.output_folder.folder_beside`.
            annotate: also write copies of the archives with predicted torque and residual.
            reporter: receives the names of the files.

        Returns:
            the folder.

        Raises:
            InputError: an archive in the folder would replace a recording.
            OutputError: it cannot be written to.
        """
        return write_arm(self, folder, annotate=annotate, reporter=reporter or Silent())[0]

    def _repr_html_(self) -> str:
        """Return what a notebook shows."""
        import pandas  # only for this table

        joints = pandas.DataFrame(
            [
                (
                    joint.joint,
                    f"{joint.rms:.3g} {joint.unit}",
                    joint.relative,
                    joint.nominal_relative,
                )
                for joint in self.results.judgement.joints
            ],
            columns=["joint", "RMS error", "relative error", "error of the nominal model"],
        )
        shown = joints.dropna(axis="columns", how="all")
        table = shown.to_html(
            index=False, border=0, float_format=partial(percentage, decimals=1), na_rep="-"
        )
        picture = BytesIO()
        self.plot().savefig(picture, format="png", dpi=_DOTS)
        source = base64.b64encode(picture.getvalue()).decode("ascii")
        alternative = "Measured torque, and that of the identified and the nominal model"
        lines = (*self.verdict.warnings, *(f"next: {step}" for step in self.verdict.next_steps))
        remarks = "".join(f"<li>{escape(line)}</li>" for line in lines)
        channels = "".join(f"<li>{escape(line)}</li>" for line in self.channels)
        if channels:
            channels = f"<details><summary>Channels</summary><ul>{channels}</ul></details>"
        return (
            f"<p><strong>{escape(self.verdict.line)}</strong></p>"
            + (f"<ul>{remarks}</ul>" if remarks else "")
            + str(table)
            + f'<img alt="{alternative}" src="data:image/png;base64,{source}">'
            + channels
        )


@one_thread()
def arm_from(
    recordings: PathOrPaths,
    urdf: str | PathLike[str] | None,
    robot: Robot | RobotOf | None,
    predict: PathOrPaths,
    reading: ImportOptions | None,
    options: Options | None,
    reporter: Reporter | None,
) -> IdentifiedArm:
    """Identify an arm from recordings, see :func:`hil.identify`; None is the default of each."""
    if urdf is not None:
        if robot is not None:
            problem = "exclude each other"
            remedy = "give one of them"
            raise InputError(None, problem, field="urdf and robot", remedy=remedy)
        robot = Robot.from_urdf(urdf)
    robot_of = (lambda _: robot) if isinstance(robot, Robot) else robot
    identified = identify_recordings(
        _paths(recordings),
        _paths(predict),
        robot_of,
        reading or ImportOptions(),
        options or Options(),
        reporter or Silent(),
    )
    if isinstance(identified, IdentifiedServo):
        problem = "has no torque, so that servo and friction can be identified, not an arm"
        remedy = "use hil.identify_servo(...)"
        raise InputError(identified.recordings[0], problem, field="torque", remedy=remedy)
    return identified


@one_thread()
def identify_servo(
    recordings: PathOrPaths,
    *,
    urdf: str | PathLike[str],
    predict: PathOrPaths = (),
    compare: str | PathLike[str] | None = None,
    reading: ImportOptions | None = None,
    reporter: Reporter | None = None,
) -> IdentifiedServo:
    """Identify servo and friction of an arm without torque; nothing is written before `save`.

    Args:
        recordings: logs, bags or folders with commanded and measured positions.
        urdf: description of the arm, with masses.
        predict: recordings to predict from their commands alone, and not to fit.
        compare: MJCF whose servo parameters are compared.
        reading: what the channels are, where that cannot be concluded from names and units.
        reporter: receives messages and progress; None for none.

    Raises:
        InputError: a recording or the URDF cannot be read, or nothing can be identified from it.
    """
    robot = Robot.from_urdf(urdf)
    identified = identify_recordings(
        _paths(recordings),
        _paths(predict),
        lambda _: robot,
        reading or ImportOptions(),
        Options(),
        reporter or Silent(),
        compare=None if compare is None else Path(compare),
    )
    if isinstance(identified, IdentifiedArm):
        remedy = "use hil.identify(...)"
        raise InputError(_paths(recordings)[0], "has torques", field="torque", remedy=remedy)
    return identified


def identify_recordings(
    recordings: Sequence[Path],
    predict: Sequence[Path],
    robot_of: RobotOf | None,
    reading: ImportOptions,
    options: Options,
    reporter: Reporter,
    *,
    output: Path | None = None,
    compare: Path | None = None,
) -> IdentifiedArm | IdentifiedServo:
    """Import what is no archive, and identify; without a robot all must be archives.

    Recordings with commanded positions and without torque are identified as servos.

    Args:
        recordings: that are fitted.
        predict: that are predicted and not fitted.
        robot_of: the robot of those that are no archives.
        reading: how these are read.
        options: of the identification.
        reporter: of what is concluded, and of progress.
        output: folder that will be written to.
        compare: MJCF whose servo parameters are compared.

    Raises:
        InputError: as of :func:`hil.identify`, or an archive in the `output` would replace a
            recording.
    """
    if not recordings:
        raise InputError(None, "there is no recording", remedy="name a log, a bag or an archive")
    if robot_of is None:
        _require_archives((*recordings, *predict))
        if _lack_torque((*recordings, *predict)):
            staging = Staging(list(recordings), list(predict))
            return identified_servo(staging, recordings, predict, options, compare, (), reporter)
        refuse_comparison(compare)
        identification = _identified(recordings, predict, options, reporter)
        return IdentifiedArm(tuple(recordings), tuple(predict), identification, ())
    with staged(recordings, predict, robot_of, reading, reporter) as staging:
        if output is not None:
            staging.check_places(output)
        if are_servos([*staging.fitted, *staging.predicted]):
            channels = _channels(staging)
            return identified_servo(
                staging, recordings, predict, options, compare, channels, reporter
            )
        refuse_comparison(compare)
        require_torques(staging)
        identification = _identified(staging.fitted, staging.predicted, options, reporter)
    return IdentifiedArm(
        tuple(recordings), tuple(predict), identification, _channels(staging), staging
    )


def _lack_torque(archives: Sequence[Path]) -> bool:
    """Return whether archives have commands and no torque; what is wrong with one is said later."""
    try:
        return without_torque(archives)
    except InputError:
        return False


def _identified(
    archives: Sequence[Path | Archive],
    predict: Sequence[Path | Archive],
    options: Options,
    reporter: Reporter,
) -> Identification:
    """Identify from archives or a folder of them; a campaign with its conduct."""
    identification = identify_paths(archives, reporter, options, predict=predict)
    first = place_of(archives[0])
    if not RecordedCampaign(first).sealed:
        return identification
    from hil.campaign.identified import with_conduct  # which loads what executes a campaign

    return with_conduct(identification, first)


def write_arm(
    arm: IdentifiedArm,
    folder: str | PathLike[str] | None,
    *,
    annotate: bool,
    reporter: Reporter,
) -> tuple[Path, Results]:
    """Write an identified arm, see :meth:`IdentifiedArm.save`; return folder and `results.json`."""
    first = arm.recordings[0]
    staging = arm.staging
    identification = arm.identification
    is_folder = first.is_dir() and is_archive(first)
    sources = None if is_folder else sources_text(arm.recordings, arm.predicted)
    if folder is not None:
        place = Path(folder)
    else:
        place = first if sources is None else folder_beside(first, sources)
    if staging is not None:
        staging.check_places(place)
    make_folder(place)
    if staging is not None:
        identification = identification.moved(staging.write_to(place))
    results = write_outcome(place, identification, reporter)
    if annotate:
        copies = write_annotated(identification, place)
        reporter.say(f"annotated for viewers: {', '.join(map(str, copies))}")
    if sources is not None:
        write_output(place / SOURCES, sources)
    return place, results


def _require_archives(paths: Sequence[Path]) -> None:
    for path in paths:
        if path.is_file() and path.suffix.lower() != ".mcap":
            problem = "is not an archive, and a log needs the description of its arm"
            raise InputError(path, problem, remedy="add --urdf ARM.urdf")


def _channels(staging: Staging) -> tuple[str, ...]:
    return tuple(
        f"{staging.sources[archive].name}: {sentence(conclusion)}"
        for archive, recording in staging.recordings.items()
        for conclusion in recording.concluded
    )


def _paths(paths: PathOrPaths) -> tuple[Path, ...]:
    return (Path(paths),) if isinstance(paths, str | PathLike) else tuple(map(Path, paths))
