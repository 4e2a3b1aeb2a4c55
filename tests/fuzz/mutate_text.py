"""Changes of texts that keep most of their grammar: values, words, lines and brackets."""

from __future__ import annotations

import random
import re

from tests.fuzz.mutate_bytes import mutate_bytes

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
    words = [k for k, token in enumerate(tokens) if not token.isspace()] or [0]
    numbers = [k for k in words if tokens[k][:1].isdigit() or tokens[k][:1] in "-+"]
    at = rng.choice(numbers) if numbers and rng.random() < 0.5 else rng.choice(words)
    kind = rng.random()
    if kind < 0.45:
        tokens[at] = rng.choice(_VALUES)
    elif kind < 0.65:
        tokens[at] = tokens[rng.choice(words)]
    elif kind < 0.8:
        del tokens[at : at + rng.choice((1, 1, 2, 5))]
    elif kind < 0.9:
        tokens.insert(at, tokens[rng.choice(words)])
    else:
        tokens[at] = tokens[at] * rng.choice((2, 2, 3, 50))
    return "".join(tokens)


def _of_lines(text: str, rng: random.Random) -> str:
    lines = text.splitlines(keepends=True) or [""]
    at, other = rng.randrange(len(lines)), rng.randrange(len(lines))
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
