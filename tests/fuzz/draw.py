"""Bytes as decisions: a changed byte changes one decision, not all that follow."""

from __future__ import annotations

import random
import re
import struct
from collections.abc import Sequence
from typing import TypeVar

T = TypeVar("T")


class Draw:
    """Takes decisions off the front of bytes; when they run out, everything is the first choice."""

    def __init__(self, data: bytes) -> None:
        self._data = data
        self._at = 0

    @property
    def left(self) -> int:
        """Bytes that no decision has used yet."""
        return len(self._data) - self._at

    def raw(self, count: int) -> bytes:
        """Up to `count` bytes as they are."""
        part = self._data[self._at : self._at + count]
        self._at += len(part)
        return part

    def byte(self) -> int:
        part = self.raw(1)
        return part[0] if part else 0

    def below(self, bound: int) -> int:
        """0..bound - 1, for bounds up to 65536."""
        size = 1 if bound <= 256 else 2
        return int.from_bytes(self.raw(size), "little") % bound

    def between(self, low: int, high: int) -> int:
        """`low`..`high`, both possible."""
        return low + self.below(high - low + 1)

    def choice(self, options: Sequence[T]) -> T:
        return options[self.below(len(options))]

    def chance(self, of_256: int) -> bool:
        """True for so many of the 256 values of a byte, never where the bytes have run out."""
        return bool(self.left) and self.byte() >= 256 - of_256

    def integer(self) -> int:
        """Any int32."""
        value: int = struct.unpack("<i", self.raw(4).ljust(4, b"\0"))[0]
        return value

    def float32(self) -> float:
        """Any float32, NaN and infinities too."""
        value: float = struct.unpack("<f", self.raw(4).ljust(4, b"\0"))[0]
        return value

    def rest(self) -> bytes:
        return self.raw(self.left)


STRANGE = (0, 1, 2, 0x7F, 0x80, 0xFE, 0xFF)
NUMBERS = (0, 1, -1, 10, 11, 12, 0x7FFF, 0x8000, 2**31 - 1, -(2**31))


def mutate_bytes(data: bytes, most: int, seed: int) -> bytes:
    """One to four changes: bytes flipped, replaced, removed, repeated, moved, cut off."""
    rng = random.Random(seed)
    changed = bytearray(data) or bytearray(1)
    for _ in range(rng.randint(1, 4)):
        _change(changed, rng)
        if not changed:
            changed += b"\0"
    return bytes(changed[:most])


def _change(data: bytearray, rng: random.Random) -> None:
    at = rng.randrange(len(data))
    length = rng.choice((1, 2, 4, 8, 36, 64))
    kind = rng.randrange(7)
    if kind == 0:
        data[at] ^= 1 << rng.randrange(8)
    elif kind == 1:
        data[at] = rng.choice(STRANGE)
    elif kind == 2:
        data[at : at + 4] = rng.choice(NUMBERS).to_bytes(4, "little", signed=True)
    elif kind == 3:
        del data[at : at + length]
    elif kind == 4:
        data[at:at] = data[at : at + length]
    elif kind == 5:
        data[at : at + length] = rng.randbytes(length)
    else:
        other = rng.randrange(len(data))
        data[at:at] = data[other : other + length]


_TOKEN = re.compile(r"""[-+]?\d[\d_.eE+-]*|"[^"\n]*"|'[^'\n]*'|[A-Za-z_][\w.-]*|\s+|.""", re.DOTALL)
_VALUES = (
    "0", "-1", "1", "2", "1e308", "-1e-308", "1e999", "nan", "inf", "-inf", "NaN", "Infinity",
    "9" * 25, "9" * 5000, "0.1", "1e-12", "true", "false", "null", '""', '"?"', '"x"', "[]", "{}",
    "[1.0]", "[[1]]", "[" * 1500, "{\"a\":" * 1500, '"\\u0000"', '"\\ud800"', "1979-05-27",
    "'../../x'", "\"/dev/zero\"", "\0", "\u202e", "\n", "<", "&", "&amp;", "&#0;", "'", '"', "0x10",
)  # fmt: skip


def mutate_text(data: bytes, most: int, seed: int) -> bytes:
    """One to three changes of tokens and lines; one in eight inputs is changed blindly instead."""
    rng = random.Random(seed)
    if rng.random() < 0.125:
        return mutate_bytes(data, most, seed)
    text = data.decode("utf-8", "surrogateescape")
    for _ in range(rng.choice((1, 1, 1, 2, 2, 3))):
        text = _of_lines(text, rng) if rng.random() < 0.25 else _of_tokens(text, rng)
    return text.encode("utf-8", "surrogateescape")[:most]


def _of_tokens(text: str, rng: random.Random) -> str:
    tokens = _TOKEN.findall(text) or [""]
    visible = [k for k, token in enumerate(tokens) if not token.isspace()] or [0]
    numbers = [k for k in visible if tokens[k][:1].isdigit() or tokens[k][:1] in "-+"]
    at = rng.choice(numbers) if numbers and rng.random() < 0.5 else rng.choice(visible)
    kind = rng.random()
    if kind < 0.45:
        tokens[at] = rng.choice(_VALUES)
    elif kind < 0.65:
        tokens[at] = tokens[rng.choice(visible)]
    elif kind < 0.8:
        del tokens[at : at + rng.choice((1, 1, 2, 5))]
    elif kind < 0.9:
        tokens.insert(at, tokens[rng.choice(visible)])
    else:
        tokens[at] = tokens[at] * rng.choice((2, 2, 3, 50))
    return "".join(tokens)


def _of_lines(text: str, rng: random.Random) -> str:
    lines = text.splitlines(keepends=True) or [""]
    at = rng.randrange(len(lines))
    other = rng.randrange(len(lines))
    kind = rng.randrange(4)
    if kind == 0:
        del lines[at : at + rng.choice((1, 1, 3))]
    elif kind == 1:
        lines.insert(other, lines[at])
    elif kind == 2:
        lines[at], lines[other] = lines[other], lines[at]
    else:
        first, last = sorted((at, other))
        lines[first:first] = lines[first : min(last, first + 6)]
    return "".join(lines)
