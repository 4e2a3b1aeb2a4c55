"""Hardware-in-the-loop identification of an industrial robot's dynamics."""

from hil.campaign import Campaign
from hil.cell import Cell
from hil.recordings import open_recording

__all__ = ["Campaign", "Cell", "open_recording"]
