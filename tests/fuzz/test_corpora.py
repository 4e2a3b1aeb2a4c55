"""The corpora and some changes of them violate no law; atheris is not needed."""

from __future__ import annotations

import random
import subprocess
import sys
from pathlib import Path

import pytest

from tests.fuzz import targets
from tests.fuzz.corpora import inputs
from tests.fuzz.targets import CORPORA

pytestmark = pytest.mark.safety

MOST_FILES = 40
MOST_BYTES = 200_000


@pytest.mark.parametrize("name", targets.NAMES)
def test_corpus_is_small_and_violates_no_law(name: str) -> None:
    target = targets.load(name)
    corpus = inputs(name)
    assert 0 < len(corpus) <= MOST_FILES
    assert len(set(corpus)) == len(corpus)
    assert sum(map(len, corpus)) <= MOST_BYTES
    for data in corpus:
        target.run(data)


@pytest.mark.parametrize("name", targets.NAMES)
def test_well_formed_input_is_accepted(name: str) -> None:
    target = targets.load(name)
    seeds = target.seeds()
    assert [at for at, data in enumerate(seeds) if not target.run(data)] == []
    planted = [path.name for path in sorted((CORPORA / name).glob("seed-*"))]
    assert [
        file_name
        for file_name in planted
        if not target.run((CORPORA / name / file_name).read_bytes())
    ] == []


@pytest.mark.parametrize("name", targets.NAMES)
def test_changes_violate_no_law(name: str) -> None:
    target = targets.load(name)
    corpus = inputs(name)
    for seed in range(target.replayed):
        target.run(target.mutate(corpus[seed % len(corpus)], target.most, seed))


@pytest.mark.slow
@pytest.mark.parametrize("name", targets.NAMES)
def test_many_changes_violate_no_law(name: str) -> None:
    target = targets.load(name)
    rng = random.Random(name)
    pool = inputs(name)
    for _ in range(20 * target.replayed):
        data = target.mutate(rng.choice(pool), target.most, rng.getrandbits(32))
        target.run(data)
        pool[rng.randrange(len(pool))] = data


def test_one_input_can_be_run_by_command(tmp_path: Path) -> None:
    path = tmp_path / "input"
    path.write_bytes(inputs("codec")[0])
    tried = subprocess.run(
        [sys.executable, "-m", "tests.fuzz", "codec", "--once", str(path)],
        cwd=Path(__file__).parents[2], check=False, capture_output=True, text=True,
    )  # fmt: skip
    assert tried.returncode == 0, tried.stderr
