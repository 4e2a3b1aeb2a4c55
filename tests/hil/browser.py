"""A page in headless Chromium, where that and Playwright are installed."""

from __future__ import annotations

import re
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

PROGRAMS = ("chromium", "chromium-browser", "google-chrome")


@contextmanager
def chromium() -> Iterator[Any]:
    """The browser; the test is skipped without it."""
    program = next(filter(None, map(shutil.which, PROGRAMS)), None)
    if program is None:
        pytest.skip(f"no browser is installed (one of {', '.join(PROGRAMS)})")
    playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    with playwright.sync_playwright() as driver:
        # No sandbox: tests also run as root in containers, on pages of their own.
        browser = driver.chromium.launch(executable_path=program, args=["--no-sandbox"])
        try:
            yield browser
        finally:
            browser.close()


class OpenedPage:
    """A page of a file with all that its console said."""

    def __init__(self, browser: Any, path: Path, fragment: str = "", **context: Any) -> None:
        size = {"width": 1440, "height": 900}
        self.context = browser.new_context(viewport=size, **context)
        self.page = self.context.new_page()
        self.errors: list[str] = []
        self.page.on("console", self._note)
        self.page.on("pageerror", lambda error: self.errors.append(str(error)))
        self.page.on("request", self._note_request)
        self.page.goto(f"file://{path}{fragment}")

    def _note(self, message: Any) -> None:
        if message.type in {"error", "warning"}:
            self.errors.append(message.text)

    def _note_request(self, request: Any) -> None:
        if not request.url.startswith(("file:", "data:", "blob:")):
            self.errors.append(f"requested {request.url}")

    def close(self) -> None:
        """Close the page with its context."""
        self.context.close()


def page_count(pdf: bytes) -> int:
    """Pages of a document that Chromium printed."""
    return len(re.findall(rb"/Type\s*/Page[^s]", pdf))
