"""What is assumed of kinds of sensors where a recording does not say; a person may know better."""

import numpy as np

from torchcal.model.recordings.recorded import RangePixels

CAMERA_NOISE = (0.001, 0.0, 0.003)
"""a, b, c of sigma = a + b z + c z^2 (m): depth from stereo or structured light within 2 m."""
LASER_NOISE = (0.01, 0.0, 0.0)
"""m: time of flight, as data sheets of scanners for robots say."""

MILLIMETRE = 0.001
_FAR_FOR_METRES = 100.0
"""A depth camera whose median is beyond this sends other units than metres."""


def unit_of(pixels: RangePixels, asked: float | None) -> float:
    """Metres of one unit: as asked, else millimetres for integers and metres for floats."""
    whole = np.issubdtype(pixels.dtype, np.integer)
    return asked if asked is not None else (MILLIMETRE if whole else 1.0)


def looks_like_millimetres(pixels: RangePixels) -> bool:
    """Whether floats, which should be metres, can hardly be."""
    measured = pixels[np.isfinite(pixels) & (pixels != 0)]
    floats = np.issubdtype(pixels.dtype, np.floating)
    return bool(floats and measured.size and np.median(measured) > _FAR_FOR_METRES)
