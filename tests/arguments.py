"""Options of the long commands, checked before anything runs."""

from __future__ import annotations

import argparse
import math
from functools import partial


def parser_of(package: str, description: str | None, epilog: str = "") -> argparse.ArgumentParser:
    """Return the parser of `python -m` this package, with texts as they are."""
    return argparse.ArgumentParser(
        prog=f"python -m {package}",
        description=description,
        epilog=epilog,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )


def whole_number(text: str, least: int = 0) -> int:
    """Parse a whole number."""
    if not text.isdecimal() or int(text) < least:
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number of {least} or more")
    return int(text)


at_least_one = partial(whole_number, least=1)


def time_above_0(text: str) -> float:
    """Parse a finite time above 0."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0.0 < value < math.inf:
        raise argparse.ArgumentTypeError(f"{text!r} is not a time above 0")
    return value
