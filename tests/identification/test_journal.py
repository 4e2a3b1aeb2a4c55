from __future__ import annotations

import errno
import io
import json
import os
import struct
import subprocess
import sys
import zlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import identification.excitation.searches.journal
from identification import FrictionLaw, RobotModel
from identification.excitation import (
    ForeignJournalError,
    Journal,
    JournalError,
    Objective,
    Scores,
    SearchSettings,
    SineGenome,
    ViaPointGenome,
)
from identification.excitation.searches.journal import digest
from identification.excitation.searches.scores import ROW, unplanned
from planner.worker import load, pack
from tests.identification.searching import LIMITS, URDF, problem

SETTINGS = SearchSettings(population=4, generations=3)
PROBLEM = problem()


def generation(seed: int, count: int = 4) -> tuple[np.ndarray, Scores]:
    random = np.random.default_rng(seed)
    rows = random.normal(size=(count, ROW))
    rows[1] = unplanned()
    return random.random((count, PROBLEM.genome.n_genes)), Scores.of_rows(rows)


def opened(file: io.BytesIO) -> Journal:
    return Journal(file, PROBLEM, SETTINGS)


def written(count: int) -> tuple[io.BytesIO, list[int]]:
    """A journal of so many generations, and how long it was after each, first after none."""
    file = io.BytesIO()
    journal = opened(file)
    lengths = [len(file.getvalue())]
    for seed in range(count):
        journal.record(*generation(seed))
        lengths.append(len(file.getvalue()))
    return file, lengths


def kept(file: io.BytesIO) -> int:
    """How many generations a journal still knows, each to the last bit."""
    journal = opened(file)
    count = 0
    while (scores := journal.recall(generation(count)[0])) is not None:
        assert scores.rows.tobytes() == generation(count)[1].rows.tobytes()
        count += 1
    return count


def test_a_journal_returns_every_bit_that_was_recorded():
    file, _ = written(3)
    assert kept(file) == 3
    assert kept(io.BytesIO(file.getvalue())) == 3


def test_wherever_writing_was_cut_off_only_that_generation_is_lost():
    file, lengths = written(3)
    whole = file.getvalue()
    for length in {*range(0, lengths[0], 7), *range(lengths[2], len(whole), 31), *lengths}:
        torn = io.BytesIO(whole[:length])
        assert kept(torn) == sum(length >= end for end in lengths[1:])
        journal = opened(torn)
        known = 0
        while journal.recall(generation(known)[0]) is not None:
            known += 1
        journal.record(*generation(known))  # goes on as if nothing had happened
        assert kept(torn) == known + 1


def test_from_a_record_with_a_wrong_bit_on_all_is_scored_anew():
    file, lengths = written(4)
    for offset in range(lengths[1], lengths[2], 97):
        damaged = bytearray(file.getvalue())
        damaged[offset] ^= 0x10
        again = io.BytesIO(bytes(damaged))
        journal = opened(again)
        known = [journal.recall(generation(seed)[0]) is not None for seed in range(4)]
        assert known == [True, False, False, False]
        assert journal.damaged == lengths[4] - lengths[1]
        journal.record(*generation(1))
        assert kept(again) == 2


def test_what_was_not_recorded_is_not_recalled():
    file, _ = written(3)
    journal = opened(file)
    first, _ = generation(0)
    assert journal.recall(first) is not None
    others, scores = generation(7)
    assert journal.recall(others) is None
    moved, _ = generation(1)
    moved[2, 3] = np.nextafter(moved[2, 3], 2.0)
    assert journal.recall(moved) is None
    assert journal.recall(moved[:3]) is None
    journal.record(others, scores)
    again = opened(file)
    for genes in (others, generation(2)[0], first):
        assert again.recall(genes) is not None
    assert again.recalled == 12
    assert again.damaged == 0


class FullDisk(io.BytesIO):
    """A disk that takes a part of what is written, then no more, until there is room again."""

    room = True

    def write(self, content):
        if not self.room:
            super().write(bytes(content)[:50])
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return super().write(bytes(content)[:1000])


