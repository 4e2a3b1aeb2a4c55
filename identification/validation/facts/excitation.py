"""Facts about the fitted motion: which parameters it determines, and how well."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np

from identification.validation.evidence import Evidence
from identification.validation.finding import Finding, Mask, Naming, Thresholds

_RICHER: Final = "design a motion for this arm (`hil design`) and record it"


def _friction_pair(joint: int) -> tuple[str, str]:
    """Return the labels of Coulomb friction and offset of a joint."""
    return f"f0_{joint + 1}", f"fo_{joint + 1}"


@dataclass(frozen=True, eq=False)
class ExcitationFacts:
    """Parameters without an estimate, joints that moved in one direction, condition number."""

    undetermined: tuple[str, ...]  # parameters, those of `only_sum` left out
    #: joints that moved in one direction only, of whose friction only a sum is determined (n,)
    only_sum: Mask
    one_way: Mask  #: the others that moved in one direction only (n,)
    determined: bool  #: whether every parameter has an estimate
    condition: float  #: condition number of the regressor with unit columns
    limit: float  #: of the condition number

    @classmethod
    def of(cls, evidence: Evidence, limits: Thresholds) -> ExcitationFacts:
        """Separate what a motion in one direction explains from other undetermined parameters."""
        labels = evidence.estimate.undetermined
        one_way = evidence.one_way
        if one_way is None:
            one_way = np.zeros(len(evidence.held_out.rows), dtype=np.bool_)
        # Of a joint that moved in one direction both are the same column.
        both = [{*_friction_pair(joint)} <= {*labels} for joint in range(len(one_way))]
        only_sum = np.array(both, dtype=np.bool_) & one_way
        explained = {
            label for joint in np.flatnonzero(only_sum).tolist() for label in _friction_pair(joint)
        }
        return cls(
            undetermined=tuple(label for label in labels if label not in explained),
            only_sum=only_sum,
            one_way=one_way & ~only_sum,
            determined=not labels,
            condition=evidence.estimate.condition,
            limit=limits.condition,
        )

    def findings(self, naming: Naming) -> Iterator[Finding]:
        """Yield what the motion does not determine, or determines poorly."""
        condition = f"condition number {self.condition:.0f} of the regressor with unit columns"
        poor = self.condition > self.limit
        if self.undetermined:
            labels = ", ".join(self.undetermined)
            message = f"the motion does not determine {labels}"
            yield Finding("excitation", "wrong", message, _RICHER)
        if self.only_sum.any():
            joints = naming.of(self.only_sum)
            pairs = naming.each(self.only_sum, lambda joint: " and ".join(_friction_pair(joint)))
            yield Finding(
                "excitation",
                "wrong",
                "the motion determines only the sum of Coulomb friction and offset of the torque"
                f" of {joints}, which moved in one direction only: {pairs}",
                f"record a motion in which {joints} moves in both directions",
            )
        if self.determined and poor:
            yield Finding(
                "excitation",
                "doubtful",
                f"the motion excites the parameters poorly: {condition}, limit {self.limit:.0f};"
                " predictions are reliable for similar motions only, single parameters are not",
                _RICHER,
            )
        if self.one_way.any():
            joints = naming.of(self.one_way)
            yield Finding(
                "excitation",
                "doubtful",
                f"{joints} moved in one direction only on the fitted motion: Coulomb friction and"
                " offset of the torque are one column of the regressor there, and only their sum"
                " is determined",
                f"record a motion in which {joints} moves in both directions",
            )
        if self.determined and not poor:
            message = f"the motion determines every parameter: {condition}"
            yield Finding("excitation", "good", message)
