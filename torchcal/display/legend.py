"""What the colours and hatchings of the pictures mean, drawn by what draws the pictures."""

from collections.abc import Mapping

import numpy as np
from jaxtyping import UInt8
from matplotlib.figure import Figure

from torchcal.calibrate.result import PixelClass
from torchcal.display import canvas
from torchcal.display.canvas import Box
from torchcal.display.colours import (
    CLASS_WORDS,
    NEUTRAL,
    RANGE_MAP,
    as_bytes,
    class_image,
)
from torchcal.display.hybrid import MEASURED_CLASSES, marked

ROW = 46
"""Pixels from one class of a legend to the next."""

SWATCH = (34, 52)
"""Rows and columns of a piece of the picture that shows one class."""

MODEL = "#b9b2a8"
"""A surface of the model on a swatch."""


def hybrid_swatch(member: PixelClass, line: int = 2) -> UInt8[np.ndarray, "h w 3"]:
    """A small hybrid view in which a region of one class lies amid the model.

    Args:
        member: The class.
        line: The width of lines in pixels.
    """
    label = np.full(SWATCH, PixelClass.AGREES, np.uint8)
    label[4:-4, 4:-4] = member
    image = np.broadcast_to(as_bytes(MODEL), (*SWATCH, 3)).copy()
    if member in MEASURED_CLASSES:
        scale = RANGE_MAP(np.linspace(0.2, 0.8, SWATCH[1]), bytes=True)[:, :3]
        image = np.where((label == member)[..., None], scale, image).astype(np.uint8)
    if member == PixelClass.NOT_COMPARED:
        image[label == member] = as_bytes(NEUTRAL)
    return marked(image, label, line)


def class_swatch(member: PixelClass) -> UInt8[np.ndarray, "h w 3"]:
    """A piece of an image of classes."""
    return class_image(np.full(SWATCH, member, np.uint8))


def draw_legend(
    figure: Figure, box: Box, counts: Mapping[PixelClass, int], columns: int, classes: bool
) -> None:
    """The classes, how they look and how many pixels each has.

    Args:
        figure: Drawn on.
        box: Room for the legend, of ``legend_height``.
        counts: Pixels of each class, in the order of the legend.
        columns: How many classes stand side by side.
        classes: Whether the colours of the image of classes are shown, too.
    """
    total, rows = max(1, sum(counts.values())), -(-len(counts) // columns)
    for index, (member, count) in enumerate(counts.items()):
        left = box.left + index // rows * (box.width // columns)
        top = box.top + index % rows * ROW
        swatches = [hybrid_swatch(member), *([class_swatch(member)] if classes else [])]
        for swatch in swatches:
            place = Box(left=left, top=top, width=SWATCH[1], height=SWATCH[0])
            canvas.show(figure, place, swatch)
            left += SWATCH[1] + 8
        share = f"{count:,} pixels ({100.0 * count / total:.1f} %)"
        canvas.write(figure, left + 4, top, CLASS_WORDS[member], fontsize=10)
        canvas.write(figure, left + 4, top + 17, share, fontsize=9, color=canvas.SOFT)


def legend_height(columns: int) -> int:
    """Pixels that a legend needs."""
    return -(-len(PixelClass) // columns) * ROW