def test_a_full_disk_ends_no_search_and_what_waits_is_written_once_there_is_room():
    file = FullDisk()
    journal = opened(file)
    journal.record(*generation(0))
    file.room = False
    for seed in (1, 2):
        journal.record(*generation(seed))
        assert journal.trouble is not None and journal.trouble.errno == errno.ENOSPC
    assert kept(io.BytesIO(file.getvalue())) == 1
    journal.close()
    assert journal.trouble is not None
    file.room = True
    journal.record(*generation(3))
    assert journal.trouble is None
    assert kept(io.BytesIO(file.getvalue())) == 4
    file.room = False
    journal.record(*generation(4))
    file.room = True
    journal.close()
    assert journal.trouble is None
    assert kept(io.BytesIO(file.getvalue())) == 5


@pytest.mark.parametrize("identity", [{"problem": 3}, {"settings": "b"}, {"problem": None}, []])
def test_an_identity_without_sense_is_no_journal(identity):
    content = json.dumps(identity).encode()
    frame = struct.pack("<QI", len(content), zlib.crc32(content)) + content
    with pytest.raises(JournalError, match="does not say which search"):
        opened(io.BytesIO(b"hil search journal 1\n" + frame))


def test_the_disk_is_waited_for_at_times_and_at_the_end(tmp_path, monkeypatch):
    synced = []
    monkeypatch.setattr(os, "fsync", synced.append)
    with (tmp_path / "journal").open("x+b", buffering=0) as file:
        journal = Journal(file, PROBLEM, SETTINGS)
        for seed in range(20):
            journal.record(*generation(seed))
        assert len(synced) <= 1
        journal.close()
        assert len(synced) >= 1


@pytest.mark.parametrize(
    ("problem_", "settings", "name", "words"),
    [
        (PROBLEM, replace(SETTINGS, population=5), "population", "is 4, here it is 5"),
        (PROBLEM, replace(SETTINGS, weights=(0.5, 0.5)), "weights", "weights"),
        (PROBLEM, replace(SETTINGS, seed=1), "seed", "seed is 0, here it is 1"),
        (problem(max_duration=19.0), SETTINGS, "constraints", "constraints is not this one's"),
        (problem(ViaPointGenome(LIMITS, 3, slowest=0.4)), SETTINGS, "genome", "genome is not"),
        (replace(PROBLEM, period=0.004), SETTINGS, "period", "period is not this one's"),
    ],
)
def test_the_journal_of_another_search_is_refused_by_name(problem_, settings, name, words):
    file, _ = written(1)
    before = file.getvalue()
    with pytest.raises(ForeignJournalError, match=words) as caught:
        Journal(file, problem_, settings)
    assert caught.value.name == name
    assert file.getvalue() == before


def test_so_is_one_that_another_release_wrote(monkeypatch):
    file, _ = written(1)
    ours = identification.excitation.searches.journal.versions()
    monkeypatch.setattr(
        identification.excitation.searches.journal, "versions", lambda: {**ours, "pymoo": "0.5.0"}
    )
    with pytest.raises(ForeignJournalError, match=f"pymoo {ours['pymoo']}, installed is 0.5.0"):
        opened(file)


@pytest.mark.parametrize("content", [b"x", b"PK\x03\x04" * 100, b"hil search journal 1\n{}" * 50])
def test_a_file_that_is_no_journal_is_refused_and_left_alone(content):
    file = io.BytesIO(content)
    with pytest.raises(JournalError):
        opened(file)
    assert file.getvalue() == content


def header(text: str) -> bytes:
    return b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text.encode()


def shaped(shape: str) -> bytes:
    return header(f"{{'descr': '<f8', 'fortran_order': False, 'shape': {shape}, }}")


def array(values: object) -> bytes:
    stream = io.BytesIO()
    np.save(stream, np.array(values))
    return stream.getvalue()


