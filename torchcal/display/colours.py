"""Colours that a colour-blind person can tell apart, for pixel classes and for ranges."""

import matplotlib
import numpy as np
from jaxtyping import Float, Int, UInt8
from matplotlib.colors import to_rgb

from torchcal.calibrate.result import PixelClass

RANGE_MAP = matplotlib.colormaps["viridis"]
"""Near is dark blue, far is yellow; it has no greys, the colours of most models."""

DIFFERENCE_MAP = matplotlib.colormaps["RdBu"]
"""Red where the measurement is nearer than the model, blue where it is farther."""

NEUTRAL = "#26282b"
"""Where there is nothing to show."""

CLASS_COLOURS: dict[PixelClass, str] = {
    PixelClass.NOT_COMPARED: "#4a4d52",
    PixelClass.AGREES: "#009e73",
    PixelClass.NEARER: "#d55e00",
    PixelClass.FARTHER: "#56b4e9",
    PixelClass.MISSING: "#f0e442",
    PixelClass.UNMODELLED: "#cc79a7",
}
"""The palette of Okabe and Ito, on a neutral grey."""

CLASS_WORDS: dict[PixelClass, str] = {
    PixelClass.NOT_COMPARED: "not compared",
    PixelClass.AGREES: "model and measurement agree",
    PixelClass.NEARER: "measured nearer than the model",
    PixelClass.FARTHER: "measured farther than the model",
    PixelClass.MISSING: "in the model, nothing measured",
    PixelClass.UNMODELLED: "measured, not in the model",
}
"""What each class says, in a few words."""


def class_image(label: Int[np.ndarray, "h w"]) -> UInt8[np.ndarray, "h w 3"]:
    """Every pixel in the colour of its class."""
    palette = np.array([to_rgb(CLASS_COLOURS[member]) for member in PixelClass])
    return np.round(255.0 * palette).astype(np.uint8)[label]


def range_limits(ranges: Float[np.ndarray, "..."]) -> tuple[float, float]:
    """The nearest and farthest range (m) worth a colour: all but the outermost 1 % on each side.

    (0, 1) where nothing is finite; never an empty interval.
    """
    finite = ranges[np.isfinite(ranges)]
    if finite.size == 0:
        return 0.0, 1.0
    low, high = (float(value) for value in np.percentile(finite, [1.0, 99.0]))
    spare = max(0.0, 1e-3 - (high - low)) / 2.0  # a flat wall still needs an interval
    return low - spare, high + spare


def range_colours(
    ranges: Float[np.ndarray, "h w"], limits: tuple[float, float]
) -> Float[np.ndarray, "h w 3"]:
    """RGB (0 to 1) of ranges (m) between ``limits``; the neutral colour where they are NaN."""
    low, high = limits
    finite = np.isfinite(ranges)
    scaled = np.clip((np.where(finite, ranges, low) - low) / (high - low), 0.0, 1.0)
    return np.where(finite[..., None], RANGE_MAP(scaled)[..., :3], to_rgb(NEUTRAL))
