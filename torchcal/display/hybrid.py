"""The hybrid view (2.3): the model where it can be trusted, the measurement where it cannot.

One picture for the operator. Shaded surfaces are the model; surfaces in the colours of the range
scale are measured; an outline says where the one turns into the other, and its colour and the
hatching within say why. No two classes differ by colour alone.
"""

from collections.abc import Callable

import numpy as np
from jaxtyping import Bool, Float, UInt8
from scipy import ndimage

from torchcal.calibrate.regions import numbered
from torchcal.calibrate.result import FrameComparison, PixelClass
from torchcal.display.arrays import as_array
from torchcal.display.colours import (
    CLASS_COLOURS,
    NEUTRAL,
    as_bytes,
    range_image,
    range_limits,
)

AMBIENT = 0.5
"""The share of light that reaches a surface seen edge-on."""

STROKE = 300
"""Lines are one such part of the shorter side of the picture wide."""

PERIOD = 9
"""Widths of lines from one line of a hatching to the next."""

SPECKLE = 30
"""Squares of a line's width: a smaller region gets no outline, which would cover it."""

Pattern = Callable[[np.ndarray, np.ndarray, int], np.ndarray]
"""Where the lines of a hatching are, from pixels (u, v) and the width of lines in pixels."""

HATCHINGS: dict[PixelClass, Pattern] = {
    PixelClass.NEARER: lambda u, v, line: (u + v) % (PERIOD * line) < line,
    PixelClass.FARTHER: lambda u, v, line: (u - v) % (PERIOD * line) < line,
    PixelClass.UNMODELLED: lambda u, v, line: (
        np.minimum(u % (PERIOD * line), v % (PERIOD * line)) < line
    ),
}
"""Rising lines, falling lines, a grid."""

MEASURED_CLASSES = tuple(HATCHINGS)
"""The classes in which the operator sees the measurement instead of the model."""


def hybrid_limits(comparison: FrameComparison) -> tuple[float, float]:
    """The ranges (m) at the two ends of the hybrid view's colour scale."""
    measured, label = as_array(comparison.measured), as_array(comparison.label)
    shown = measured[np.isin(label, MEASURED_CLASSES)]
    return range_limits(shown if shown.size else measured)


def hybrid_image(
    comparison: FrameComparison, enlarged: tuple[int, int] = (1, 1)
) -> UInt8[np.ndarray, "h w 3"]:
    """What the operator sees of one frame, pixel by pixel (2.3).

    The model, shaded by a lamp at the sensor, where eq. 5 finds it right; dim, under level lines,
    where nothing was measured that could confirm it; the measured range by colour where eq. 5 finds
    the model wrong or empty, hatched and outlined by class; dark elsewhere.

    Args:
        comparison: One frame.
        enlarged: Rows and columns that are drawn for one pixel, so that the outlines of a small
            image are finer than its pixels.
    """
    label = as_array(comparison.label)
    image = np.broadcast_to(as_bytes(NEUTRAL), (*label.shape, 3)).copy()
    modelled = np.isin(label, (PixelClass.AGREES, PixelClass.MISSING))
    image[modelled] = shaded_model(comparison)[modelled]
    measured = np.isin(label, MEASURED_CLASSES)
    ranges = range_image(as_array(comparison.measured), hybrid_limits(comparison))
    image[measured] = ranges[measured]
    image, label = (each.repeat(enlarged[0], 0).repeat(enlarged[1], 1) for each in (image, label))
    return marked(image, label, max(1, round(min(label.shape) / STROKE)))


def shaded_model(comparison: FrameComparison) -> UInt8[np.ndarray, "h w 3"]:
    """The model in its own colours, lit along the sensor's axis (Lambert)."""
    facing = np.abs(as_array(comparison.normal)[..., 2:].astype(np.float32)).clip(max=1.0)
    light = AMBIENT + (1.0 - AMBIENT) * facing
    return np.round(as_array(comparison.colour) * light).astype(np.uint8)


def marked(
    image: UInt8[np.ndarray, "h w 3"], label: UInt8[np.ndarray, "h w"], line: int
) -> UInt8[np.ndarray, "h w 3"]:
    """The image with hatchings and outlines that tell the classes of its pixels.

    Args:
        image: What the pixels show.
        label: Their classes.
        line: The width of lines in pixels.
    """
    image = image.copy()
    v, u = np.ogrid[: label.shape[0], : label.shape[1]]
    missing = label == PixelClass.MISSING
    image[missing] //= 2
    image[missing & (v % (PERIOD * line) < line)] = as_bytes(CLASS_COLOURS[PixelClass.MISSING])
    for member, lines in HATCHINGS.items():
        inside = label == member
        on = inside & lines(u, v, line)
        image[on] = _contrasted(image[on])
        image[_rim(inside, line)] = as_bytes(CLASS_COLOURS[member])
    return image


def _contrasted(colours: UInt8[np.ndarray, "pixel 3"]) -> UInt8[np.ndarray, "pixel 3"]:
    """Dark colours lighter, light colours darker: their hue still tells the range."""
    dark = colours.mean(-1, keepdims=True) < 110.0
    return np.where(dark, 128 + colours // 2, colours // 2).astype(np.uint8)


def _rim(inside: Bool[np.ndarray, "h w"], line: int) -> Bool[np.ndarray, "h w"]:
    """The border of what most pixels of a neighbourhood belong to, a pixel wider than a line.

    Noise frays the borders of regions; an outline around every fray would hide what is measured.
    """
    if not inside.any():
        return inside
    share: Float[np.ndarray, "h w"] = inside.astype(np.float32)
    body = ndimage.uniform_filter(share, 2 * line + 1, mode="nearest") > 0.5
    region = numbered(body)
    body &= np.bincount(region.ravel())[region] >= SPECKLE * line**2
    return body & (ndimage.minimum_filter(body, 2 * line + 3, mode="nearest") == 0)
