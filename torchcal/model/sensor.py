"""The range sensor: optics, limits, beam and noise."""

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import torch
from torch import Tensor

from torchcal.geometry.projection import Projection


@dataclass(frozen=True, kw_only=True, slots=True)
class Drift:
    """A range error that varies slowly over the image: a Gaussian field."""

    sigma: float
    """Standard deviation (m)."""
    pixels: float
    """Correlation length: at this distance (pixels) the correlation is exp(-1/2)."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Noise:
    """The noise of one pixel's range, sigma(z) = a + b z + c z^2, and its slowly varying part."""

    a: float
    """m"""
    b: float = 0.0
    """dimensionless"""
    c: float = 0.0
    """1/m"""
    drift: Drift | None = None
    """The slowly varying part; None: to be estimated from the residuals' own correlation."""

    def sigma(self, ranges: Tensor) -> Tensor:
        """The standard deviation (m) of the independent part at each range (m); any shape."""
        return self.a + self.b * ranges + self.c * torch.square(ranges)


@dataclass(frozen=True, kw_only=True, slots=True)
class Sensor:
    """A range sensor in its own frame."""

    projection: Projection
    noise: Noise
    near: float
    """The nearest range (m) that is measured."""
    far: float
    """The farthest range (m) that is measured."""
    beam: int
    """Side in pixels of the box of eq. 18 (2N+1); 1: a pixel's own area; 0: an ideal ray."""
    depth_unit: float = 1.0
    """Metres for one unit of an integer image."""


PRESETS: Mapping[str, Mapping[str, Any]] = MappingProxyType(
    {
        "ultrasonic-array": {
            "model": "spherical",
            "columns": 41,
            "rows": 41,
            "azimuth_deg": [-30.0, 30.0],
            "elevation_deg": [30.0, -30.0],
            "range": [0.1, 2.0],
            "sigma": 0.01,
            "beam": 1,
        },
        "laser-scanner": {
            "model": "spherical",
            "columns": 267,
            "rows": 267,
            "azimuth_deg": [-4.0, 4.0],
            "elevation_deg": [4.0, -4.0],
            "range": [3.0, 30.0],
            "sigma": 0.1,
            "beam": 1,
        },
    }
)
"""The sensors of the paper's section 2.2, in the keys of a job's ``[sensor]`` table.

The first row looks up, so that the picture stands upright as that of a pinhole does.
"""
