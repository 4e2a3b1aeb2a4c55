"""Which archives there are: found below folders, examined where they lie, told apart."""

from __future__ import annotations

import operator
from collections.abc import Iterator, Sequence
from pathlib import Path
from sys import intern
from typing import Final, NamedTuple

from hil.archive import ArchiveName
from hil.archive.header import KINDS
from hil.campaign.errors import CampaignFolderError
from hil.campaign.folder import CampaignFolder, Entry
from hil.errors import ArchiveError
from hil.progress import Reporter, Silent, Task

from .cache import Where
from .errors import NothingToFitError
from .examining import USES, Examined, Facts, examined, noted
from .on_workers import ArchiveTask
from .places import Place, below
from .types import ArchiveRef, Broken
from .workers import Workers


class Manifests:
    """The manifests of the campaigns that archives lie in, each read once.

    Attributes:
        broken: manifests that cannot be read; nothing can be checked against them.
    """

    def __init__(self) -> None:
        self.broken: list[Broken] = []
        self._known: dict[str, dict[str, Entry] | None] = {}

    def objection(self, place: Place, sha256: str) -> str:
        """Why the manifest says that an archive is not what was recorded; "" if it does not."""
        entry = self._entry(place)
        if entry is None or entry.sha256 == sha256:
            return ""
        return "is not what its campaign's manifest.json says"

    def outcome(self, place: Place) -> str:
        """How the manifest says that an archive ended; "" if it does not say."""
        entry = self._entry(place)
        return "" if entry is None else entry.outcome

    def not_entered(self, place: Place) -> bool:
        """Whether an archive of a campaign's motion is not in the campaign's manifest.

        A run that was killed may have closed it and not lived to judge it.
        """
        entries = self._entries(place)
        return (
            entries is not None
            and place.name not in entries
            and bool(ArchiveName.parse(place.name))
        )

    def _entry(self, place: Place) -> Entry | None:
        return (self._entries(place) or {}).get(place.name)

    def _entries(self, place: Place) -> dict[str, Entry] | None:
        """Those of its campaign by name; None where there is no manifest to be read."""
        if place.remote or place.campaign == place.folder:
            return None
        if place.campaign not in self._known:
            self._known[place.campaign] = self._read(Path(place.campaign))
        return self._known[place.campaign]

    def _read(self, campaign: Path) -> dict[str, Entry] | None:
        folder = CampaignFolder(campaign)
        try:
            return {entry.name: entry for entry in folder.manifest()} if folder.sealed else None
        except CampaignFolderError as error:
            reason = f"{error}; the campaign's archives are used without being checked against it"
            self.broken.append(Broken((campaign / "manifest.json").as_posix(), reason))
            return None


_TOGETHER: Final = 512
"""Archives whose facts are fetched at once: few enough to be held beside all others."""

_REHEARSAL: Final = "/rehearsal/"  # see `hil.campaign.folder`
_NOT_ENTERED: Final = (
    "is not named in its campaign's manifest.json: nobody has judged it (a run was killed; the "
    "next one takes it in)"
)
_COMPLETED: Final = "completed"
_NEVER_FITTED: Final = frozenset(KINDS) - {*USES, "imported"}


class Discovery(NamedTuple):
    """What was found.

    Attributes:
        refs: archives to use, in canonical order.
        broken: files that cannot be used and folders that cannot be looked into, by path.
        skipped: archives that are not meant to be fitted, and why, by path.
    """

    refs: tuple[ArchiveRef, ...]
    broken: tuple[Broken, ...]
    skipped: tuple[Broken, ...]


def discover(
    roots: Sequence[str],
    where: Where,
    workers: Workers,
    reporter: Reporter = Silent(),  # noqa: B008 - without state
) -> Discovery:
    """Find every archive at or below some places.

    Workers hash archives and look into them; here only small facts are gathered. An archive that
    was examined before, and whose file nobody has touched since, is not opened.

    Args:
        roots: folders, archives, or URLs of either.
        where: notes on archives are kept.
        workers: who does the work on archives.
        reporter: of progress.

    Raises:
        InputError: a place does not exist, or an address cannot be read.
        NothingToFitError: there is no archive below any.
        CacheError: nothing can be kept where it should be.
    """
    places = below(roots)
    if not places.found:
        raise _nothing(roots, places.refused)
    with reporter.task("looking into archives", len(places.found)) as task:
        if workers.near:
            known = {place: one for place in places.found if (one := _noted(place, where))}
            task.advance(len(known))
        else:
            known = {}  # the notes are where the archives are
        unknown = [place for place in places.found if place not in known]
        known.update(zip(unknown, _examined(unknown, where, workers, task), strict=True))
    found = _sorted_out(places.found, [known[place] for place in places.found])
    return Discovery(found.refs, (*places.refused, *found.broken), (*places.left, *found.skipped))


