"""The picture beside the three-dimensional view."""

import numpy as np
from jaxtyping import UInt8

from torchcal.calibrate.result import FrameComparison
from torchcal.display import canvas, figures


def hybrid_picture(comparison: FrameComparison) -> UInt8[np.ndarray, "h w 3"]:
    """The model where it can be trusted, the measurement elsewhere, with legend and scale."""
    return np.asarray(canvas.pixels(figures.hybrid_figure(comparison)))


def raw_picture(comparison: FrameComparison) -> UInt8[np.ndarray, "h w 3"]:
    """The measurement alone, with its scale."""
    title = f"Raw measurement of frame {comparison.name}"
    return np.asarray(canvas.pixels(figures.range_figure(comparison.measured, title)))
