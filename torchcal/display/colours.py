"""Colours that a colour-blind person can tell apart, for pixel classes and for ranges."""

import matplotlib
import numpy as np
from jaxtyping import Float, UInt8
from matplotlib.colors import Colormap, LinearSegmentedColormap, to_rgb

from torchcal.calibrate.result import PixelClass

RANGE_MAP = matplotlib.colormaps["viridis"]
"""Near is dark blue, far is yellow; it has no greys, the colours of most models."""

NEUTRAL = "#26282b"
"""Where there is nothing to show."""

CLASS_COLOURS: dict[PixelClass, str] = {
    PixelClass.NOT_COMPARED: NEUTRAL,
    PixelClass.AGREES: "#dcddde",
    PixelClass.NEARER: "#d43b0a",
    PixelClass.FARTHER: "#5b85cc",
    PixelClass.MISSING: "#ddab01",
    PixelClass.UNMODELLED: "#7d1e85",
}
"""Quiet where all is well. No two are alike to eyes that lack one kind of cone."""

DIFFERENCE_MAP = LinearSegmentedColormap.from_list(
    "difference",
    [CLASS_COLOURS[PixelClass.NEARER], "#f7f7f7", CLASS_COLOURS[PixelClass.FARTHER]],
)
"""From the colour of what is nearer than the model to that of what is farther."""

CLASS_WORDS: dict[PixelClass, str] = {
    PixelClass.NOT_COMPARED: "not compared",
    PixelClass.AGREES: "model and measurement agree",
    PixelClass.NEARER: "measured nearer than the model",
    PixelClass.FARTHER: "measured farther than the model",
    PixelClass.MISSING: "in the model, nothing measured",
    PixelClass.UNMODELLED: "measured, not in the model",
}
"""What each class says, in a few words."""


def as_bytes(colour: str) -> UInt8[np.ndarray, " 3"]:
    """A colour such as #26282b as RGB."""
    return np.round(255.0 * np.array(to_rgb(colour))).astype(np.uint8)


def class_image(label: UInt8[np.ndarray, "h w"]) -> UInt8[np.ndarray, "h w 3"]:
    """Every pixel in the colour of its class."""
    return np.stack([as_bytes(CLASS_COLOURS[member]) for member in PixelClass])[label]


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


def range_image(
    ranges: Float[np.ndarray, "h w"], limits: tuple[float, float]
) -> UInt8[np.ndarray, "h w 3"]:
    """RGB of ranges (m) between ``limits``; the neutral colour where they are NaN."""
    low, high = limits
    return _mapped((ranges - low) / (high - low), RANGE_MAP)


def difference_image(
    difference: Float[np.ndarray, "h w"], reach: float
) -> UInt8[np.ndarray, "h w 3"]:
    """RGB of differences up to ``reach`` both ways; the neutral colour where they are NaN."""
    return _mapped(difference / (2.0 * reach) + 0.5, DIFFERENCE_MAP)


def _mapped(share: Float[np.ndarray, "h w"], colours: Colormap) -> UInt8[np.ndarray, "h w 3"]:
    """The colours of shares (0 to 1, beyond it the last ones) of a scale of 256 and no more."""
    table = np.concatenate([colours(np.arange(256), bytes=True)[:, :3], as_bytes(NEUTRAL)[None]])
    level = np.clip(np.nan_to_num(256.0 * share), 0.0, 255.0).astype(np.uint16)
    level[~np.isfinite(share)] = 256
    return table[level]