def _nothing(roots: Sequence[str], refused: Sequence[Broken]) -> NothingToFitError:
    problem = "there is no archive (*.mcap) in it"
    if refused:
        problem += f", and {refused[0].path} {refused[0].reason}"
    return NothingToFitError(roots[0] if roots else None, problem, remedy="name others")


def _noted(place: Place, where: Where) -> Examined | Broken | None:
    try:
        return noted(place, where)
    except ArchiveError as error:
        return Broken(place.location, str(error))


def _examined(
    places: Sequence[Place], where: Where, workers: Workers, task: Task
) -> Iterator[Examined | Broken]:
    groups = [
        [
            ArchiveTask(place.location, examined, (place, where))
            for place in places[begin : begin + _TOGETHER]
        ]
        for begin in range(0, len(places), _TOGETHER)
    ]
    for one in workers.sums_in_turn(groups, operator.add, done=task.advance):
        yield from one.notes


def _sorted_out(places: Sequence[Place], found: Sequence[Examined | Broken]) -> Discovery:
    refs: list[ArchiveRef] = []
    harmed: list[tuple[Place, Broken]] = []
    skipped: list[Broken] = []
    manifests = Manifests()
    read: list[tuple[Place, Examined]] = []
    for place, one in zip(places, found, strict=True):
        if isinstance(one, Broken):
            harmed.append((place, one))
        elif reason := manifests.objection(place, one.facts.sha256):
            harmed.append((place, Broken(place.location, reason)))
        elif one.facts.use in USES and manifests.not_entered(place):
            skipped.append(Broken(place.location, _NOT_ENTERED))
        else:
            read.append((place, _with_outcome(one, manifests.outcome(place))))
    sieve = _Sieve(read)
    broken: list[Broken] = []
    for place, harm in harmed:
        reason = sieve.replaced(place)
        if reason:
            skipped.append(Broken(harm.path, reason))
        else:
            broken.append(harm)
    for place, one in read:
        reason = sieve.objection(place, one.facts)
        if reason:
            skipped.append(Broken(place.location, reason))
        else:
            refs.append(_ref(place, one))
    return Discovery(
        tuple(sorted(refs, key=lambda ref: ref.order)),
        (*manifests.broken, *broken),
        tuple(skipped),
    )


def _with_outcome(one: Examined, recorded: str) -> Examined:
    """What the manifest says of the outcome counts if it is worse than what the archive says."""
    if recorded in ("", _COMPLETED):
        return one
    return one._replace(facts=one.facts._replace(outcome=recorded))


class _Sieve:
    """Tells archives that are meant to be fitted from copies, failures and earlier attempts."""

    def __init__(self, read: Sequence[tuple[Place, Examined]]) -> None:
        self._latest: dict[tuple[str, str, int], int] = {}
        self._seen: dict[str, str] = {}
        for place, (facts, _) in read:
            if facts.attempt and facts.outcome == _COMPLETED:
                key = (place.folder, facts.kind, facts.number)
                self._latest[key] = max(self._latest.get(key, 0), facts.attempt)

    def replaced(self, place: Place) -> str:
        """Why nothing is missing with an archive that cannot be used; "" if something is.

        A run that was killed, or whose disk was full, leaves torn ones, and the next run makes the
        motion again.
        """
        name = ArchiveName.parse(place.name)
        if name is None:
            return ""
        if name.kind in _NEVER_FITTED:
            return f"is a {name.kind}"
        last = self._latest.get((place.folder, name.kind, name.index), 0)
        return f"attempt {last} took the place of this unusable one" if name.attempt < last else ""

    def objection(self, place: Place, facts: Facts) -> str:
        """Why an archive is not meant to be fitted; "" if it is."""
        if facts.use not in USES:
            return f"is a {facts.use}"
        if facts.simulated and _REHEARSAL in place.location:
            return "belongs to a rehearsal"
        if facts.outcome != _COMPLETED:
            return f"ended {facts.outcome}"
        last = self._latest.get((place.folder, facts.kind, facts.number), facts.attempt)
        if facts.attempt and facts.attempt < last:
            return f"attempt {last} took its place"
        if facts.sha256 in self._seen and facts.use != "standstill":
            return f"holds the same as {self._seen[facts.sha256]}"
        if facts.attempt:
            first = self._seen.setdefault(f"{place.folder} {facts.record}", place.name)
            if first != place.name:
                return f"is a copy of {first}, or was repaired from it"
        self._seen[facts.sha256] = place.location
        return ""


def _ref(place: Place, one: Examined) -> ArchiveRef:
    """Texts that many archives share are held once: there may be very many archives."""
    facts = one.facts
    return ArchiveRef(
        location=place.location,
        sha256=facts.sha256,
        use=intern(facts.use),
        arm=intern(facts.arm),
        campaign=intern(place.campaign),
        index=facts.number,
        cell=intern(facts.cell),
        motion=intern(facts.motion),
        when=intern(facts.when),
        setup=intern(facts.setup),
        belief=intern(facts.belief),
        stamp=one.stamp,
    )
