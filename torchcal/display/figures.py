"""Figures that a stranger understands: the hybrid view, the comparison, a range image."""

import numpy as np
from jaxtyping import Float, UInt8
from matplotlib.figure import Figure
from torch import Tensor

from torchcal.calibrate.result import FrameComparison, PixelClass
from torchcal.display import canvas
from torchcal.display.arrays import as_array
from torchcal.display.canvas import Box
from torchcal.display.colours import (
    DIFFERENCE_MAP,
    RANGE_MAP,
    class_image,
    difference_image,
    range_image,
    range_limits,
)
from torchcal.display.hybrid import hybrid_image, hybrid_limits
from torchcal.display.legend import draw_legend, legend_height

MARGIN = 20
HEADER = 96
BAR = 112
"""Room for a colour bar and its numbers."""
TITLE = 44
"""From a panel to the next one below it, with its title."""
NARROWEST = 620
"""Pixels that the words of a figure need."""

SHOWN_AS: dict[PixelClass, str] = {
    PixelClass.AGREES: "the model is shown",
    PixelClass.NEARER: "the measurement is shown, with rising lines",
    PixelClass.FARTHER: "the measurement is shown, with falling lines",
    PixelClass.UNMODELLED: "the measurement is shown, with a grid",
    PixelClass.MISSING: "the model is shown, dim, with level lines",
    PixelClass.NOT_COMPARED: "nothing is shown",
}
"""What the hybrid view shows of each class, in the order of legends."""

NO_MODEL = "the model is empty here"
NO_MEASUREMENT = "nothing was measured"


def class_counts(comparison: FrameComparison) -> dict[PixelClass, int]:
    """How many pixels of a frame are in each class, in the order of legends."""
    counts = np.bincount(as_array(comparison.label).ravel(), minlength=len(PixelClass))
    return {member: int(counts[member]) for member in SHOWN_AS}


