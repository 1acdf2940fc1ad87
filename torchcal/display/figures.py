"""Figures that a stranger understands: the hybrid view, the comparison, a range image."""

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from torch import Tensor

from torchcal.calibrate.result import FrameComparison, PixelClass
from torchcal.display import canvas
from torchcal.display.arrays import as_array
from torchcal.display.canvas import Box
from torchcal.display.colours import (
    CLASS_COLOURS,
    CLASS_WORDS,
    DIFFERENCE_MAP,
    NEUTRAL,
    RANGE_MAP,
    class_image,
    range_colours,
    range_limits,
)
from torchcal.display.hybrid import MEASURED_CLASSES, hybrid_image, hybrid_limits

MARGIN = 20
HEADER = 96
BAR = 112
"""Room for a colour bar and its numbers."""
LEGEND_LINE = 26

SHOWN_AS: dict[PixelClass, str] = {
    PixelClass.AGREES: "the model is shown",
    PixelClass.NEARER: "the measurement is shown",
    PixelClass.FARTHER: "the measurement is shown",
    PixelClass.UNMODELLED: "the measurement is shown",
    PixelClass.MISSING: "the model is shown, dim and hatched",
    PixelClass.NOT_COMPARED: "nothing is shown",
}

_MEASURED_FILL = "#21918c"
HYBRID_PATCHES: dict[PixelClass, dict] = {
    PixelClass.AGREES: {"facecolor": "#b9b2a8", "edgecolor": "#b9b2a8"},
    PixelClass.MISSING: {"facecolor": "#6b6761", "edgecolor": "#26282b", "hatch": "/////"},
    PixelClass.NOT_COMPARED: {"facecolor": NEUTRAL, "edgecolor": NEUTRAL},
} | {
    member: {"facecolor": _MEASURED_FILL, "edgecolor": CLASS_COLOURS[member], "linewidth": 3}
    for member in MEASURED_CLASSES
}
"""How the patches of the hybrid view's legend look: as the pixels of the class do."""


def class_counts(comparison: FrameComparison) -> dict[PixelClass, int]:
    """How many pixels of a frame are in each class."""
    counts = np.bincount(as_array(comparison.label).ravel(), minlength=len(PixelClass))
    return {member: int(counts[member]) for member in PixelClass}


def hybrid_figure(comparison: FrameComparison) -> Figure:
    """The operator's view of one frame with its legend and a scale of the measured range (m)."""
    image = hybrid_image(comparison)
    width, height = canvas.displayed_size((image.shape[0], image.shape[1]), 720)
    box = Box(left=MARGIN, top=HEADER, width=width, height=height)
    lines = [f"{CLASS_WORDS[member]}: {SHOWN_AS[member]}" for member in SHOWN_AS]
    legend = Box(left=MARGIN, top=box.bottom + 16, width=620, height=len(lines) * LEGEND_LINE)
    figure = canvas.blank(max(width + BAR, 640) + 2 * MARGIN, legend.bottom + MARGIN)
    _headline(
        figure,
        f"Hybrid view of frame {comparison.name}",
        "The shaded model where it can be trusted; elsewhere, outlined, what was measured instead.",
    )
    canvas.show(canvas.axes_at(figure, box), image)
    _range_bar(figure, box, hybrid_limits(comparison), "measured (m)")
    _legend(figure, legend, comparison, dict(zip(SHOWN_AS, lines, strict=True)), HYBRID_PATCHES, 1)
    return figure


def comparison_figure(comparison: FrameComparison, alpha: float) -> Figure:
    """Measured, predicted, their difference in standard deviations, and what follows of it (eq. 5).

    Args:
        comparison: One frame.
        alpha: The factor of eq. 5; marked on the scale of the difference.
    """
    label = as_array(comparison.label)
    width, height = canvas.displayed_size((label.shape[0], label.shape[1]), 480)
    across, down = width + BAR + MARGIN, height + 64
    boxes = [
        Box(left=MARGIN + column * across, top=HEADER + 20 + row * down, width=width, height=height)
        for row in range(2)
        for column in range(2)
    ]
    below = Box(left=MARGIN, top=boxes[2].bottom + 16, width=2 * across, height=3 * LEGEND_LINE)
    figure = canvas.blank(max(2 * across, 700) + MARGIN, below.bottom + MARGIN)
    _headline(
        figure,
        f"Frame {comparison.name}: measurement against model",
        f"The model is trusted where they differ by less than {alpha:g} standard deviations σ′. "
        "Dark: nothing there.",
    )
    _range_panels(figure, boxes[0], boxes[1], comparison)
    _difference_panel(figure, boxes[2], comparison, alpha)
    _panel(figure, boxes[3], class_image(label), "Verdict of every pixel")
    words = {member: CLASS_WORDS[member] for member in SHOWN_AS}
    patches = {member: {"facecolor": CLASS_COLOURS[member]} for member in words}
    _legend(figure, below, comparison, words, patches, 2)
    return figure


