import errno
import io
import os

import numpy as np
import pytest

import identification.excitation.searches.journal
from identification.excitation import Journal, JournalError, Scores
from identification.excitation.searches.scores import ROW, unplanned

SEARCH = {"settings": {"seed": 1, "population": 4}, "cell": {"urdf": "a"}}


def generation(seed, count=4):
    random = np.random.default_rng(seed)
    rows = random.normal(size=(count, ROW))
    rows[1] = unplanned()
    return random.random((count, 8)), Scores.of_rows(rows)


def opened(file):
    return Journal(file, SEARCH)


def written(count):
    """Return a journal of some generations, and its lengths, first without any."""
    file = io.BytesIO()
    journal = opened(file)
    lengths = [len(file.getvalue())]
    for seed in range(count):
        journal.record(*generation(seed))
        lengths.append(len(file.getvalue()))
    return file, lengths


def known(file):
    """Return the number of generations in a journal, each bit for bit."""
    journal = opened(file)
    count = 0
    while (scores := journal.recall(generation(count)[0])) is not None:
        assert scores.rows.tobytes() == generation(count)[1].rows.tobytes()
        count += 1
    return count


class TestRecall:
    def test_a_truncated_journal_loses_one_generation(self):
        file, lengths = written(3)
        content = file.getvalue()
        assert known(io.BytesIO(content)) == 3
        for length in {*range(0, lengths[0], 7), *range(lengths[2], len(content), 31), *lengths}:
            truncated = io.BytesIO(content[:length])
            count = known(truncated)
            assert count == sum(length >= end for end in lengths[1:])
            opened(truncated).record(*generation(count))
            assert known(truncated) == count + 1

    def test_records_after_a_damaged_one_are_dropped(self):
        file, lengths = written(4)
        for offset in range(lengths[1], lengths[2], 97):
            damaged = bytearray(file.getvalue())
            damaged[offset] ^= 0x10
            again = io.BytesIO(bytes(damaged))
            journal = opened(again)
            found = [journal.recall(generation(seed)[0]) is not None for seed in range(4)]
            assert found == [True, False, False, False]
            assert journal.damaged == lengths[4] - lengths[1]
            journal.record(*generation(1))
            assert known(again) == 2

    def test_other_genes_are_not_recalled(self):
        file, _ = written(3)
        journal = opened(file)
        others, scores = generation(7)
        moved, _ = generation(1)
        moved[2, 3] = np.nextafter(moved[2, 3], 2.0)
        for genes in (others, moved, moved[:3]):
            assert journal.recall(genes) is None
        journal.record(others, scores)
        again = opened(file)
        for genes in (others, generation(2)[0], generation(0)[0]):
            assert again.recall(genes) is not None
        assert (again.recalled, again.damaged) == (12, 0)


class FullDisk(io.BytesIO):
    """A file with partial writes, and errors while there is no room."""

    room = True

    def write(self, content):
        if not self.room:
            super().write(bytes(content)[:50])
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return super().write(bytes(content)[:1000])


class TestWriting:
    def test_pending_records_are_written_later(self):
        file = FullDisk()
        journal = opened(file)
        journal.record(*generation(0))
        file.room = False
        for seed in (1, 2):
            journal.record(*generation(seed))
            assert journal.error is not None and journal.error.errno == errno.ENOSPC
        assert known(io.BytesIO(file.getvalue())) == 1
        journal.close()
        assert journal.error is not None
        file.room = True
        journal.record(*generation(3))
        assert journal.error is None
        assert known(io.BytesIO(file.getvalue())) == 4
        file.room = False
        journal.record(*generation(4))
        file.room = True
        journal.close()
        assert known(io.BytesIO(file.getvalue())) == 5


FIRST_LINE = b"hil search journal 2\n"


class TestOtherFiles:
    @pytest.mark.parametrize(
        ("other", "words"),
        [
            ({"settings": {"seed": 2, "population": 4}}, "settings seed was 1, is 2"),
            ({"cell": {"urdf": "b"}}, "cell urdf was 'a', is 'b'"),
            ({"earlier": {"x.mcap": "00"}}, "earlier x.mcap was None, is '00'"),
        ],
    )
    def test_the_journal_of_another_search_is_refused(self, other, words):
        file, _ = written(1)
        before = file.getvalue()
        with pytest.raises(JournalError, match=words):
            Journal(file, SEARCH | other)
        assert file.getvalue() == before

    def test_the_journal_of_another_release_is_refused(self, monkeypatch):
        file, _ = written(1)
        journal = identification.excitation.searches.journal
        ours = journal.versions()
        monkeypatch.setattr(journal, "versions", lambda: {**ours, "pymoo": "0.5.0"})
        with pytest.raises(JournalError, match=f"pymoo was '{ours['pymoo']}', is '0.5.0'"):
            opened(file)

    @pytest.mark.parametrize("content", [b"x", FIRST_LINE + b"{}" * 50, FIRST_LINE])
    def test_another_file_is_refused_and_unchanged(self, content):
        file = io.BytesIO(content + b" ")
        with pytest.raises(JournalError):
            opened(file)
        assert file.getvalue() == content + b" "
