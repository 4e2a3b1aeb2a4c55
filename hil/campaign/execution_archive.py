"""What the archive of a campaign's motion carries with it."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from hil.archive import ArchiveHeader, ArchiveName, ArchiveSpec
from hil.cell import Cell
from hil.recording import dated_anew, origin_of
from hil.version import software

from .dry_run import SIMULATED, said_of
from .folder import CampaignFolder
from .intervals import Interval
from .plan import CampaignPlan, moves_to_dict

REPEATED = ("excitation", "warmup")
"""Kinds that run the excitation as it was designed."""


@dataclass(frozen=True, eq=False)
class Archiving:
    """Describes the archives of one run.

    Attributes:
        folder: of the campaign.
        cell: of the campaign.
        plan: of the campaign.
        provenance: goes into the metadata of every archive.
        durable: wait at each flush until the disk has the data.
        plan_hash: of exactly this cell, URDF and plan.
    """

    folder: CampaignFolder
    cell: Cell
    plan: CampaignPlan
    provenance: Mapping[str, str]
    durable: bool
    plan_hash: str

    def spec(self, interval: Interval) -> ArchiveSpec:
        """The archive of the next attempt at an interval."""
        cell, name = self.cell, self.folder.next_name(interval.kind, interval.index)
        return ArchiveSpec(
            self.folder.archives / name.filename,
            joint_names=cell.joint_names,
            period=cell.period,
            metadata=self._metadata() | dated_anew(self.provenance),
            attachments={
                "cell.toml": cell.text.encode(),
                "robot.urdf": cell.urdf.encode(),
                "drive_train.json": cell.drive_table.model_dump_json().encode(),
                "plan.json": json.dumps(self._plan_of(interval)).encode(),
            },
            durable=self.durable,
        )

    def made(self, header: ArchiveHeader) -> bool:
        """Whether an archive with this header was made of exactly this plan, by such an arm."""
        arm = self.provenance.get(SIMULATED)
        return header.plan_hash == self.plan_hash and header.simulated == arm

    def _plan_of(self, interval: Interval) -> dict[str, Any]:
        """The trajectory of an interval, its moves, and how an excitation was found."""
        moves = moves_to_dict(interval.moves)
        if interval.kind in REPEATED:
            return {"excitation": self.plan.excitation.to_dict(), **moves}
        return {"trajectory": interval.trajectory.to_dict(), **moves}

    def _metadata(self) -> dict[str, str]:
        # One seed is one campaign to the byte, whatever its folder is called.
        simulated = self.provenance.get(SIMULATED) == said_of(True)
        named = {} if simulated else {"campaign": self.folder.root.resolve().name}
        return {
            **named,
            "cell": self.cell.name,
            "plan_hash": self.plan_hash,
            **{f"software.{name}": version for name, version in software().items()},
        }


def provenance_of(
    cell: Cell, said: Mapping[str, str] | None, *, virtual: bool, only_simulated: bool
) -> dict[str, str]:
    """What is said of where archives come from; a time of day only in real time.

    Args:
        cell: of the campaign.
        said: by the caller, who alone knows what a link of his simulates; None for nothing.
        virtual: whether time is.
        only_simulated: whether nothing but a simulated arm can move. No caller changes that.
    """
    if not virtual:
        own = origin_of(cell, only_simulated=only_simulated, virtual=False)
    elif said is None:
        from hil.simulation import simulated_provenance  # it opens links of ours

        own = simulated_provenance(cell, effects=False)
    else:
        own = {}
    return own | dict(said or {}) | {SIMULATED: said_of(only_simulated)}


def not_entered(folder: CampaignFolder) -> list[str]:
    """Archives that lie in the folder and not in its manifest, by name."""
    entered = {entry.name for entry in folder.manifest()}
    found = sorted(path.name for path in folder.archives.glob("*.mcap"))
    return [name for name in found if name not in entered and ArchiveName.parse(name)]