SCORES = array(np.zeros((1, ROW)))


@pytest.mark.parametrize(
    "content",
    [
        *(array([["a"]]) + SCORES, array([[1j]]) + SCORES, array([[0.5]]) + array(["a"])),
        *(b"PK\x03\x04" + bytes(50), b"", header("((((("), header("(" * 5000), header("{[]: 1}")),
        *(shaped(f"({10**30},)"), shaped(f"({10**13},)"), shaped("(-1,)")),
    ],
)
def test_a_record_that_somebody_forged_counts_as_none(content):
    file, lengths = written(1)
    file.seek(lengths[1])
    file.write(struct.pack("<QI", len(content), zlib.crc32(content)) + content)
    assert kept(file) == 1


def test_an_identity_nested_without_end_is_no_journal():
    content = b"[" * 100_000
    frame = struct.pack("<QI", len(content), zlib.crc32(content))
    file, _ = written(0)
    first_line = file.getvalue().partition(b"\n")[0] + b"\n"
    with pytest.raises(JournalError):
        opened(io.BytesIO(first_line + frame + content))


def test_a_journal_runs_nothing():
    """A pickle in it is as good as no record."""
    file, lengths = written(1)
    poison = io.BytesIO()
    np.save(poison, np.array([print], dtype=object), allow_pickle=True)
    frame = struct.pack("<QI", len(poison.getvalue()), zlib.crc32(poison.getvalue()))
    file.seek(lengths[1])
    file.write(frame + poison.getvalue())
    assert kept(file) == 1


def test_a_problem_has_one_fingerprint_however_it_was_made():
    assert digest(problem()) == digest(PROBLEM)
    assert digest(load(pack(PROBLEM))) == digest(PROBLEM)


def test_a_problem_has_the_same_fingerprint_in_every_process():
    root = Path(__file__).parents[2]
    script = """
from identification.excitation.searches.journal import digest
from tests.identification.searching import problem
print(digest(problem()))
"""
    env = {**os.environ, "PYTHONHASHSEED": "77", "PYTHONPATH": str(root)}
    done = subprocess.run(
        [sys.executable, "-c", script], env=env, capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == digest(PROBLEM)


def test_whatever_changes_a_score_changes_the_fingerprint():
    model = PROBLEM.objective.model
    weights = np.array([1.0, 2.0])
    earlier = np.eye(model.n_parameters)
    others = [
        replace(PROBLEM, genome=SineGenome(LIMITS, length=10.0, ramp=1.0)),
        replace(PROBLEM, genome=SineGenome(LIMITS, length=10.0, ramp=2.0)),
        replace(PROBLEM, objective=Objective(model, parameters=np.arange(5))),
        replace(PROBLEM, objective=Objective(model, joint_weights=weights)),
        replace(PROBLEM, objective=Objective(model, earlier=earlier, earlier_samples=9)),
        replace(PROBLEM, objective=Objective(RobotModel.from_urdf(URDF.replace("0.25", "0.26")))),
        replace(
            PROBLEM, objective=Objective(RobotModel.from_urdf(URDF, friction=FrictionLaw(True)))
        ),
        replace(
            PROBLEM,
            objective=Objective(RobotModel.from_urdf(URDF, friction=FrictionLaw(third=None))),
        ),
        problem(min_duration=1.0),
        problem(ViaPointGenome(LIMITS, 3, home=np.zeros(2))),
        problem(ViaPointGenome(LIMITS, 3, home=np.array([0.0, -0.0]))),
    ]
    found = [digest(other) for other in others]
    assert found.count(digest(PROBLEM)) == 1  # friction as by default, said aloud
    assert len(set(found)) == len(found)


def test_what_has_no_lasting_description_has_no_fingerprint():
    with pytest.raises(TypeError, match="no fingerprint"):
        digest({"what": object()})
    with pytest.raises(TypeError, match="no fingerprint"):
        digest(np.array([object()]))
