"""Draw docs/screen.png: the screen of a run on the simulated NS 16, as the program draws it.

`python docs/screen_picture.py` runs a short campaign in virtual time, for about a minute, and draws
the screen in the middle of the third repetition.
"""

from __future__ import annotations

import sys
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final

from matplotlib import font_manager
from PIL import Image, ImageDraw, ImageFont
from rich.console import Console
from rich.layout import Layout
from rich.segment import Segment
from rich.style import Style
from rich.terminal_theme import MONOKAI, TerminalTheme

from hil import Campaign, Cell, Silent, Stop, reporter
from hil.campaign import design
from hil.campaign.operator import RunStatus
from hil.campaign.operator_keys import Keyboard
from hil.campaign.screen import Screen

HERE: Final = Path(__file__).parent
COLUMNS = 80
ROWS = 24
REPETITION: Final = 3
MIDDLE: Final = 0.4
"""Share of the motion that is complete in the picture."""
HEIGHT = 20
MARGIN = 14
"""Height of a letter and margin of the picture, pixels."""
THEME: Final[TerminalTheme] = MONOKAI

Colour = tuple[int, int, int]


class RecordingScreen(Screen):
    """A hidden screen whose picture at one moment is stored."""

    stored: Layout | None = None

    def show(self, status: RunStatus) -> None:
        """Store the picture in the middle of the motion."""
        super().show(status)
        motion = status.motion
        if self.stored is None and (status.phase, status.number) == ("repetition", REPETITION):
            done = 0.0 if motion is None else (motion.motion_time or 0.0)
            if motion is not None and done > MIDDLE * (motion.duration or 0.0):
                self._keyboard = Keyboard(str)
                self._keyboard.attached = True
                self.stored = self.picture()
                self._keyboard = None


def screen_in_run() -> Layout:
    """Return the screen in the middle of a run."""
    cell = Cell.load(HERE.parent / "sim_fixtures" / "ns16" / "cell.toml")
    cell = cell.with_campaign(repetitions=5, validation_runs=1)
    with TemporaryDirectory() as folder:
        campaign = Campaign.create(Path(folder) / "october", cell, design(cell, reporter()))
        with RecordingScreen.of(cell, stop := Stop(), title="october", quiet=True) as screen:
            campaign.run(None, stop, Silent(), operator=screen, unrehearsed=True, durable=False)
    assert isinstance(screen, RecordingScreen)
    assert screen.stored is not None
    return screen.stored


def picture(shown: Layout) -> Image.Image:
    """Draw a screen, letter by letter."""
    console = Console(width=COLUMNS, height=ROWS, force_terminal=True, color_system="truecolor")
    fonts = {bold: _font(bold) for bold in (False, True)}
    wide = fonts[False].getlength("m")
    high = round(1.35 * HEIGHT)
    size = (round(COLUMNS * wide) + 2 * MARGIN, ROWS * high + 2 * MARGIN)
    image = Image.new("RGB", size, THEME.background_color)
    draw = ImageDraw.Draw(image)
    for row, line in enumerate(console.render_lines(shown)):
        column = 0
        for segment in Segment.strip_links(line):
            style = segment.style or Style()
            y = MARGIN + row * high
            ink, paper = _colours(style)
            for letter in segment.text.rstrip("\n"):
                x = MARGIN + column * wide
                box = (x, y, x + wide, y + high - 1)
                if paper != THEME.background_color:
                    draw.rectangle(box, fill=paper)
                if letter == "█":
                    draw.rectangle((x, y + 2, x + wide, y + high - 3), fill=ink)
                else:
                    draw.text((x, y), letter, font=fonts[bool(style.bold)], fill=ink)
                column += 1
    return image


def _font(bold: bool) -> ImageFont.FreeTypeFont:
    properties = font_manager.FontProperties(
        family="DejaVu Sans Mono", weight="bold" if bold else "normal"
    )
    return ImageFont.truetype(font_manager.findfont(properties), HEIGHT)


def _colours(style: Style) -> tuple[Colour, Colour]:
    """Return the colours of a letter and its background."""
    paper: Colour = THEME.background_color
    ink: Colour = THEME.foreground_color
    if style.color is not None and not style.color.is_default:
        ink = tuple(style.color.get_truecolor(THEME))  # type: ignore[assignment]
    if style.dim:
        ink = tuple((2 * i + p) // 3 for i, p in zip(ink, paper, strict=True))  # type: ignore[assignment]
    return (paper, ink) if style.reverse else (ink, paper)


if __name__ == "__main__":
    picture(screen_in_run()).save(
        sys.argv[1] if sys.argv[1:] else HERE / "screen.png", optimize=True
    )
