"""Figures laid out in pixels, so that one image pixel covers whole figure pixels."""

from dataclasses import dataclass
from functools import cache

import numpy as np
from jaxtyping import UInt8
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.colorbar import Colorbar
from matplotlib.colors import Colormap, Normalize
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties, findfont, get_font
from PIL import Image

DOTS_PER_INCH = 100
INK = "#1d1f22"
SOFT = "#55585d"
"""Of words that are no headline."""
FONT = "DejaVu Sans"
"""Comes with matplotlib: figures look the same on every machine."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Box:
    """A rectangle of a figure in pixels from its upper left corner."""

    left: int
    top: int
    width: int
    height: int

    @property
    def bottom(self) -> int:
        """The row below the rectangle."""
        return self.top + self.height

    @property
    def right(self) -> int:
        """The column right of the rectangle."""
        return self.left + self.width


def blank(width: int, height: int) -> Figure:
    """An empty white figure of so many pixels."""
    figure = Figure(figsize=(width / DOTS_PER_INCH, height / DOTS_PER_INCH), dpi=DOTS_PER_INCH)
    FigureCanvasAgg(figure)
    return figure


def displayed_size(shape: tuple[int, int], target: int) -> tuple[int, int]:
    """Width and height in pixels at which an image of ``shape`` (rows, columns) is drawn.

    About ``target`` wide, enlarged by a whole factor where it is smaller; flat images such as those
    of a lidar with few rows are stretched to at least a quarter of their width, and the other way
    round.
    """
    rows, columns = shape
    scale = min(target / columns, 1.3 * target / rows)
    scale = float(int(scale)) if scale >= 1.0 else scale
    width, height = round(columns * scale), round(rows * scale)
    return max(width, target // 4), max(height, width // 4)


def whole_factors(shape: tuple[int, int], box: Box) -> tuple[int, int]:
    """How many rows and columns of a box there are for each of an image; at least one."""
    return max(1, box.height // shape[0]), max(1, box.width // shape[1])


def axes_at(figure: Figure, box: Box) -> Axes:
    """Bare axes that fill a box of a figure."""
    width, height = size(figure)
    place = (box.left / width, 1.0 - box.bottom / height, box.width / width, box.height / height)
    axes = figure.add_axes(place)
    axes.set_axis_off()
    return axes


def size(figure: Figure) -> tuple[int, int]:
    """Width and height of a figure in pixels."""
    width, height = (round(side * DOTS_PER_INCH) for side in figure.get_size_inches())
    return width, height


def write(figure: Figure, left: int, top: int, words: str, **style: object) -> None:
    """A line of text whose upper left corner is at a pixel; its middle is left out if too long."""
    width, height = size(figure)
    settings: dict = {"color": INK, "fontsize": 11, "va": "top", "ha": "left"} | style
    words = _drawable(words)
    line = figure.text(
        left / width, 1.0 - top / height, words, fontfamily=FONT, parse_math=False, **settings
    )
    room = width - left - 8
    for kept in range(len(words) - 1, 0, -1):
        if line.get_window_extent().width <= room:
            break
        line.set_text(f"{words[: kept - kept // 2]}…{words[len(words) - kept // 2 :]}")


def show(figure: Figure, box: Box, image: UInt8[np.ndarray, "h w 3"]) -> None:
    """Draws an image over a box: enlarged, its pixels are sharp squares; reduced, their means."""
    enlarged = image.shape[0] <= box.height and image.shape[1] <= box.width
    way = Image.Resampling.NEAREST if enlarged else Image.Resampling.HAMMING
    drawn = Image.fromarray(image).resize((box.width, box.height), way)
    figure.figimage(np.asarray(drawn), box.left, size(figure)[1] - box.bottom, origin="upper")


def colour_bar(
    figure: Figure, box: Box, colours: Colormap, limits: tuple[float, float], title: str
) -> Colorbar:
    """A vertical scale that fills a box, with a title above it."""
    axes = axes_at(figure, box)
    axes.set_axis_on()
    mappable = ScalarMappable(Normalize(*limits), colours)
    bar = figure.colorbar(mappable, cax=axes)
    bar.ax.tick_params(labelsize=10, colors=INK, labelfontfamily=FONT)
    write(figure, box.left, box.top - 22, title, fontsize=10)
    return bar


def pixels(figure: Figure) -> Image.Image:
    """The drawn figure."""
    canvas = figure.canvas
    assert isinstance(canvas, FigureCanvasAgg)
    canvas.draw()
    drawn: UInt8[np.ndarray, "h w 4"] = np.asarray(canvas.buffer_rgba())
    return Image.fromarray(drawn[..., :3].copy())


def _drawable(words: str) -> str:
    """The words with a square for every character that the font does not have."""
    known = _known_letters()
    return "".join(letter if ord(letter) in known else "□" for letter in words)


@cache
def _known_letters() -> frozenset[int]:
    """Those of the font, by their code points."""
    return frozenset(get_font(findfont(FontProperties(family=FONT))).get_charmap())
