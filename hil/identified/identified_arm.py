"""Identifies an arm from recordings, for both `hil identify` and `hil.identify(...)`."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property, partial
from html import escape
from os import PathLike
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from hil.archive import Archive, place_of
from hil.archive.campaign_archives import RecordedCampaign
from hil.base.arrays import Array
from hil.base.errors import InputError
from hil.base.files import make_folder, write_output
from hil.base.output_folder import SOURCES, folder_beside, sources_text
from hil.base.progress import Reporter, Silent
from hil.base.safe_input import path_exists
from hil.base.threads import one_thread
from hil.identified.annotate import annotate as write_annotated
from hil.identified.data_frames import as_logs
from hil.identified.identified_servo import (
    IdentifiedServo,
    are_servos,
    identified_servo,
    refuse_comparison,
)
from hil.identified.recordings_read import recording_results
from hil.identified.staging import Staging, require_torques, staged
from hil.identified.torque_plot import TorquePlot, torque_plot
from hil.importers.imported_robot import Robot
from hil.importers.messages import sentence
from hil.importers.recording_import import ImportOptions, RobotOf, is_archive
from hil.pipeline.identification import Identification
from hil.pipeline.identified_model import IdentifiedModel, model_of
from hil.pipeline.identify_folder import identify_paths
from hil.pipeline.options import Options
from hil.pipeline.stored_identification import (
    NotReusableError,
    StoredIdentification,
    stored_identification,
)
from hil.report.output_files import copy_outcome, write_outcome
from hil.results.error_columns import RMS_TITLE, error_columns, rms_error
from hil.results.results import Results
from hil.rollout.servo_rollout import without_torque
from identification.errors import ModelError
from identification.export.observer import MomentumObserver
from identification.export.parameter_table import parameter_table
from identification.export.simulators import pinocchio_arm
from identification.hypotheses.diagnosis import TorqueDiagnosis
from identification.model.motion import Motion
from identification.model.single_state import SingleStateTorque
from identification.text import percentage
from identification.validation.verdict import Verdict

if TYPE_CHECKING:
    import pandas
    import pinocchio
    from matplotlib.axes import Axes

Recording: TypeAlias = "str | PathLike[str] | pandas.DataFrame"
Recordings: TypeAlias = "Recording | Sequence[Recording]"


@dataclass(frozen=True, eq=False, repr=False)
class IdentifiedArm:
    """An identified arm, of :func:`hil.identify` or :func:`hil.load`; it can be pickled.

    A notebook shows its verdict, its errors by joint, and measured and predicted torque.

    Attributes:
        recordings: files that were fitted, or a folder of archives.
        predicted: recordings that were predicted and not fitted.
        identification: the estimate, and everything that it was computed from or read from.
        channels: a line for each group of channels of imported recordings: what it is, and why.
        staging: imported recordings, whose archives are written with the result.
        sources: content of `sources.json`, None of a folder of archives.
    """

    recordings: tuple[Path, ...]
    predicted: tuple[Path, ...]
    identification: Identification | StoredIdentification
    channels: tuple[str, ...]
    staging: Staging | None = None
    sources: str | None = None

    def __repr__(self) -> str:
        return f"<IdentifiedArm {self.results.cell}: {self.verdict.line}>"

    @property
    def verdict(self) -> Verdict:
        """Whether the model may be used (`good`), the summary (`line`), findings, next steps."""
        return self.identification.verdict

    @property
    def results(self) -> Results:
        """Content of `results.json`, except fields that describe written files."""
        return self.identification.results

    @cached_property
    def parameters(self) -> pandas.DataFrame:
        """Base parameters, friction and elements by name, as in `parameters.csv`.

        Meaning, body and joint; estimate and ends of its 95 % interval; unit; whether it is known
        (yes: to a tenth; roughly: to a half; no); standard deviation, in units of the torque of
        this arm and with the uncertainty of its scale; expression in parameters of the bodies.
        """
        import pandas  # only for this table

        source = self.identification
        stated = source.estimation.stated if isinstance(source, Identification) else source.estimate
        rows = parameter_table(source.cell.model, stated)
        return pandas.DataFrame([asdict(row) for row in rows]).set_index("name")

    def predict(self, q: ArrayLike, v: ArrayLike, a: ArrayLike) -> Array:
        """Return the torque [N·m, N] at positions, velocities and accelerations.

        Arrays are of shape (n,) or (m, n) in rad, rad/s, rad/s² (m, m/s, m/s² of prismatic joints),
        joints in the order of `results.joint_names`. Dry friction has the sign of the velocity; a
        known payload and known springs are in it, a low-pass of the recorded torque is not.

        Raises:
            ShapeError: an array has another shape.
        """
        states = [np.asarray(values, dtype=np.float64) for values in (q, v, a)]
        shape = states[0].shape
        single = self._single_state
        if single is not None and all(values.shape == single.shape for values in states):
            return single(*states)
        model = self.identification.cell.model
        motion = Motion.of_states(*map(np.atleast_2d, states))
        torque = model.torque(self.identification.values, motion) + model.load_torque(motion)
        return torque.reshape(shape)

    @cached_property
    def _single_state(self) -> SingleStateTorque | None:
        """Torque of one state; None of an arm whose parameters no bodies with masses have."""
        try:
            return SingleStateTorque(self.identification.cell.model, self.identification.values)
        except ModelError:
            return None

    @property
    def model(self) -> pinocchio.Model:
        """The arm for pinocchio: consistent bodies, armature, damping and dry friction.

        Raises:
            InputError: there are no physically consistent parameters.
        """
        model = self._model
        return pinocchio_arm(model.arm, model.name)

    @property
    def _model(self) -> IdentifiedModel:
        source = self.identification
        if isinstance(source, Identification):
            return model_of(source)
        try:
            return source.model()
        except NotReusableError as error:
            remedy = "see the verdict of `hil identify`"
            raise InputError(source.folder, str(error), remedy=remedy) from error

    def observer(self, gain: float, dt: float) -> MomentumObserver:
        """Return an observer of external torque, such as contact.

        Args:
            gain: 1 over the time constant of the estimate [1/s], such as 25.
            dt: time between two cycles [s].

        Raises:
            InputError: there are no physically consistent parameters.
            ModelError: gain or dt is not positive.
        """
        return MomentumObserver(self._model.arm, gain, dt)

    def plot(
        self,
        joints: Sequence[str | int] | str | int | None = None,
        *,
        size: tuple[float, float] | None = None,
        axes: Axes | Sequence[Axes] | None = None,
    ) -> TorquePlot:
        """Draw the torque of the held-out motion: measured, identified model, nominal model.

        Args:
            joints: names, or numbers from 0; None: all.
            size: of the figure [inch]; None: by the number of joints.
            axes: of an existing figure, one for each joint, for the torque without its error.

        Returns:
            figure and series: `plot.figure`, `plot.savefig(...)`, `plot.series["measured"]`.

        Raises:
            InputError: there is no such joint, or another number of axes than of joints.
        """
        return torque_plot(self.results, self.identification.series, joints, size, axes)

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
                the first recording, next to it; see :func:`hil.base.output_folder.folder_beside`.
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

        judgement = self.results.judgement
        shares = [column for column in error_columns(judgement) if column.is_share]
        joints = pandas.DataFrame(
            {
                "joint": [joint.joint for joint in judgement.joints],
                RMS_TITLE: [rms_error(joint) for joint in judgement.joints],
                **{
                    column.title: [getattr(joint, column.field) for joint in judgement.joints]
                    for column in shares
                },
            }
        )
        table = joints.to_html(
            index=False, border=0, float_format=partial(percentage, decimals=1), na_rep="-"
        )
        source = base64.b64encode(self.plot().png()).decode("ascii")
        alternative = "Measured torque, and the torques of the identified and the nominal model"
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
    recordings: Recordings,
    urdf: str | PathLike[str] | None,
    robot: Robot | RobotOf | None,
    predict: Recordings,
    reading: ImportOptions | None,
    options: Options | None,
    reporter: Reporter | None,
) -> IdentifiedArm:
    """Identify an arm from recordings, see :func:`hil.identify`; None is the default of each.

    Args:
        recordings: that are fitted.
        urdf: of the arm.
        robot: in place of it.
        predict: recordings that are held out.
        reading: how logs are read.
        options: of the identification.
        reporter: of progress.
    """
    if urdf is not None:
        if robot is not None:
            problem = "exclude each other"
            remedy = "give one of them"
            raise InputError(None, problem, field="urdf and robot", remedy=remedy)
        robot = Robot.from_urdf(urdf)
    robot_of = (lambda _: robot) if isinstance(robot, Robot) else robot
    with as_logs(recordings, predict) as (fitted, predicted):
        identified = identify_recordings(
            fitted,
            predicted,
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
    recordings: Recordings,
    *,
    urdf: str | PathLike[str],
    predict: Recordings = (),
    compare: str | PathLike[str] | None = None,
    reading: ImportOptions | None = None,
    reporter: Reporter | None = None,
) -> IdentifiedServo:
    """Identify servo and friction of an arm without torque; nothing is written before `save`.

    Args:
        recordings: logs, bags or folders with commanded and measured positions, or DataFrames.
        urdf: description of the arm, with masses.
        predict: recordings to predict from their commands alone, and not to fit.
        compare: MJCF whose servo parameters are compared.
        reading: what the channels are, where that cannot be concluded from names and units.
        reporter: receives messages and progress, or None.

    Raises:
        InputError: a recording or the URDF cannot be read, or nothing can be identified from it.
    """
    robot = Robot.from_urdf(urdf)
    with as_logs(recordings, predict) as (fitted, predicted):
        identified = identify_recordings(
            fitted,
            predicted,
            lambda _: robot,
            reading or ImportOptions(),
            Options(),
            reporter or Silent(),
            compare=None if compare is None else Path(compare),
        )
    if isinstance(identified, IdentifiedArm):
        problem = "has torques"
        raise InputError(
            identified.recordings[0], problem, field="torque", remedy="use hil.identify(...)"
        )
    return identified


@one_thread()
def load(folder: str | PathLike[str]) -> IdentifiedArm:
    """Return the arm in a folder of `hil identify` or `save`, without identifying it again.

    Raises:
        InputError: the folder has no result, or its archives are not those that were identified.
    """
    place = Path(folder)
    try:
        stored = stored_identification(place, Silent())
    except NotReusableError as error:
        problem = f"cannot be loaded: {error}"
        raise InputError(place, problem, remedy=f"identify again: hil identify {place}") from error
    settings = stored.results.settings
    assert settings is not None
    fitted, predicted = (
        tuple(path for path in stored.paths if (path.name in settings.predicted) is held_out)
        for held_out in (False, True)
    )
    channels = tuple(
        f"{each.file}: {line}" for each in stored.results.recordings for line in each.channels
    )
    return IdentifiedArm(fitted, predicted, stored, channels)


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
    """Import recordings that are not archives, and identify; only these need a robot.

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
        raise InputError(None, "there is no recording", remedy="give a log, a bag or an archive")
    if robot_of is None:
        return _of_archives(recordings, predict, options, compare, reporter)
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
        identification = _identified(
            staging.fitted, staging.predicted, options, reporter, staging.diagnoses
        )
    read = recording_results(staging, predict)
    results = identification.results.model_copy(update={"recordings": read})
    return IdentifiedArm(
        tuple(recordings),
        tuple(predict),
        replace(identification, results=results),
        _channels(staging),
        staging,
        sources_text(recordings, predict),
    )


