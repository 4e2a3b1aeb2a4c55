"""Settings of a design: a TOML file, and a preset for each method as its defaults.

The description of a field is also the remedy in error messages.
"""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from importlib.resources import files
from pathlib import Path
from typing import Annotated, Any, Final, Literal

from pydantic import BeforeValidator, Field, ValidationError, model_validator

from hil.base.errors import InputError
from hil.base.safe_input import parse_toml, read_text
from hil.cell.errors import first_error
from hil.cell.field_error import FieldError
from hil.cell.schema import Choice, NonNegative, Number, Positive, Table, Whole, field
from identification.excitation import METHODS, Method

Share = Annotated[Number, Field(ge=0, le=1)]
Eta = Annotated[Number, Field(ge=1, le=1000)]
Frequencies = Annotated[list[Positive], Field(min_length=1)]
Fraction = Annotated[Number, Field(gt=0, le=1)]
_MOTIONS: Final[Mapping[str, Method]] = {"via_points": "b", "sines": "a"}
FORMER_METHODS: Final = ("balanced", "front")
"""Methods of version 0.1, which the gradient replaced."""
RESULT_FORMAT: Final = "designed excitation"
"""Key `format` of a result file, which has a table of the settings."""
MAX_VIA_POINTS: Final = 60
"""Most via points of a motion."""
MIN_RAMP_SECONDS: Final = 0.05
"""Shortest ramp of sines, s; a shorter one is a jerk whose contacts cannot be determined."""


class SettingsError(InputError):
    """Invalid settings of a design: names file, field, value and remedy."""


def _one_or_many(value: Any) -> Any:
    return [value] if isinstance(value, int | float) else value


class SearchTable(Table):
    """`[search]`: effort and weights of the search."""

    population: Whole = field("a number of individuals, 4 to 10000", ge=4, le=10_000)
    generations: Whole = field(
        "a number of generations, the first one included, 1 to 100000", ge=1, le=100_000
    )
    crossover: Share = field("the probability that two parents are crossed, 0 to 1")
    mutation: Share = field("the probability that a gene is mutated, 0 to 1")
    crossover_eta: Eta = field("the distribution index of the crossover (SBX), 1 to 1000", 15.0)
    mutation_eta: Eta = field("the distribution index of the mutation, 1 to 1000", 20.0)
    weights: tuple[Share, Share] = field(
        "the weights of log det and of -I_c (method gradient) or I_c,max / I_c (method b), two "
        "shares from 0 to 1 that add up to 1",
        (0.7, 0.3),
    )
    gradient: Whole = field(
        "a number of steps along the gradient from the best motion, 0 for none; with [via_points]",
        0,
        ge=0,
        le=100_000,
    )
    starts: Whole = field(
        "a number of motions that share the first half of these steps, 1 to 100", 1, ge=1, le=100
    )

    @model_validator(mode="after")
    def _weights_share(self) -> SearchTable:
        if abs(sum(self.weights) - 1.0) > 1e-9:
            problem = f"weights {list(self.weights)} add up to {sum(self.weights):g}"
            raise FieldError(problem, "they must add up to 1, e.g. [0.7, 0.3]")
        return self


class ViaPointTable(Table):
    """`[via_points]`: a motion through via points, as the controller's interpolator runs it."""

    n_via: Whole = field(
        f"a number of via points to search, 2 to {MAX_VIA_POINTS}", ge=2, le=MAX_VIA_POINTS
    )
    fly: Share = field("a fly-by fraction, 0 (stop at every via point) to 1")
    slowest: Fraction = field("the smallest fraction of a joint's speed limit, above 0, at most 1")
    range_share: Fraction = field(
        "the central fraction of each joint's range for via points, above 0, at most 1", 1.0
    )


class SineTable(Table):
    """`[sines]`: a sum of sines for each joint (eq. 8 of the paper)."""

    harmonics: Whole = field("a number of sines for each joint, 1 to 20", ge=1, le=20)
    length: Positive = field("the duration of the motion in s, above 0")
    ramp: NonNegative = field(
        "the duration of fade-in and fade-out in s, 0 for none (such a motion cannot be run)"
    )
    slowest: Annotated[Frequencies, BeforeValidator(_one_or_many)] = field(
        "the lowest angular frequency in rad/s, above 0: one, or one for each joint"
    )
    fastest: Frequencies | Literal["from limits"] = field(
        'the highest angular frequency in rad/s, one for each joint, or "from limits": '
        "sqrt(acceleration limit / distance of offset and limit), as in the paper's appendix"
    )
    offset: Literal["middle", "home"] | list[Number] = field(
        'the mean posture: "middle" of the joints\' ranges, "home" of the cell, or '
        "angles in degrees, one for each joint, in the frame of the cell's [limits]",
        "middle",
    )

    @model_validator(mode="after")
    def _ramps_fit(self) -> SineTable:
        if 0.0 < self.ramp < MIN_RAMP_SECONDS:
            problem = f"a ramp of {self.ramp:g} s is too short"
            raise FieldError(problem, f"make it {MIN_RAMP_SECONDS:g} s or longer, or 0 for none")
        if 2.0 * self.ramp > self.length:
            problem = f"two ramps of {self.ramp:g} s are longer than the motion, {self.length:g} s"
            raise FieldError(problem, "make the ramp shorter, or the motion longer")
        return self


