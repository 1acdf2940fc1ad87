"""From ``CameraInfo`` messages to pinholes, and what their lenses bend."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchcal.geometry.projection import Pinhole
from torchcal.model.recordings.recorded import RangePixels

Grid = NDArray[np.float64]

_MOST_PIXELS = 100_000
"""Wider images, and centres farther away, are none of a camera."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Camera:
    """A pinhole and the lens before it."""

    pinhole: Pinhole
    lens: str = ""
    """``plumb_bob``, ``rational_polynomial`` or ``equidistant``; empty for none."""
    coefficients: tuple[float, ...] = ()

    def rectified(self, image: RangePixels) -> RangePixels:
        """The image without the lens: each pixel takes the nearest, for depth must not be mixed."""
        if not self.lens:
            return image
        u, v = (np.rint(part) for part in self._bent())
        inside = (u >= 0) & (v >= 0) & (u < image.shape[1]) & (v < image.shape[0])
        taken = image[np.where(inside, v, 0).astype(int), np.where(inside, u, 0).astype(int)]
        return np.where(inside, taken, np.zeros((), image.dtype))

    def largest_shift(self) -> float:
        """How far (pixels) the lens moves a pixel of the image."""
        if not self.lens:
            return 0.0
        u, v = self._bent()
        columns, rows = np.meshgrid(*(np.arange(n) for n in (u.shape[1], u.shape[0])))
        return float(np.hypot(u - columns, v - rows).max())

    def _bent(self) -> tuple[Grid, Grid]:
        """Where the image holds what a pinhole would see in each pixel."""
        hole = self.pinhole
        u, v = np.meshgrid(np.arange(hole.width, dtype=float), np.arange(hole.height, dtype=float))
        x, y = (u - hole.cx) / hole.fx, (v - hole.cy) / hole.fy
        # Far outside the image a polynomial may grow beyond all numbers: no pixel is there.
        with np.errstate(all="ignore"):
            x, y = _LENSES[self.lens](x, y, self.coefficients)
        return hole.fx * x + hole.cx, hole.fy * y + hole.cy


def camera_of(info: Any, topic: str) -> Camera:
    """The camera that took the images of a topic.

    Args:
        info: Its ``CameraInfo``.
        topic: Images of a topic with ``rect`` in the last part of its name are rectified: they have
            the pinhole P and no lens any more. All others have K and D.

    Raises:
        ValueError: If the message has no focal length, or a lens that is not known.
    """
    matrix = [float(value) for value in _field(info, "k")]
    bent = [float(value) for value in _field(info, "d")]
    projection = [float(value) for value in _field(info, "p")]
    rectified = "rect" in topic.rsplit("/", 1)[-1] and projection[0] > 0.0
    fx, cx, fy, cy = (
        [projection[i] for i in (0, 2, 5, 6)] if rectified else [matrix[i] for i in (0, 2, 4, 5)]
    )
    hole = pinhole_of(float(info.width), float(info.height), (fx, fy), (cx, cy))
    if rectified or not any(bent):
        return Camera(pinhole=hole)
    lens = info.distortion_model or "plumb_bob"
    if lens not in _LENSES:
        raise ValueError(f"the lens {lens!r}; expected {', '.join(_LENSES)} or a rectified topic")
    if not np.isfinite(bent).all():
        raise ValueError(f"coefficients {bent} of the lens; expected finite numbers")
    return Camera(pinhole=hole, lens=lens, coefficients=tuple(bent))


def pinhole_of(
    width: float, height: float, focal: tuple[float, float], centre: tuple[float, float]
) -> Pinhole:
    """A pinhole of numbers that somebody wrote down: pixels, x before y.

    Raises:
        ValueError: If no camera can have them.
    """
    for name, size in (("width", width), ("height", height)):
        if not (1 <= size <= _MOST_PIXELS and size == int(size)):
            raise ValueError(f"a {name} of {size:g}; expected whole pixels, 1 to {_MOST_PIXELS}")
    for name, length in zip(("fx", "fy"), focal, strict=True):
        if not 0.0 < length < math.inf:
            raise ValueError(f"{name} = {length:g}; expected a focal length above 0 pixels")
    for name, place in zip(("cx", "cy"), centre, strict=True):
        if not abs(place) <= _MOST_PIXELS:
            raise ValueError(f"{name} = {place:g}; expected the image's centre in pixels")
    (fx, fy), (cx, cy) = focal, centre
    return Pinhole(width=int(width), height=int(height), fx=fx, fy=fy, cx=cx, cy=cy)


def centre_note(hole: Pinhole) -> tuple[str, ...]:
    """What a person should know of an optical axis that leaves the image; else nothing."""
    if 0.0 <= hole.cx <= hole.width - 1 and 0.0 <= hole.cy <= hole.height - 1:
        return ()
    return (
        f"WARNING: the optical axis meets the image plane at ({hole.cx:g}, {hole.cy:g}), outside "
        f"the {hole.width}x{hole.height} pixels: right only for images that were cut out",
    )


def _field(info: Any, name: str) -> Any:
    """ROS 1 calls K, D and P what ROS 2 calls k, d and p."""
    return getattr(info, name) if hasattr(info, name) else getattr(info, name.upper())


def _polynomial(x: Grid, y: Grid, coefficients: tuple[float, ...]) -> tuple[Grid, Grid]:
    """``plumb_bob`` with five coefficients, ``rational_polynomial`` with eight (OpenCV's order)."""
    k1, k2, p1, p2, k3, k4, k5, k6 = (*coefficients[:8], *[0.0] * (8 - len(coefficients)))
    squared = x * x + y * y
    above = 1.0 + squared * (k1 + squared * (k2 + squared * k3))
    below = 1.0 + squared * (k4 + squared * (k5 + squared * k6))
    radial, product = above / below, 2.0 * x * y
    return (
        x * radial + p1 * product + p2 * (squared + 2.0 * x * x),
        y * radial + p2 * product + p1 * (squared + 2.0 * y * y),
    )


def _equidistant(x: Grid, y: Grid, coefficients: tuple[float, ...]) -> tuple[Grid, Grid]:
    """The fisheye of four coefficients."""
    k1, k2, k3, k4 = (*coefficients[:4], *[0.0] * (4 - len(coefficients)))
    radius = np.hypot(x, y)
    angle = np.arctan(radius)
    t = angle * angle
    bent = angle * (1.0 + t * (k1 + t * (k2 + t * (k3 + t * k4))))
    scale = np.where(radius > 0.0, bent / np.where(radius > 0.0, radius, 1.0), 1.0)
    return x * scale, y * scale


_LENSES = {
    "plumb_bob": _polynomial,
    "rational_polynomial": _polynomial,
    "equidistant": _equidistant,
}
