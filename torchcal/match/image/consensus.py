"""Every pixel that agrees with a plane beside it, the larger planes first."""

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from torchcal.match.image.labels import Planar, smooth
from torchcal.match.image.windows import Image

AGREES = 4.0
"""Standard deviations of a pixel: less than one in ten thousand is farther off by accident."""
STEPS = ((0, 1), (0, -1), (1, 0), (-1, 0))
"""Down and to the right, from a pixel to those beside it."""


def explained(image: Image, planar: Planar) -> Int[ndarray, "h w"]:
    """Planes spread over all pixels beside them that show nothing else for sure.

    Where two planes explain a pixel, as along a crease, it goes to the larger one: the smaller one
    has what the larger one leaves unexplained.
    """
    label = planar.label.copy()
    size = np.bincount(label[label >= 0], minlength=len(planar.m))
    rank = np.append(size, -1)
    mean, side = smooth(image, 1)
    usable = image.valid.numpy()
    limit = AGREES / side * image.sigma.numpy()
    changed = True
    while changed:
        changed = False
        for step in STEPS:
            rows, columns, plane = _beside(label, rank, usable, step)
            rays = image.rays.numpy()[rows, columns]
            inverse = np.einsum("pk,pk->p", rays, planar.m.numpy()[plane])
            off = np.abs(mean[rows, columns] - 1.0 / np.maximum(inverse, 1e-6))
            agrees = off < limit[rows, columns]
            label[rows[agrees], columns[agrees]] = plane[agrees]
            changed |= bool(agrees.any())
    return label


def _beside(
    label: Int[ndarray, "h w"],
    rank: Float[ndarray, " plane"] | Int[ndarray, " plane"],
    usable: Bool[ndarray, "h w"],
    step: tuple[int, int],
) -> tuple[Int[ndarray, " pixel"], Int[ndarray, " pixel"], Int[ndarray, " pixel"]]:
    """Pixels beside a larger plane than their own in one direction, and that plane."""
    h, w = label.shape
    v, u = step
    place = np.s_[max(-v, 0) : h - max(v, 0), max(-u, 0) : w - max(u, 0)]
    other = label[max(v, 0) : h + min(v, 0), max(u, 0) : w + min(u, 0)]
    rows, columns = np.nonzero((rank[other] > rank[label[place]]) & usable[place])
    plane = other[rows, columns]
    return rows + max(-v, 0), columns + max(-u, 0), plane