class ConstraintTable(Table):
    """`[constraints]`: constraints in addition to the joint limits."""

    min_duration: NonNegative = field("the shortest duration in s, 0 for any", 0.0)
    max_duration: Positive = field("the longest duration in s, above 0", 20.0)
    closed: Choice = field(
        "true or false: motions through via points begin and end in the cell's home", True
    )
    collision: Choice = field(
        "true or false: check clearance from floor, walls and the arm ([workspace])", True
    )
    current: Choice = field(
        "true or false: check the motors' current limits with the nominal model", True
    )

    @model_validator(mode="after")
    def _durations_ordered(self) -> ConstraintTable:
        if self.min_duration > self.max_duration:
            longest = f"max_duration = {self.max_duration:g} s"
            problem = f"min_duration = {self.min_duration:g} s is longer than {longest}"
            raise FieldError(problem, "make it shorter")
        return self


class ObjectiveTable(Table):
    """`[objective]`: parameters in the criteria."""

    parameters: Literal["all"] | Annotated[list[str], Field(min_length=2)] = field(
        '"all", or a list of at least two names of parameters as `hil identify` reports them', "all"
    )

    given: list[str] = field(
        "a list of archives or folders of earlier recordings, whose information the motion adds to",
        [],
    )
    precision: list[str] = field(
        'a list of requirements for the precision of the estimates, such as "parameters 5 %", '
        "which replace the criteria",
        [],
    )

    @property
    def named(self) -> list[str] | None:
        """Names of the parameters, None if they are not listed."""
        return None if isinstance(self.parameters, str) else self.parameters


class DesignSettings(Table):
    """The whole file."""

    method: Method = field(f"one of {', '.join(METHODS)}")
    seed: Whole = field("a whole number, 0 or more; one seed is one result", 1, ge=0, lt=2**63)
    search: SearchTable = field("a table [search]")
    via_points: ViaPointTable | None = field("a table [via_points]", None)
    sines: SineTable | None = field("a table [sines]", None)
    constraints: ConstraintTable = ConstraintTable()
    objective: ObjectiveTable = ObjectiveTable()

    @model_validator(mode="after")
    def _one_motion(self) -> DesignSettings:
        if (self.via_points is None) == (self.sines is None):
            given = "neither" if self.via_points is None else "both"
            problem = f"has {given} of [via_points] and [sines]"
            raise FieldError(problem, "give one of the two")
        if self.sines is not None and self.search.gradient > 0:
            gradient = self.search.gradient
            problem = f"[search] gradient = {gradient} improves [via_points], not [sines]"
            raise FieldError(problem, "make it 0")
        if self.objective.precision and self.search.gradient == 0:
            problem = (
                "[objective] precision is reached by steps along the gradient, and [search] "
                "gradient is 0"
            )
            remedy = "choose the method gradient, or make it 100 with [via_points]"
            raise FieldError(problem, remedy)
        requested = self.constraints
        length = None if self.sines is None else self.sines.length
        if length is not None and not requested.min_duration <= length <= requested.max_duration:
            problem = (
                f"[sines] length = {length:g} s is not between [constraints] min_duration = "
                f"{requested.min_duration:g} s and max_duration = {requested.max_duration:g} s"
            )
            raise FieldError(problem, "change one")
        return self

    def replaced(self, **changes: Any) -> DesignSettings:
        """Return the settings with changes, tables merged field by field.

        Raises:
            SettingsError: names field, value and remedy.
        """
        return _validated(None, _merged(self.to_dict(), changes))

    def kinematic(self) -> DesignSettings:
        """Return the settings with only joint limits and durations as constraints."""
        return self.replaced(
            constraints={"closed": False, "collision": False, "current": False},
        )

    @property
    def unchecked(self) -> tuple[str, ...]:
        """Constraints of a robot's motion that these settings do not check."""
        constraints = self.constraints
        bare = self.sines is not None and self.sines.ramp == 0.0
        return (
            *(() if constraints.collision else ("floor", "walls", "the arm itself")),
            *(() if constraints.current else ("motor currents",)),
            *(("rest at both ends",) if bare else ()),
        )

    def to_dict(self) -> dict[str, Any]:
        """Return data for JSON, without None."""
        return self.model_dump(mode="json", exclude_none=True)


