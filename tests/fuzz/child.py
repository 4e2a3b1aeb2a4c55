"""One process of a target: fuzzes it with libFuzzer, or runs one input without.

``python -m tests.fuzz.child TARGET --fuzz FINDINGS [libFuzzer's own options and folders]``
``python -m tests.fuzz.child TARGET --once FILE`` runs one input without libFuzzer: exit status 0,
or 1 with the traceback, 3 where more than 1 GB was resident, or a signal: SIGPROF where it takes
more than 5 s of processor time.
"""

from __future__ import annotations

import faulthandler
import logging
import resource
import signal
import sys
import traceback
import warnings
from pathlib import Path

LONGEST = 5  # s of processor time for one input
MEMORY = 1 << 10  # MB resident
ADDRESSES = 6 << 30  # bytes of address space, so that an absurd array is refused and not tried


def main(arguments: list[str]) -> int:
    """Run the command line above."""
    name, act, place, *rest = arguments
    warnings.simplefilter("error")
    warnings.filterwarnings("ignore", category=DeprecationWarning, module="rosbags")
    logging.disable(logging.CRITICAL)
    if act == "--fuzz":
        return _fuzz(name, Path(place), rest)
    from tests.fuzz import targets

    target = targets.load(name)
    _limit()
    faulthandler.enable()
    # Then the default action: the process ends by this signal.
    faulthandler.register(signal.SIGPROF, chain=True)
    signal.setitimer(signal.ITIMER_PROF, LONGEST)
    target.run(Path(place).read_bytes())
    return 3 if _most_resident() > MEMORY else 0


def _most_resident() -> int:
    """Return it in MB; `getrusage` includes the process that started this one."""
    status = Path("/proc/self/status").read_text("ascii")
    return int(status.partition("VmHWM:")[2].split()[0]) >> 10


def _limit() -> None:
    resource.setrlimit(resource.RLIMIT_AS, (ADDRESSES, ADDRESSES))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))


def _fuzz(name: str, folder: Path, options: list[str]) -> int:
    import atheris

    from tests.fuzz.libfuzzer import OURS, record_finding, signature

    with atheris.instrument_imports(include=[*OURS, "tomllib", "rosbags", "mcap"]):
        from tests.fuzz import targets

        target = targets.load(name)
    _limit()

    def one(data: bytes) -> None:
        try:
            target.run(data)
        except KeyboardInterrupt:
            raise
        except BaseException as error:
            cause, text = signature(error), "".join(traceback.format_exception(error, limit=-60))
            if record_finding(folder, cause, data, text):
                sys.stderr.write(f"FINDING: {cause}\n")

    def mutate(data: bytes, most: int, seed: int) -> bytes:
        # Half of the changes are libFuzzer's own, which knows what comparisons were missed.
        if seed & 1:
            return bytes(atheris.Mutate(data, most))
        return target.mutate(data, most, seed >> 1)

    atheris.Setup(
        [sys.argv[0], f"-timeout={LONGEST}", f"-rss_limit_mb={MEMORY}", *options],
        one,
        custom_mutator=mutate,
    )
    atheris.Fuzz()
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
