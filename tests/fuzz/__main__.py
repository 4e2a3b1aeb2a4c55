"""Coverage-guided fuzzing of all that reads foreign content: ``python -m tests.fuzz TARGET``.

Targets: `codec` (packets, CAN frames), `session` (any conversation of a controller), `cell_file`,
`archive`, `importers`, `urdf`, `documents` (plans, settings, results). Needs atheris, which the
extra ``fuzz`` brings. FOLDER/corpus has the inputs that reach new code, with which the same command
begins again; FOLDER/findings a folder per cause, with the input and its traceback. libFuzzer ends
with an artefact in FOLDER where one input crashes Python, or takes too long or too much memory.

Examples:
  python -m tests.fuzz session --minutes 5 --folder runs/fuzz/session
  python -m tests.fuzz session --once runs/fuzz/session/findings/CAUSE/input
"""

from __future__ import annotations

import hashlib
import logging
import resource
import sys
import traceback
import warnings
from pathlib import Path

from tests.arguments import parser_of, time_above_0
from tests.fuzz import targets

ROOT = Path(__file__).resolve().parents[2]
OURS = ("hil", "drivers", "planner", "identification", "sim_fixtures")
INPUT = "input"
TRACEBACK = "traceback.txt"
LONGEST = 5  # s for one input
MEMORY = 1 << 10  # MB resident
ADDRESSES = 6 << 30  # bytes of address space, so that an absurd array is refused and not tried


def main(arguments: list[str] | None = None) -> int:
    """Run the command; with `--once` run one input, which raises where it violates a law."""
    parser = parser_of("tests.fuzz", __doc__)
    option = parser.add_argument
    option("target", choices=targets.NAMES)
    option("--minutes", type=time_above_0, default=1.0)
    option("--folder", type=Path, help="of corpus and findings")
    option("--once", type=Path, metavar="INPUT", help="run one input without atheris")
    given = parser.parse_args(arguments)
    warnings.simplefilter("error")
    warnings.filterwarnings("ignore", category=DeprecationWarning, module="rosbags")
    logging.disable(logging.CRITICAL)
    resource.setrlimit(resource.RLIMIT_AS, (ADDRESSES, ADDRESSES))
    if given.once is not None:
        targets.load(given.target).run(given.once.read_bytes())
    elif given.folder is None:
        parser.error("name a --folder, or an input with --once")
    else:
        fuzz(given.target, given.minutes, given.folder)
    return 0


def fuzz(name: str, minutes: float, folder: Path) -> None:
    """Fuzz a target; libFuzzer ends this process."""
    import atheris

    with atheris.instrument_imports(include=[*OURS, "tomllib", "rosbags", "mcap"]):
        target = targets.load(name)
    corpus = folder / "corpus"
    findings = folder / "findings"
    for made in (corpus, findings):
        made.mkdir(parents=True, exist_ok=True)
    for data in target.seeds():  # named as libFuzzer names them
        (corpus / hashlib.sha1(data, usedforsecurity=False).hexdigest()).write_bytes(data)

    def one(data: bytes) -> None:
        try:
            target.run(data)
        except KeyboardInterrupt:
            raise
        except BaseException as error:
            record_finding(findings, error, data)

    def mutate(data: bytes, most: int, seed: int) -> bytes:
        # Half of the changes are libFuzzer's own, which knows what comparisons were missed.
        if seed & 1:
            return bytes(atheris.Mutate(data, most))
        return target.mutate(data, most, seed >> 1)

    options = (
        f"-timeout={LONGEST}", f"-rss_limit_mb={MEMORY}", f"-max_len={target.most}",
        f"-max_total_time={round(60.0 * minutes)}", f"-artifact_prefix={folder}/", "-reload=0",
    )  # fmt: skip
    places = (str(corpus), str(targets.CORPORA / name))
    atheris.Setup([sys.argv[0], *options, *places], one, custom_mutator=mutate)
    atheris.Fuzz()


def record_finding(findings: Path, error: BaseException, data: bytes) -> None:
    """Store an input that violated a law, one of each cause."""
    folder = findings / signature(error)
    if not folder.exists():
        folder.mkdir(parents=True)
        (folder / INPUT).write_bytes(data)
        text = "".join(traceback.format_exception(error, limit=-60))
        (folder / TRACEBACK).write_text(text, "utf-8", errors="backslashreplace")


def signature(error: BaseException) -> str:
    """Return a name of the cause: the kind of error and the last line of the product.

    Of a RecursionError it is the first line, since the last is arbitrary.
    """
    places = [
        f"{Path(frame.filename).relative_to(ROOT)}:{frame.lineno}"
        for frame in traceback.extract_tb(error.__traceback__)
        if Path(frame.filename).is_relative_to(ROOT) and ".venv" not in Path(frame.filename).parts
    ]
    own_places = [place for place in places if place.split("/")[0] in OURS] or places or ["nowhere"]
    place = own_places[0 if isinstance(error, RecursionError) else -1]
    return f"{type(error).__name__}-{place.replace('/', '.')}".replace(":", "-")


if __name__ == "__main__":
    sys.exit(main())
