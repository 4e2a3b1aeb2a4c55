"""What a controller states of itself when a link is opened, as the first packet of a session."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, fields
from typing import Any, ClassVar, Final, Literal, Self

import numpy as np

from drivers.arrays import Array
from drivers.errors import PacketError
from drivers.ur.identity import ArmIdentity, DhParameters
from drivers.ur.rtde import ControllerVersion, OutputRecipe, RtdeError

START: Final = b"{"
"""First byte of such a packet, which no frame of RTDE has."""
_VECTORS: Final = ("lower", "upper", "velocity", "acceleration")
_DH: Final = ("nominal", "calibrated")


@dataclass(frozen=True, eq=False)
class UrDescription:
    """An arm, its controller, and what both ends agreed on.

    Attributes:
        identity: of the arm.
        version: of the controller's software.
        frequency: frames per second.
        recipe: outputs of each frame.
        inputs: number of the recipe of inputs.
        period: cycle, s.
    """

    attachment: ClassVar[str] = "ur_arm.json"
    identity: ArmIdentity
    version: ControllerVersion
    frequency: float
    recipe: OutputRecipe
    inputs: int
    period: float = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "period", 1.0 / self.frequency)

    def encode(self) -> bytes:
        """Return the packet, which is also the file of an archive."""
        return json.dumps(
            {
                **identity_document(self.identity),
                "version": list(self.version),
                "frequency": self.frequency,
                "outputs": dict(zip(self.recipe.names, self.recipe.types, strict=True)),
                "recipes": [self.recipe.number, self.inputs],
            }
        ).encode()

    @classmethod
    def decode(cls, packet: bytes) -> Self:
        """Return what a packet states, or raise PacketError."""
        try:
            document = json.loads(packet)
            outputs = document["outputs"]
            number, inputs = document["recipes"]
            recipe = OutputRecipe(number, tuple(outputs), tuple(outputs.values()))
            return cls(
                identity=_identity(document),
                version=ControllerVersion(*document["version"]),
                frequency=float(document["frequency"]),
                recipe=recipe,
                inputs=int(inputs),
            )
        except (ValueError, KeyError, TypeError, RtdeError) as error:
            raise PacketError("introduction", packet[:40], f"that of an arm ({error!r})") from error

    def stated(
        self, limit: Literal["current_limit", "following_error"], arm: int, n_joints: int
    ) -> Array:
        """Return NaN (n,): such limits are not stated."""
        del limit, arm
        return np.full(n_joints, np.nan)


def identity_document(identity: ArmIdentity) -> dict[str, Any]:
    """Return an identity in JSON types."""
    document: dict[str, Any] = {}
    for entry in fields(identity):
        value = getattr(identity, entry.name)
        if isinstance(value, DhParameters):
            value = {name: array.tolist() for name, array in asdict(value).items()}
        elif isinstance(value, np.ndarray):
            value = value.tolist()
        elif isinstance(value, Sequence) and not isinstance(value, str):
            value = [*value]
        document[entry.name] = value
    return document


def _identity(document: dict[str, Any]) -> ArmIdentity:
    names = [entry.name for entry in fields(ArmIdentity)]
    values: dict[str, Any] = {name: document.get(name) for name in names}
    for name in _VECTORS:
        if values[name] is not None:
            values[name] = np.array(values[name], dtype=np.float64)
    for name in _DH:
        if (table := values[name]) is not None:
            values[name] = DhParameters(**{key: np.array(row) for key, row in table.items()})
    values["unreachable"] = tuple(values["unreachable"] or ())
    return ArmIdentity(**values)