def range_figure(ranges: Float[Tensor, "h w"], title: str) -> Figure:
    """One range image (m) with its scale; NaN is dark."""
    values = as_array(ranges)
    width, height = canvas.displayed_size((values.shape[0], values.shape[1]), 720)
    box = Box(left=MARGIN, top=HEADER, width=width, height=height)
    figure = canvas.blank(max(width + BAR, 420) + 2 * MARGIN, box.bottom + MARGIN)
    filled = 100.0 * float(np.isfinite(values).mean())
    _headline(figure, title, f"Range in metres; dark: nothing is met. {filled:.0f} % is filled.")
    limits = range_limits(values)
    canvas.show(canvas.axes_at(figure, box), range_colours(values, limits))
    _range_bar(figure, box, limits, "range (m)")
    return figure


def _headline(figure: Figure, title: str, words: str) -> None:
    """A title and a sentence at the top of a figure."""
    canvas.write(figure, MARGIN, 14, title, fontsize=14, fontweight="bold")
    canvas.write(figure, MARGIN, 42, words, fontsize=10, color="#55585d")


def _panel(figure: Figure, box: Box, image: np.ndarray, title: str) -> None:
    """An image with a title above it."""
    canvas.write(figure, box.left, box.top - 24, title, fontweight="bold")
    canvas.show(canvas.axes_at(figure, box), image)


def _bar_beside(box: Box) -> Box:
    """Where the colour bar of a panel stands."""
    return Box(left=box.right + 12, top=box.top, width=18, height=box.height)


def _range_bar(figure: Figure, box: Box, limits: tuple[float, float], title: str) -> None:
    """The scale of a range image beside it."""
    bar = canvas.colour_bar(figure, _bar_beside(box), RANGE_MAP, limits, title)
    bar.ax.invert_yaxis()  # near at the top reads like the legend of a map


def _range_panels(figure: Figure, left: Box, right: Box, comparison: FrameComparison) -> None:
    """The measured and the predicted range on one scale."""
    measured, predicted = as_array(comparison.measured), as_array(comparison.predicted)
    limits = range_limits(np.stack([measured, predicted]))
    for box, values, title in ((left, measured, "Measured"), (right, predicted, "Predicted")):
        _panel(figure, box, range_colours(values, limits), title)
        _range_bar(figure, box, limits, "m")


def _difference_panel(figure: Figure, box: Box, comparison: FrameComparison, alpha: float) -> None:
    """Measured minus predicted over sigma' of eq. 4; red nearer, blue farther, white trusted."""
    reach = 3.0 * alpha
    numbers = [as_array(each) for each in (comparison.measured, comparison.predicted)]
    difference = (numbers[0] - numbers[1]) / as_array(comparison.sigma)
    known = np.isfinite(difference)[..., None]
    scaled = np.clip(np.nan_to_num(difference) / (2.0 * reach) + 0.5, 0.0, 1.0)
    image = np.where(known, DIFFERENCE_MAP(scaled)[..., :3], _rgb(NEUTRAL))
    _panel(figure, box, image, "Measured minus predicted")
    bar = canvas.colour_bar(figure, _bar_beside(box), DIFFERENCE_MAP, (-reach, reach), "σ′")
    bar.ax.hlines([-alpha, alpha], *bar.ax.get_xlim(), colors="black", linewidth=1.5)
    marks = [-reach, -alpha, 0.0, alpha, reach]
    words = ["nearer", f"−{alpha:g}", "0", f"+{alpha:g}", "farther"]
    bar.set_ticks(marks, labels=words)
    bar.ax.invert_yaxis()


def _rgb(colour: str) -> Float[np.ndarray, " 3"]:
    """The three parts (0 to 1) of a colour such as #26282b."""
    return np.array([int(colour[i : i + 2], 16) for i in (1, 3, 5)]) / 255.0


def _legend(
    figure: Figure,
    box: Box,
    comparison: FrameComparison,
    words: dict[PixelClass, str],
    patches: dict[PixelClass, dict],
    columns: int,
) -> None:
    """The classes with how they look in the picture and how many pixels each has."""
    counts = class_counts(comparison)
    total = max(1, sum(counts.values()))
    axes = canvas.axes_at(figure, box)
    axes.set_xlim(0, box.width)
    axes.set_ylim(box.height, 0)
    rows = -(-len(words) // columns)
    for index, (member, sentence) in enumerate(words.items()):
        left, top = index // rows * (box.width / columns), index % rows * LEGEND_LINE
        axes.add_patch(Rectangle((left + 2, top + 4), 16, 14, **patches[member]))
        share = f"{counts[member]:,} pixels ({100.0 * counts[member] / total:.1f} %)"
        canvas.write(
            figure,
            round(box.left + left + 28),
            box.top + top + 3,
            f"{sentence} · {share}",
            fontsize=10,
        )
