"""Whether a motion is of use where answers were lost on its way."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from drivers.transports import Lose, SimulatedTransport
from hil.archive import Archive, open_archive
from hil.campaign import Link, Stop
from hil.campaign.quality import FIELDS, Played, problem_of
from hil.cell import Cell
from hil.move import Way, send, straight_way
from hil.simulation import controller_settings, simulated_controller
from sim_fixtures.ns16 import CELL_PATH


def moved(cell: Cell, path: Path, *faults: Lose) -> tuple[Way, Archive]:
    """A short way in virtual time, and its archive."""
    settings = replace(controller_settings(cell), missed_replies=5)
    controller = simulated_controller(cell, settings=settings)
    link = Link.over(SimulatedTransport(controller, faults), cell, controller.finish)
    here = link.connect(Stop())
    way = straight_way(cell, here, here + 0.05, speed=0.3)
    ended = send(way, cell, link, path, stop=Stop(), durable=False)
    assert ended.outcome == "completed"
    return way, open_archive(path)


class TestLostAnswers:
    def test_a_set_point_sent_again_counts_once(self, tmp_path: Path) -> None:
        """Row k of what is compared is set-point k; the motion ends a cycle later for each."""
        cell = Cell.load(CELL_PATH)
        _, whole = moved(cell, tmp_path / "whole.mcap")
        speed = np.nan_to_num(np.abs(whole.columns["commanded_velocity"])).max(axis=1)
        fastest = int(whole.columns["cycle"][np.argmax(speed)]) + 10
        lose = Lose(fastest, "to_controller"), Lose(fastest + 20, "to_controller")
        way, archive = moved(cell, tmp_path / "lost.mcap", *lose)
        assert sum(event.name == "AnswersLost" for event in archive.events) == 2
        played = Played.of(open_archive(archive.path, fields=FIELDS))
        assert problem_of(played, way.trajectory, cell) is None
        sent = np.isfinite(archive.columns["commanded_position"]).all(axis=1).sum()
        assert len(played.commanded) == sent - 2
