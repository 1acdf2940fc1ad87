"""The hybrid view (2.3): the model where it can be trusted, the measurement where it cannot.

One picture for the operator. Shaded surfaces are the model; surfaces in the colours of the range
scale are measured; an outline says where the one turns into the other, and why.
"""

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from matplotlib.colors import to_rgb
from scipy import ndimage

from torchcal.calibrate.regions import numbered
from torchcal.calibrate.result import FrameComparison, PixelClass
from torchcal.display.arrays import as_array
from torchcal.display.colours import CLASS_COLOURS, NEUTRAL, range_colours, range_limits

MEASURED_CLASSES = (PixelClass.NEARER, PixelClass.FARTHER, PixelClass.UNMODELLED)
"""The classes in which the operator sees the measurement instead of the model."""

AMBIENT = 0.35
"""The share of light that reaches a surface seen edge-on."""

SPECKLE = 2e-4
"""Smaller regions, as a share of the image, get no outline: it would cover them."""


def hybrid_limits(comparison: FrameComparison) -> tuple[float, float]:
    """The ranges (m) at the two ends of the hybrid view's colour scale."""
    measured, label = as_array(comparison.measured), as_array(comparison.label)
    shown = measured[np.isin(label, MEASURED_CLASSES)]
    return range_limits(shown if shown.size else measured)


def hybrid_image(comparison: FrameComparison) -> UInt8[np.ndarray, "h w 3"]:
    """What the operator sees of one frame, pixel by pixel (2.3).

    The model, shaded by a lamp at the sensor, where eq. 5 finds it right; hatched and dimmed where
    nothing was measured that could confirm it; the measured range by colour where eq. 5 finds the
    model wrong or empty; outlines in the colour of the class around those; dark elsewhere.
    """
    label = as_array(comparison.label)
    measured = range_colours(as_array(comparison.measured), hybrid_limits(comparison))
    model = shaded_model(comparison)
    image = np.broadcast_to(np.array(to_rgb(NEUTRAL)), model.shape).copy()
    for shown, classes in (
        (model, [PixelClass.AGREES]),
        (model * _hatching(label.shape)[..., None], [PixelClass.MISSING]),
        (measured, list(MEASURED_CLASSES)),
    ):
        image = np.where(np.isin(label, classes)[..., None], shown, image)
    return np.round(255.0 * _outlined(image, label)).astype(np.uint8)


def shaded_model(comparison: FrameComparison) -> Float[np.ndarray, "h w 3"]:
    """The model in its own colours (RGB, 0 to 1), lit along the sensor's axis (Lambert)."""
    facing = np.abs(as_array(comparison.normal)[..., 2:])
    return np.clip(as_array(comparison.colour) * (AMBIENT + (1.0 - AMBIENT) * facing), 0.0, 1.0)


def _hatching(shape: tuple[int, int]) -> Float[np.ndarray, "h w"]:
    """Factors of diagonal stripes, some twenty across the shorter side."""
    step = max(2, min(shape) // 40)
    v, u = np.indices(shape)
    return np.where(((u + v) // step) % 2 == 0, 0.25, 0.6)


def _outlined(
    image: Float[np.ndarray, "h w 3"], label: Int[np.ndarray, "h w"]
) -> Float[np.ndarray, "h w 3"]:
    """The image with the rims of measured regions in the colours of their classes."""
    for member in MEASURED_CLASSES:
        rim = _rim(label == member)
        image = np.where(rim[..., None], to_rgb(CLASS_COLOURS[member]), image)
    return image


def _rim(inside: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """The outermost pixels of every region that is larger than a speckle."""
    region = numbered(inside)
    large = np.bincount(region.ravel())[region] >= max(12.0, SPECKLE * inside.size)
    width = max(1, min(inside.shape) // 240)
    core = ndimage.binary_erosion(inside, iterations=width, border_value=1)
    return inside & large & np.logical_not(core)
