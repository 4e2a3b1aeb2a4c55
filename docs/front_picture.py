"""Draw docs/front.png: what `hil identify` prints, beside the first screen of its report.

`PYTHONPATH=. python docs/front_picture.py`: of a simulated UR5.
"""

from __future__ import annotations

import io
import shutil
import subprocess
import sys
from base64 import b64encode
from html import escape
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final

import numpy as np
from PIL import Image
from playwright.sync_api import sync_playwright

from tests.hil.simulated_logs import simulate, write_log

HERE: Final = Path(__file__).parent
LINE: Final = "hil identify log.csv --urdf arm.urdf"
PAGE: Final = """<meta charset="utf-8"><style>
body {{ margin: 0; padding: 16px; display: grid; grid-template-columns: 860px 860px; gap: 16px; }}
body {{ background: #e9edf2; align-items: start; }}
pre {{ margin: 0; padding: 16px; background: #14181d; color: #d8dee6; border-radius: 8px; }}
pre {{ font: 13px/1.55 "DejaVu Sans Mono", monospace; }}
img {{ width: 100%; border-radius: 8px; }}
</style><pre>$ {line}\n{text}</pre><img src="data:image/png;base64,{picture}">"""


def main() -> None:
    """Draw the picture."""
    with TemporaryDirectory() as folder:
        place = Path(folder)
        motion = simulate("ur5_robot.urdf", np.arange(0.0, 20.0, 0.01))
        names = ["t", "q{}", "v{}", "tau{}"]
        columns = motion.time, motion.position, motion.velocity, motion.torque
        write_log(place / "log.csv", names, *columns)
        shutil.copyfile(motion.urdf, place / "arm.urdf")
        command = [sys.executable, "-m", *LINE.split()]
        printed = subprocess.run(command, cwd=place, capture_output=True, text=True, check=True)
        with sync_playwright() as driver:
            program = shutil.which("chromium") or shutil.which("google-chrome")
            browser = driver.chromium.launch(executable_path=program, args=["--no-sandbox"])
            page = browser.new_page(viewport={"width": 1240, "height": 880}, color_scheme="light")
            page.goto((place / "log" / "report.html").as_uri())
            page.wait_for_timeout(1500)
            picture = b64encode(page.screenshot()).decode("ascii")
            text = escape(printed.stdout)
            page = browser.new_page(viewport={"width": 1768, "height": 640})
            page.set_content(PAGE.format(line=LINE, text=text, picture=picture))
            drawn = Image.open(io.BytesIO(page.screenshot())).convert("RGB").quantize(128)
            drawn.save(HERE / "front.png", optimize=True)
            browser.close()


if __name__ == "__main__":
    main()
