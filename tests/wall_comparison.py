"""Comparisons with known answers: a wall at 3 m, boxes before it, and noise of two kinds."""

import numpy as np
import torch
from scipy import ndimage

from torchcal.calibrate.result import FrameComparison
from torchcal.geometry.projection import Pinhole
from torchcal.model.sensor import Noise, Sensor

SHAPE = (160, 200)
WALL = 3.0
BOX = (slice(50, 110), slice(70, 130))
"""60 x 60 pixels: 0.295 m at 2.7 m."""
PINHOLE = Pinhole(width=200, height=160, fx=549.0, fy=549.0, cx=99.5, cy=79.5)
NOISY = Sensor(projection=PINHOLE, noise=Noise(a=0.05), near=0.3, far=10.0, beam=21)
"""The sensor of the paper's 4.2: 5 cm from pixel to pixel, and a wide beam."""
DEPTH_CAMERA = Sensor(projection=PINHOLE, noise=Noise(a=0.002), near=0.3, far=10.0, beam=1)
"""Little noise, but with a drift of 3 mm over 30 pixels."""


def scene(box=None, *, place=BOX, beam=1):
    """Ranges of the wall, with a box whose front is ``box`` metres away if it is not None."""
    ranges = np.full(SHAPE, WALL)
    if box is not None:
        ranges[place] = box
    return ndimage.uniform_filter(ranges, beam, mode="nearest") if beam > 1 else ranges


def white(seed, sigma=0.05):
    return sigma * np.random.default_rng(seed).standard_normal(SHAPE)


def drift(seed, sigma=0.003, pixels=30.0):
    """A Gaussian field whose correlation falls to exp(-1/2) at ``pixels``."""
    width = pixels / np.sqrt(2.0)
    field = np.random.default_rng(seed).standard_normal(SHAPE)
    smooth = ndimage.gaussian_filter(field, width, mode="wrap")
    return sigma * 2.0 * np.sqrt(np.pi) * width * smooth


def comparison(measured, predicted, sigma, *, body=None, usable=None, alpha=3.0, name="frame"):
    """Eq. 5 pixel by pixel; body 0 wherever something is modelled unless told otherwise."""
    z, model = torch.from_numpy(measured), torch.from_numpy(predicted)
    sigmas = torch.where(model.isfinite(), torch.as_tensor(sigma, dtype=z.dtype), torch.nan)
    d = (z - model) / sigmas
    label = torch.where(d < -alpha, 2, torch.where(d > alpha, 3, 1))
    label = torch.where(z.isfinite(), label, 4)
    label = torch.where(model.isfinite(), label, torch.where(z.isfinite(), 5, 0))
    allowed = torch.ones(z.shape, dtype=torch.bool) if usable is None else usable
    return FrameComparison(
        name=name,
        measured=z,
        predicted=model,
        sigma=sigmas,
        label=torch.where(allowed, label, 0).byte(),
        body=(torch.where(model.isfinite(), 0, -1) if body is None else body).int(),
        colour=torch.zeros(*z.shape, 3, dtype=torch.uint8),
        normal=torch.zeros(*z.shape, 3, dtype=torch.float16),
        usable=allowed,
    )