def preset(method: Method) -> DesignSettings:
    """Return the default settings of a method."""
    return _validated(None, tomllib.loads(preset_text(method)))


def preset_text(method: Method) -> str:
    """Return the commented TOML file of a preset."""
    return (files(f"{__package__}.presets") / f"{method}.toml").read_text("utf-8")


def load_settings(path: Path) -> DesignSettings:
    """Read settings, with the preset of the method as defaults; also from a result file.

    Raises:
        SettingsError: names file, field, value and remedy.
    """
    return settings_of(_read(path), path)


def recorded_settings(path: Path) -> DesignSettings:
    """Read the settings of a finished design, which a version up to 0.1 may have made.

    Raises:
        SettingsError: names file, field, value and remedy.
    """
    return settings_of(with_present_fields(_read(path)), path)


def with_present_fields(raw: Mapping[str, Any]) -> dict[str, Any]:
    """Return settings of a finished design by the methods and fields of this version."""
    present = dict(raw)
    if raw.get("method") in FORMER_METHODS:
        present["method"] = "gradient"
    if isinstance(raw.get("search"), Mapping):
        present["search"] = {k: v for k, v in raw["search"].items() if k != "polish"}
    return present


def _read(path: Path) -> dict[str, Any]:
    """Return the settings in a TOML file, or in the result of a design."""
    try:
        raw = parse_toml(read_text(path))
    except OSError as error:
        problem = f"cannot be read ({error.strerror})"
        raise SettingsError(path, problem, remedy="give a TOML file") from error
    except ValueError as error:
        remedy = "see `hil design --show-settings gradient`"
        raise SettingsError(path, f"is not TOML ({error})", remedy=remedy) from error
    if raw.get("format") == RESULT_FORMAT and isinstance(raw.get("settings"), dict):
        return dict(raw["settings"])
    return raw


def settings_of(raw: Mapping[str, Any], path: Path | None = None) -> DesignSettings:
    """Return settings from the data of a file; see :func:`load_settings`."""
    method = raw.get("method", "gradient")
    if method in FORMER_METHODS:
        raise SettingsError(
            path,
            "is a method of version 0.1, which the gradient replaced",
            field=f"method = {method!r}",
            remedy="leave out method and [search]: by default the gradient is used",
        )
    if method not in METHODS:
        raise SettingsError(
            path,
            "is not a method",
            field=f"method = {method!r:.60}",
            remedy=f"known are: {', '.join(METHODS)}",
        )
    raw = _without_polish(raw, path)
    base = tomllib.loads(preset_text(method))
    if "sines" in raw and base["search"].get("gradient"):
        # Their criteria have no gradient: a genetic search as long as that of method A.
        effort = tomllib.loads(preset_text(_MOTIONS["sines"]))["search"]
        size = {name: effort[name] for name in ("population", "generations")}
        base["search"] |= {**size, "gradient": 0, "starts": 1}
    given = [name for name in _MOTIONS if name in raw]
    if given:  # a motion of another kind has the defaults of the paper's method
        base = {
            name: table for name, table in base.items() if name not in _MOTIONS or name in given
        }
        for name in given:
            base.setdefault(name, tomllib.loads(preset_text(_MOTIONS[name]))[name])
    return _validated(path, _merged(base, raw))


def _without_polish(raw: Mapping[str, Any], path: Path | None) -> Mapping[str, Any]:
    """Return settings without `polish`, which files of version 0.1 have, mostly as 0."""
    search = raw.get("search")
    if not isinstance(search, Mapping) or "polish" not in search:
        return raw
    if search["polish"] != 0:
        raise SettingsError(
            path,
            "is a local search of version 0.1, which steps along the gradient replaced",
            field=f"search.polish = {search['polish']!r:.60}",
            remedy="leave it out; [search] gradient = 180 improves a motion through via points",
        )
    return with_present_fields(raw)


def _merged(base: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    both = {
        name: {**base[name], **value}
        for name, value in changes.items()
        if isinstance(base.get(name), Mapping) and isinstance(value, Mapping)
    }
    return {**base, **changes, **both}


def _validated(path: Path | None, raw: Mapping[str, Any]) -> DesignSettings:
    try:
        return DesignSettings.model_validate(raw)
    except ValidationError as error:
        first = first_error(path or Path(), error, DesignSettings)
        given = "" if first.value is None else f" = {first.value!r:.60}"
        not_table = error.errors(include_url=False)[0]["type"] == "model_type"
        raise SettingsError(
            path,
            "is not a table" if not_table else first.problem,
            field=f"{first.field}{given}",
            remedy=first.remedy,
        ) from error
