"""An oblique wall as cameras and scanners see it, as images and as points."""

import math

import numpy as np
import torch

from torchcal.geometry.projection import Pinhole, Projection, Spherical, pixel_grid

HOLE = Pinhole(width=40, height=30, fx=35.0, fy=36.0, cx=20.25, cy=14.5)
SCANNER = Spherical(width=60, height=16, azimuth=(-0.9, 0.8), elevation=(0.3, -0.2))


def wall(projection: Projection, tilt: float = 0.3) -> np.ndarray:
    """What a sensor 2 m before an oblique wall measures (m)."""
    u, v = pixel_grid(projection, dtype=torch.float64, device=torch.device("cpu"))
    normal = torch.tensor([math.sin(tilt), 0.1, math.cos(tilt)], dtype=torch.float64)
    return (2.0 / (projection.rays(u, v) @ normal)).numpy()


def points(projection: Projection, image: np.ndarray, axes: np.ndarray) -> np.ndarray:
    """The same as points in the frame of a cloud, ``(h w 3)``."""
    u, v = pixel_grid(projection, dtype=torch.float64, device=torch.device("cpu"))
    return (torch.from_numpy(image)[..., None] * projection.rays(u, v)).numpy() @ axes.T


def numbers_of(text: str, key: str) -> list[float]:
    """The first list in brackets in the line of a key of a job file."""
    line = next(line for line in text.splitlines() if line.startswith(f"{key} = "))
    return [float(word) for word in line.split("[")[1].split("]")[0].split(",")]
