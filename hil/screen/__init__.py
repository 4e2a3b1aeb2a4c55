"""The one screen of a run, its keys, and plain lines where there is no terminal."""

from __future__ import annotations

from .screen import Screen

__all__ = ["Screen"]
