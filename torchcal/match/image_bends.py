"""Creases of a range image: straight lines where two surfaces meet."""

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from torchcal.match.features import LineKind
from torchcal.match.image_creases import Found, crease_covariance, dihedral, projected
from torchcal.match.image_strips import Strip, central_ray, fit_crease
from torchcal.match.image_windows import Image

SMALLEST_ANGLE = np.radians(6.0)
SURE = 6.0
"""Standard deviations of a dihedral angle that is no accident."""
FITS = 1.2
"""The largest chi-square per degree of freedom of two planes that meet."""
MOVED = 0.4
"""Of the beam's side: how far a line may be from where the surface bends most."""


def creases(
    image: Image,
    segments: Float[ndarray, "segment 2 2"],
    sides: Float[ndarray, "segment 2"],
) -> list[Found]:
    """The segments that are creases, fitted to the strips along them."""
    found = []
    for segment, (left, right) in zip(segments, sides, strict=True):
        strip = fit_crease(image, segment, (float(left), float(right)))
        line = strip and _crease(image, strip, segment)
        if line:
            found.append(line)
    return found


def _crease(
    image: Image, strip: Strip, segment: Float[ndarray, "2 2"]
) -> Found | None:
    m = np.stack([strip.m_near, strip.m_far])
    blocks = strip.covariance[:6, :6].reshape(2, 3, 2, 3)
    angle, sigma = dihedral(m, np.stack([blocks[0, :, 0], blocks[1, :, 1]]))
    moved = np.linalg.norm(strip.ends - segment, axis=1).max()
    if (
        strip.chi2 > FITS
        or angle < max(SMALLEST_ANGLE, SURE * sigma)
        or moved > max(3.0, MOVED * image.sensor.beam)
    ):
        return None
    rays = np.stack([central_ray(image, end)[0] for end in strip.ends])
    ends = rays / (rays @ m.mean(0))[:, None]
    point, direction, covariance = crease_covariance(m, strip.covariance[:6, :6], ends.mean(0))
    # The left side is that of the first plane: a convex crease stands out before its prolongation.
    beside, _, _ = central_ray(image, strip.ends.mean(0) + strip.normal * max(image.sensor.beam, 4))
    convex = beside @ m[0] < beside @ m[1]
    return Found(
        pixels=projected(image, ends),
        ends=ends,
        point=point,
        direction=direction * np.sign(direction @ (ends[1] - ends[0])),
        covariance=covariance,
        kind=LineKind.CONVEX if convex else LineKind.CONCAVE,
        dihedral=angle,
        dihedral_sigma=sigma,
        planes=(-1, -1),
    )
