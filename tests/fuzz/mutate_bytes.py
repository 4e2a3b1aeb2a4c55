"""Blind changes of bytes, such as any fuzzer makes; the same seed makes the same ones."""

from __future__ import annotations

import random

STRANGE = (0, 1, 2, 0x7F, 0x80, 0xFE, 0xFF)
NUMBERS = (0, 1, -1, 10, 11, 12, 0x7FFF, 0x8000, 2**31 - 1, -(2**31))


def mutate_bytes(data: bytes, most: int, seed: int) -> bytes:
    """One to four changes: bytes flipped, replaced, taken out, repeated, moved, cut off."""
    rng = random.Random(seed)
    changed = bytearray(data) or bytearray(1)
    for _ in range(rng.randint(1, 4)):
        _change(changed, rng)
        if not changed:
            changed += b"\0"
    return bytes(changed[:most])


def _change(data: bytearray, rng: random.Random) -> None:
    at, length = rng.randrange(len(data)), rng.choice((1, 2, 4, 8, 36, 64))
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