def hybrid_figure(comparison: FrameComparison) -> Figure:
    """The operator's view of one frame with its legend and a scale of the measured range (m)."""
    rows, columns = comparison.label.shape
    width, height = canvas.displayed_size((rows, columns), 720)
    box = Box(left=MARGIN, top=HEADER, width=width, height=height)
    across = max(width + BAR, NARROWEST)
    legend = Box(left=MARGIN, top=box.bottom + MARGIN, width=across, height=legend_height(2))
    figure = canvas.blank(across + 2 * MARGIN, legend.bottom + MARGIN // 2)
    _headline(
        figure,
        f"Hybrid view of frame {comparison.name}",
        "The model where it can be trusted; what was measured, outlined, where it cannot.",
    )
    _hybrid_panel(figure, box, comparison, "")
    draw_legend(figure, legend, class_counts(comparison), columns=2, classes=False)
    return figure


def comparison_figure(comparison: FrameComparison, alpha: float) -> Figure:
    """Measured, predicted, their difference in standard deviations, and what follows of it (eq. 5).

    Args:
        comparison: One frame.
        alpha: The factor of eq. 5; marked on the scale of the difference.
    """
    label = as_array(comparison.label)
    width, height = canvas.displayed_size((label.shape[0], label.shape[1]), 512)
    across = max(width + BAR + MARGIN, NARROWEST // 2 + 40)
    down = height + TITLE
    boxes = [
        Box(left=MARGIN + column * across, top=HEADER + 20 + row * down, width=width, height=height)
        for row in range(3)
        for column in range(2)
    ]
    figure = canvas.blank(
        2 * across + MARGIN, boxes[4].top + max(height, legend_height(1)) + MARGIN
    )
    _headline(
        figure,
        f"Frame {comparison.name}: measurement against model",
        f"The model is trusted where they differ by less than {alpha:g} standard deviations σ′. "
        "Dark: nothing there.",
    )
    _range_panels(figure, boxes[0], boxes[1], comparison)
    _difference_panel(figure, boxes[2], comparison, alpha)
    _hybrid_panel(figure, boxes[3], comparison, "Hybrid: the model where it is trusted")
    _panel(figure, boxes[4], class_image(label), "Class of every pixel")
    draw_legend(figure, boxes[5], class_counts(comparison), columns=1, classes=True)
    return figure


def range_figure(ranges: Float[Tensor, "h w"], title: str) -> Figure:
    """One range image (m) with its scale; NaN is dark."""
    values = as_array(ranges)
    width, height = canvas.displayed_size((values.shape[0], values.shape[1]), 720)
    box = Box(left=MARGIN, top=HEADER, width=width, height=height)
    figure = canvas.blank(max(width + BAR, 420) + 2 * MARGIN, box.bottom + MARGIN)
    filled = 100.0 * float(np.isfinite(values).mean())
    _headline(figure, title, f"Range in metres; dark: nothing is met. {filled:.0f} % is filled.")
    _range_panel(figure, box, values, range_limits(values), "", "nothing is met")
    return figure


def _headline(figure: Figure, title: str, words: str) -> None:
    """A title and a sentence at the top of a figure."""
    canvas.write(figure, MARGIN, 14, title, fontsize=14, fontweight="bold")
    canvas.write(figure, MARGIN, 42, words, fontsize=10, color=canvas.SOFT)


def _panel(figure: Figure, box: Box, image: UInt8[np.ndarray, "h w 3"], title: str) -> None:
    """An image with a title above it."""
    canvas.write(figure, box.left, box.top - 24, title, fontweight="bold")
    canvas.show(figure, box, image)


def _note(figure: Figure, box: Box, words: str) -> None:
    """Why a panel is dark."""
    left, top = box.left + box.width // 2, box.top + box.height // 2
    canvas.write(figure, left, top, words, color="white", ha="center", va="center")


def _bar_beside(box: Box) -> Box:
    """Where the colour bar of a panel stands."""
    return Box(left=box.right + 12, top=box.top, width=18, height=box.height)


def _range_bar(figure: Figure, box: Box, limits: tuple[float, float], title: str) -> None:
    """The scale of a range image beside it."""
    bar = canvas.colour_bar(figure, _bar_beside(box), RANGE_MAP, limits, title)
    bar.ax.invert_yaxis()  # near at the top reads like the legend of a map


def _hybrid_panel(figure: Figure, box: Box, comparison: FrameComparison, title: str) -> None:
    """The hybrid view; its outlines are drawn as fine as the figure is."""
    factors = canvas.whole_factors((comparison.label.shape[0], comparison.label.shape[1]), box)
    _panel(figure, box, hybrid_image(comparison, factors), title)
    if comparison.measured.isfinite().any():
        _range_bar(figure, box, hybrid_limits(comparison), "measured (m)")
    elif not comparison.predicted.isfinite().any():
        _note(figure, box, f"{NO_MEASUREMENT}, and {NO_MODEL}")


def _range_panel(
    figure: Figure,
    box: Box,
    values: Float[np.ndarray, "h w"],
    limits: tuple[float, float],
    title: str,
    empty: str,
) -> None:
    """Ranges with their scale; where there are none, words that say so."""
    _panel(figure, box, range_image(values, limits), title)
    if np.isfinite(values).any():
        _range_bar(figure, box, limits, "m")
    else:
        _note(figure, box, empty)


def _range_panels(figure: Figure, left: Box, right: Box, comparison: FrameComparison) -> None:
    """The measured and the predicted range on one scale."""
    measured, predicted = as_array(comparison.measured), as_array(comparison.predicted)
    limits = range_limits(np.stack([measured, predicted]))
    _range_panel(figure, left, measured, limits, "Measured", NO_MEASUREMENT)
    _range_panel(figure, right, predicted, limits, "Predicted", NO_MODEL)


def _difference_panel(figure: Figure, box: Box, comparison: FrameComparison, alpha: float) -> None:
    """Measured minus predicted over sigma' of eq. 4; red nearer, blue farther, white trusted."""
    reach = 3.0 * alpha
    difference = as_array((comparison.measured - comparison.predicted) / comparison.sigma)
    _panel(figure, box, difference_image(difference, reach), "Measured minus predicted")
    if not np.isfinite(difference).any():
        return _note(figure, box, "nothing to compare")
    bar = canvas.colour_bar(figure, _bar_beside(box), DIFFERENCE_MAP, (-reach, reach), "σ′")
    bar.ax.hlines([-alpha, alpha], *bar.ax.get_xlim(), colors="black", linewidth=1.5)
    marks = [-reach, -alpha, 0.0, alpha, reach]
    words = ["nearer", f"−{alpha:g}", "0", f"+{alpha:g}", "farther"]
    bar.set_ticks(marks, labels=words)
    bar.ax.invert_yaxis()
