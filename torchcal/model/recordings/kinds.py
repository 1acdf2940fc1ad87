"""What is assumed of kinds of sensors where a recording does not say; a person may know better."""

import numpy as np

from torchcal.model.recordings.recorded import RangePixels, Selection

CAMERA_NOISE = (0.001, 0.0, 0.003)
"""a, b, c of sigma = a + b z + c z^2 (m): depth from stereo or structured light within 2 m."""
LASER_NOISE = (0.01, 0.0, 0.0)
"""m: time of flight, as data sheets of scanners for robots say."""

_MILLIMETRE = 0.001
_FAR_FOR_METRES = 100.0
"""A depth camera whose median is beyond this sends other units than metres."""


def unit_of(kind: np.dtype, selection: Selection) -> float:
    """Metres of one unit of an image: as asked, else 0.001 for integers and 1 for floats."""
    if selection.depth_unit is not None:
        return selection.depth_unit
    return (selection.spare_unit or _MILLIMETRE) if np.issubdtype(kind, np.integer) else 1.0


def unit_note(kind: np.dtype, selection: Selection) -> tuple[str, ...]:
    """What a person should know of the unit; nothing where it was given."""
    given = selection.depth_unit is not None or selection.spare_unit is not None
    if given or not np.issubdtype(kind, np.integer):
        return ()
    return ("integer images were taken for millimetres: --depth-unit says otherwise",)


def looks_like_millimetres(pixels: RangePixels) -> bool:
    """Whether floats, which should be metres, can hardly be."""
    measured = pixels[np.isfinite(pixels) & (pixels != 0)]
    floats = np.issubdtype(pixels.dtype, np.floating)
    return bool(floats and measured.size and np.median(measured) > _FAR_FOR_METRES)
