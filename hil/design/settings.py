"""What a design may be asked for: one TOML file, one preset per method.

The description of a field is also the remedy that an error prints, so it says what the value must
be. A file may leave out whatever its method's preset says already.
"""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from importlib.resources import files
from pathlib import Path
from typing import Annotated, Any, Final, Literal, get_args

from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    FiniteFloat,
    ValidationError,
    model_validator,
)

from hil.cell.errors import first_error
from hil.errors import InputError

Method = Literal["a", "b", "balanced", "front"]
METHODS: Final[tuple[Method, ...]] = get_args(Method)

Share = Annotated[FiniteFloat, Field(ge=0, le=1)]
Eta = Annotated[FiniteFloat, Field(ge=1, le=1000)]
AboveZero = Annotated[FiniteFloat, Field(gt=0)]
Frequencies = Annotated[list[AboveZero], Field(min_length=1)]
_MOTIONS = ("via_points", "sines")


class SettingsError(InputError):
    """The settings of a design cannot be used: names file, field, value and remedy."""


def _alone_or_listed(value: Any) -> Any:
    return [value] if isinstance(value, int | float) else value


class _Table(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class SearchTable(_Table):
    """`[search]`: how hard is searched, and for what."""

    population: int = Field(ge=4, le=10_000, description="a number of individuals, 4 to 10000")
    generations: int = Field(
        ge=1, le=100_000, description="a number of generations, the first one included, 1 to 100000"
    )
    crossover: Share = Field(description="the probability that two parents are mixed, 0 to 1")
    mutation: Share = Field(description="the probability that one gene is changed, 0 to 1")
    crossover_eta: Eta = Field(
        default=15.0, description="how close children stay to their parents (SBX), 1 to 1000"
    )
    mutation_eta: Eta = Field(
        default=20.0, description="how close a changed gene stays to what it was, 1 to 1000"
    )
    weights: tuple[Share, Share] = Field(
        default=(0.7, 0.3),
        description="the weights of log det and of I_c,max / I_c, two shares from 0 to 1 that add "
        "up to 1; methods b and balanced",
    )
    polish: int = Field(
        default=0,
        ge=0,
        le=10_000_000,
        description="a number of individuals to polish the winner with, 0 for no polish",
    )

    @model_validator(mode="after")
    def _weights_share(self) -> SearchTable:
        if abs(sum(self.weights) - 1.0) > 1e-9:
            raise ValueError(
                f"weights {list(self.weights)} add up to {sum(self.weights):g}; they must add up "
                "to 1, e.g. [0.7, 0.3]"
            )
        return self


class ViaPointTable(_Table):
    """`[via_points]`: a motion through via points, as the controller's interpolator runs it."""

    n_via: int = Field(ge=2, le=60, description="a number of via points to search, 2 to 60")
    fly: Share = Field(description="a fly-by fraction, 0 (stop at every via point) to 1")
    slowest: Annotated[FiniteFloat, Field(gt=0, le=1)] = Field(
        description="the smallest share of a joint's speed that is tried, above 0, at most 1"
    )
    range_share: Annotated[FiniteFloat, Field(gt=0, le=1)] = Field(
        default=1.0,
        description="the share of each joint's range, about its middle, that via points lie in, "
        "above 0, at most 1",
    )


class SineTable(_Table):
    """`[sines]`: a sum of sines for each joint (eq. 8 of the paper)."""

    harmonics: int = Field(ge=1, le=20, description="a number of sines for each joint, 1 to 20")
    length: AboveZero = Field(description="the time from beginning to end in s, above 0")
    ramp: Annotated[FiniteFloat, Field(ge=0)] = Field(
        description="the time in s in which the sines grow at the beginning and fade at the end, "
        "0 for none (which no controller can execute)"
    )
    slowest: Annotated[Frequencies, BeforeValidator(_alone_or_listed)] = Field(
        description="the lowest angular frequency in rad/s, above 0: one figure, or one for each "
        "joint"
    )
    fastest: Frequencies | Literal["from limits"] = Field(
        description='the highest angular frequency in rad/s, one for each joint, or "from limits": '
        "the square root of acceleration limit over room, as in the paper's appendix"
    )
    offset: Literal["middle", "home"] | list[FiniteFloat] = Field(
        default="middle",
        description='"middle" of the joints\' ranges, "home" of the cell, or angles in degrees, '
        "one for each joint, in the frame of the cell's [limits]: where the joints swing about",
    )

    @model_validator(mode="after")
    def _ramps_fit(self) -> SineTable:
        if 2.0 * self.ramp > self.length:
            raise ValueError(
                f"two ramps of {self.ramp:g} s do not fit into {self.length:g} s; make the ramp "
                "shorter, or the motion longer"
            )
        return self


class ConstraintTable(_Table):
    """`[constraints]`: what the motion must keep beside the joint limits."""

    min_duration: Annotated[FiniteFloat, Field(ge=0)] = Field(
        default=0.0, description="the duration of the shortest motion in s, 0 for any"
    )
    max_duration: AboveZero = Field(
        default=20.0, description="the duration of the longest motion in s, above 0"
    )
    closed: bool = Field(
        default=True,
        description="true or false: a motion through via points begins and ends in the cell's home",
    )
    collision: bool = Field(
        default=True,
        description="true or false: keep clear of floor, walls and the arm itself ([workspace])",
    )
    current: bool = Field(
        default=True,
        description="true or false: keep the motors' current limits by the nominal model",
    )

    @model_validator(mode="after")
    def _durations_ordered(self) -> ConstraintTable:
        if self.min_duration > self.max_duration:
            raise ValueError(
                f"min_duration = {self.min_duration:g} s is longer than max_duration = "
                f"{self.max_duration:g} s; make it shorter"
            )
        return self


class ObjectiveTable(_Table):
    """`[objective]`: which parameters count."""

    parameters: Literal["all"] | Annotated[list[str], Field(min_length=1)] = Field(
        default="all",
        description='"all", or a list of names of parameters as `hil identify` reports them',
    )
    max_relative_std: Annotated[FiniteFloat, Field(gt=0)] | None = Field(
        default=None,
        description="a percentage: parameters whose standard deviation in the earlier estimate is "
        "a larger share of their value are left out; needs --earlier",
    )

    @model_validator(mode="after")
    def _one_choice(self) -> ObjectiveTable:
        if self.max_relative_std is not None and self.parameters != "all":
            raise ValueError(
                "both parameters and max_relative_std choose what counts; leave one of them out"
            )
        return self


class DesignSettings(_Table):
    """The whole file."""

    method: Method = Field(description='"a", "b", "balanced" or "front"')
    seed: int = Field(
        default=1, ge=0, lt=2**63, description="a whole number, 0 or more; one seed is one result"
    )
    search: SearchTable = Field(description="a table [search]")
    via_points: ViaPointTable | None = Field(default=None, description="a table [via_points]")
    sines: SineTable | None = Field(default=None, description="a table [sines]")
    constraints: ConstraintTable = ConstraintTable()
    objective: ObjectiveTable = ObjectiveTable()

    @model_validator(mode="after")
    def _one_motion(self) -> DesignSettings:
        if (self.via_points is None) == (self.sines is None):
            given = "there are neither" if self.via_points is None else "there are both"
            raise ValueError(
                f"{given} [via_points] and [sines]; a motion is one of the two, so give one of them"
            )
        return self

    def replaced(self, **changes: Any) -> DesignSettings:
        """These settings with some replaced, tables merged field by field, all checked again.

        Raises:
            SettingsError: names field, value and remedy.
        """
        return _validated(None, _merged(self.to_dict(), changes))

    def kinematic(self) -> DesignSettings:
        """These settings with nothing but joint limits and durations to keep, the path open."""
        return self.replaced(
            constraints={"closed": False, "collision": False, "current": False},
        )

    def to_dict(self) -> dict[str, Any]:
        """Return plain data without what is not given."""
        return self.model_dump(mode="json", exclude_none=True)


def preset(method: Method) -> DesignSettings:
    """Return the settings a method comes with."""
    return _validated(None, tomllib.loads(preset_text(method)))


def preset_text(method: Method) -> str:
    """Return a preset as the commented TOML file it is written in, for a person to change."""
    return (files(f"{__package__}.presets") / f"{method}.toml").read_text("utf-8")


def load_settings(path: Path) -> DesignSettings:
    """Read settings; what the file leaves out is as in the preset of its method ("front").

    Raises:
        SettingsError: names file, field, value and remedy.
    """
    try:
        raw = tomllib.loads(path.read_text("utf-8"))
    except OSError as error:
        raise SettingsError(
            path, f"cannot be read ({error.strerror})", remedy="name a TOML file"
        ) from error
    except (ValueError, RecursionError) as error:
        raise SettingsError(
            path, f"is not TOML ({error})", remedy="see `hil design --show-settings front`"
        ) from error
    return settings_of(raw, path)


def settings_of(raw: Mapping[str, Any], path: Path | None = None) -> DesignSettings:
    """Return settings from the data of a file; see :func:`load_settings`."""
    method = raw.get("method", "front")
    if method not in METHODS:
        raise SettingsError(
            path,
            "is no method",
            field=f"method = {method!r:.60}",
            remedy=f"known are: {', '.join(METHODS)}",
        )
    base = tomllib.loads(preset_text(method))
    if any(name in raw for name in _MOTIONS):
        base = {name: table for name, table in base.items() if name not in _MOTIONS}
        if "via_points" in raw and method == "a":
            base["via_points"] = tomllib.loads(preset_text("b"))["via_points"]
        elif "via_points" in raw:
            base["via_points"] = tomllib.loads(preset_text(method))["via_points"]
        if "sines" in raw:
            base["sines"] = tomllib.loads(preset_text("a"))["sines"]
    return _validated(path, _merged(base, raw))


def _merged(base: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    result = dict(base)
    for name, value in changes.items():
        old = result.get(name)
        if isinstance(old, Mapping) and isinstance(value, Mapping):
            result[name] = {**old, **value}
        else:
            result[name] = value
    return result


def _validated(path: Path | None, raw: Mapping[str, Any]) -> DesignSettings:
    try:
        return DesignSettings.model_validate(raw)
    except ValidationError as error:
        complaint = first_error(path or Path(), error, DesignSettings)
        value = complaint.value
        found = "" if value is None else f" = {value!r:.60}"
        raise SettingsError(
            path,
            complaint.problem,
            field=f"{complaint.field}{found}",
            remedy=complaint.remedy,
        ) from error
