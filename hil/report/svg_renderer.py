"""Renderer of matplotlib that writes the SVG elements of a page, in its colours and its font."""

from __future__ import annotations

import base64
import hashlib
import io
from collections.abc import Mapping
from functools import cache, lru_cache
from typing import Any, Final

import numpy as np
from markupsafe import Markup
from matplotlib.backend_bases import GraphicsContextBase, RendererBase
from matplotlib.colors import to_hex
from matplotlib.path import Path
from matplotlib.transforms import Affine2D, Affine2DBase, Transform
from matplotlib.typing import ColorType
from PIL import Image

from hil.base.arrays import Array
from hil.report.picture_style import palette

_CAPS: Final = {"projecting": "square", "butt": "butt", "round": "round"}
_COMMANDS: Final = {Path.MOVETO: "M %.1f %.1f", Path.LINETO: "%.1f %.1f", Path.CLOSEPOLY: "z"}
_HALF_CAPITAL: Final = 0.38  # height of the middle of a capital over the line, of the font size


class SvgRenderer(RendererBase):
    """Draws the lines, dots and images of a figure of 72 dots per inch as SVG elements.

    Colours of the palette become its variables, so that a dark page uses the dark palette. Texts
    are written by :meth:`write`: those of matplotlib are measured, which takes longer than a chart.
    """

    def __init__(self, width: float, height: float, key: str) -> None:
        """Start a drawing.

        Args:
            width: of the drawing [px].
            height: of the drawing [px].
            key: makes its ids unique in the page.
        """
        super().__init__()
        self._size = width, height
        self._key = key
        self._elements: list[str] = []
        self._clips: dict[tuple[float, ...], str] = {}

    def option_image_nocomposite(self) -> bool:
        """Return that images are not combined."""
        return True

    def option_scale_image(self) -> bool:
        """Return that images are drawn as they are, and scaled by their transform."""
        return True

    def draw_path(
        self,
        gc: GraphicsContextBase,
        path: Path,
        transform: Transform,
        rgbFace: ColorType | None = None,
    ) -> None:
        """Draw lines, or an area.

        Args:
            gc: width, colour and dashes of the lines.
            path: vertices.
            transform: of the vertices to pixels.
            rgbFace: colour of an area.
        """
        is_line = rgbFace is None
        shown = path.cleaned(
            transform,
            remove_nans=True,
            clip=(0.0, 0.0, *self._size) if is_line else None,
            simplify=is_line and path.should_simplify,
        )
        style = {"fill": "none" if rgbFace is None else _colour(tuple(rgbFace))}
        if gc.get_linewidth():
            style["stroke"] = _colour(tuple(gc.get_rgb()))
            style["stroke-width"] = f"{gc.get_linewidth():g}"
            offset, dashes = gc.get_dashes()
            if dashes is not None:
                style["stroke-dasharray"] = ",".join(f"{dash:g}" for dash in np.ravel(dashes))
                style["stroke-dashoffset"] = f"{offset:g}"
            if gc.get_joinstyle() != "round":
                style["stroke-linejoin"] = gc.get_joinstyle()
            style["stroke-linecap"] = _CAPS[gc.get_capstyle()]
        self._add_path(self._path_data(shown), gc, style)

    def draw_markers(
        self,
        gc: GraphicsContextBase,
        marker_path: Path,
        marker_trans: Transform,
        path: Path,
        trans: Transform,
        rgbFace: ColorType | None = None,
    ) -> None:
        """Draw dots, which all markers of pages are: lines of no length with round ends.

        Args:
            gc: that clips them.
            marker_path: a circle.
            marker_trans: of its vertices to pixels.
            path: places of the dots.
            trans: of the places to pixels.
            rgbFace: colour of the dots.
        """
        places = self._places(trans.transform(path.vertices))
        places = places[np.all((places >= 0.0) & (places <= self._size), axis=1)]
        if rgbFace is None or not len(places):
            return
        data = " ".join(["M %.1f %.1fh0"] * len(places)) % tuple(places.ravel().tolist())
        style = {
            "stroke": _colour(tuple(rgbFace)),
            "stroke-width": f"{marker_path.get_extents(marker_trans).width:.4g}",
            "stroke-linecap": "round",
        }
        self._add_path(data.replace(".0 ", " ").replace(".0h", "h"), gc, style)

    def draw_image(
        self,
        gc: GraphicsContextBase,
        x: float,
        y: float,
        im: Any,
        transform: Affine2DBase | None = None,
    ) -> None:
        """Draw an image with a square for each value.

        Args:
            gc: that clips it.
            x: of its corner [px].
            y: of its corner [px].
            im: values (h, w, 4).
            transform: of a unit square to pixels.
        """
        if transform is None:
            raise NotImplementedError("an image that matplotlib has scaled")
        height, width = im.shape[:2]
        png = io.BytesIO()
        Image.fromarray(im).save(png, format="png")
        whole = Affine2D().scale(1.0 / width, 1.0 / height) + transform
        placed = whole + Affine2D().translate(x, y).scale(1.0, -1.0).translate(0.0, self._size[1])
        matrix = placed.get_matrix()[:2].T.ravel().tolist()
        # The transform of the image would apply to its clip path as well.
        self._elements.append(
            f'<g{self._clip(gc)}><image href="data:image/png;base64,'
            f'{base64.b64encode(png.getvalue()).decode("ascii")}" width="{width}" '
            f'height="{height}" transform="matrix({" ".join(f"{value:.4g}" for value in matrix)})" '
            'style="image-rendering:crisp-edges;image-rendering:pixelated"/></g>'
        )

    def write(
        self,
        text: str,
        x: float,
        y: float,
        *,
        size: float,
        colour: str,
        anchor: str = "start",
        centred: bool = False,
        upwards: bool = False,
    ) -> None:
        """Write one line.

        Args:
            text: to be escaped.
            x: of its anchor, from the left [px].
            y: of its base line, from the top [px].
            size: of the font [px].
            colour: variable of the style sheet.
            anchor: "start", "middle" or "end".
            centred: put the middle of its height at its place, not the base line.
            upwards: turn it by a quarter turn.
        """
        shift = _HALF_CAPITAL * size if centred else 0.0
        if upwards:
            place = f'transform="translate({x + shift:.1f} {y:.1f}) rotate(-90)"'
        else:
            place = f'x="{x:.1f}" y="{y + shift:.1f}"'
        style = f"font-size:{size:.4g}px;text-anchor:{anchor};fill:{colour}"
        self._elements.append(f'<text style="{style}" {place}>{Markup.escape(text)}</text>')

    def svg(self, label: str) -> Markup:
        """Return the drawing as an SVG element, which may be enlarged, with a text alternative."""
        width, height = self._size
        clips = "".join(
            f'<clipPath id="{name}"><rect x="{x:g}" y="{height - y - h:g}" '
            f'width="{w:g}" height="{h:g}"/></clipPath>'
            for (x, y, w, h), name in self._clips.items()
        )
        return Markup(
            f'<svg viewBox="0 0 {width:g} {height:g}" style="max-width: {1.3 * width:.0f}px" '
            f'role="img" aria-label="{Markup.escape(label)}">{"".join(self._elements)}'
            f"{f'<defs>{clips}</defs>' if clips else ''}</svg>"
        )

    def _places(self, vertices: Array) -> Array:
        """Return rounded places from the upper left corner (m, 2) of vertices (m, 2)."""
        places = np.round(vertices, 1)
        places[:, 1] = np.round(self._size[1] - vertices[:, 1], 1)
        places += 0.0  # no negative zero
        return places

    def _path_data(self, path: Path) -> str:
        """Return a path with one digit behind the point; lines after its start need no letter."""
        codes = np.asarray(path.codes)
        vertices = np.asarray(path.vertices)[(codes == Path.MOVETO) | (codes == Path.LINETO)]
        commands = " ".join([_COMMANDS[code] for code in codes.tolist() if code in _COMMANDS])
        data = commands % tuple(self._places(vertices).ravel().tolist())
        return f"{data} ".replace(".0 ", " ").rstrip()

    def _clip(self, gc: GraphicsContextBase) -> str:
        """Return the attribute for the rectangle within which something is drawn."""
        rectangle = gc.get_clip_rectangle()
        if rectangle is None:
            return ""
        bounds = rectangle.bounds
        if bounds not in self._clips:
            digest = hashlib.sha256(f"{self._key} {len(self._clips)}".encode()).hexdigest()
            self._clips[bounds] = f"p{digest[:10]}"
        return f' clip-path="url(#{self._clips[bounds]})"'

    def _add_path(self, data: str, gc: GraphicsContextBase, style: dict[str, str]) -> None:
        declarations = ";".join(f"{name}:{value}" for name, value in style.items())
        self._elements.append(f'<path d="{data}"{self._clip(gc)} style="{declarations}"/>')


@cache
def _variables() -> Mapping[str, str]:
    """Return the variables of the style sheet by colour; the first of a colour."""
    return {colour: f"var(--{name})" for name, colour in reversed([*palette().items()])}


@lru_cache(maxsize=256)
def _colour(colour: ColorType) -> str:
    value = to_hex(colour)
    return _variables().get(value, value)