def _of_archives(
    recordings: Sequence[Path],
    predict: Sequence[Path],
    options: Options,
    compare: Path | None,
    reporter: Reporter,
) -> IdentifiedArm | IdentifiedServo:
    """Identify from archives, see :func:`identify_recordings`."""
    _require_archives((*recordings, *predict))
    if _lack_torque((*recordings, *predict)):
        staging = Staging(list(recordings), list(predict))
        return identified_servo(staging, recordings, predict, options, compare, (), reporter)
    refuse_comparison(compare)
    identification = _identified(recordings, predict, options, reporter)
    first = recordings[0]
    is_folder = first.is_dir() and is_archive(first)
    sources = None if is_folder else sources_text(recordings, predict)
    return IdentifiedArm(tuple(recordings), tuple(predict), identification, (), sources=sources)


def _lack_torque(archives: Sequence[Path]) -> bool:
    """Return whether archives have commands and no torque; their defects are reported later."""
    try:
        return without_torque(archives)
    except InputError:
        return False


def _identified(
    archives: Sequence[Path | Archive],
    predict: Sequence[Path | Archive],
    options: Options,
    reporter: Reporter,
    diagnoses: Mapping[Path, TorqueDiagnosis] = MappingProxyType({}),
) -> Identification:
    """Identify from archives or a folder of them; a campaign with its conduct."""
    identification = identify_paths(
        archives, reporter, options, predict=predict, diagnoses=diagnoses
    )
    first = place_of(archives[0])
    if not RecordedCampaign(first).sealed:
        return identification
    from hil.campaign.identified_campaign import (
        with_execution_log,  # which loads what executes a campaign
    )

    return with_execution_log(identification, first)


def write_arm(
    arm: IdentifiedArm,
    folder: str | PathLike[str] | None,
    *,
    annotate: bool,
    reporter: Reporter,
) -> tuple[Path, Results]:
    """Write an identified arm, see :meth:`IdentifiedArm.save`; return folder and `results.json`.

    Args:
        arm: that is written.
        folder: default: the folder of the identification.
        annotate: write copies of the archives with the predicted torque.
        reporter: of progress.
    """
    first = arm.recordings[0]
    staging = arm.staging
    identification = arm.identification
    sources = arm.sources
    if isinstance(identification, StoredIdentification):
        place = Path(folder or identification.folder)
        make_folder(place)
        copy_outcome(identification.folder, place, identification.paths)
        if annotate:
            write_annotated(identification, place)
        return place, identification.results
    if folder is not None:
        place = Path(folder)
    else:
        place = first
        if sources is not None:  # a DataFrame has no place of its own
            place = folder_beside(first if path_exists(first) else Path(first.name), sources)
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
