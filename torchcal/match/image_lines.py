"""The straight lines of a range image: creases and jump edges, each once."""

import numpy as np
import torch
from jaxtyping import Bool, Float
from numpy import ndarray
from scipy import ndimage

from torchcal.match.elements import Elements
from torchcal.match.features import Lines, LineKind
from torchcal.match.image_bends import bends
from torchcal.match.image_creases import Found
from torchcal.match.image_jumps import jumps
from torchcal.match.image_labels import Planar
from torchcal.match.image_windows import Image

SHORTEST = 22.0
"""Pixels."""
SAME_PLACE, SAME_WAY = 6.0, float(np.cos(np.radians(12.0)))
"""Pixels, and of the angle, within which two lines in the image are one."""
END = 3.0
"""Pixels by which an end may be off."""


def image_lines(image: Image, planar: Planar) -> Lines:
    """Creases and jump edges; where both are found, what is nearer to what was measured."""
    found = _once([*bends(image, planar, SHORTEST), *jumps(image, planar, SHORTEST)])
    return _lines(image, found)


def _once(found: list[Found]) -> list[Found]:
    """Longer lines first, none that runs along one that is there already."""
    kept: list[Found] = []
    for line in sorted(found, key=lambda each: -_length(each.pixels)):
        if not any(_same(other.pixels, line.pixels) for other in kept):
            kept.append(line)
    return kept


def _same(longer: Float[ndarray, "2 2"], shorter: Float[ndarray, "2 2"]) -> bool:
    along = (longer[1] - longer[0]) / _length(longer)
    own = (shorter[1] - shorter[0]) / max(_length(shorter), 1e-9)
    if abs(along @ own) < SAME_WAY:
        return False
    apart = shorter - longer[0]
    place = apart @ along
    across = apart @ np.array([-along[1], along[0]])
    shared = min(place.max(), _length(longer)) - max(place.min(), 0.0)
    return bool(np.abs(across).mean() < SAME_PLACE and shared > 0.3 * _length(shorter))


def _length(pixels: Float[ndarray, "2 2"]) -> float:
    return float(np.linalg.norm(pixels[1] - pixels[0]))


def _lines(image: Image, found: list[Found]) -> Lines:
    new = image.range.new_tensor
    ends = new(np.array([each.ends for each in found]).reshape(-1, 2, 3))
    covariance = new(np.array([each.covariance for each in found]).reshape(-1, 6, 6))
    pixels = np.array([each.pixels for each in found]).reshape(-1, 2, 2)
    size = np.linalg.norm(pixels[:, 1] - pixels[:, 0], axis=-1)
    return Lines(
        elements=Elements.lines(
            new(np.array([each.point for each in found]).reshape(-1, 3)),
            new(np.array([each.direction for each in found]).reshape(-1, 3)),
            covariance,
        ),
        ends=ends,
        is_end=torch.from_numpy(_is_end(image, pixels, ends.numpy())),
        length_sigma=(ends[:, 1] - ends[:, 0]).norm(dim=-1) * new(2**0.5 * END / size),
        kind=torch.tensor([each.kind.value for each in found], dtype=torch.long),
        dihedral=new([each.dihedral for each in found]),
        dihedral_sigma=new([each.dihedral_sigma for each in found]),
        planes=torch.tensor([each.planes for each in found], dtype=torch.long).reshape(-1, 2),
    )


def _is_end(
    image: Image, pixels: Float[ndarray, "line 2 2"], ends: Float[ndarray, "line 2 3"]
) -> Bool[ndarray, "line 2"]:
    """Ends within the image that nothing nearer hides."""
    beam = max(image.sensor.beam, 1)
    along = pixels[:, 1] - pixels[:, 0]
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    beyond = pixels + (beam / 2 + 4.0) * np.stack([-along, along], 1)
    h, w = image.range.shape
    inside = ((beyond >= 0) & (beyond <= np.array([w - 1, h - 1]))).all(-1)
    u, v = np.clip(np.round(beyond), 0, np.array([w - 1, h - 1])).astype(int).transpose(2, 0, 1)
    ranges = np.where(image.valid.numpy(), image.range.numpy(), np.inf)
    around = ndimage.median_filter(ranges, 5) if len(pixels) else ranges
    own = image.sensor.projection.ranges(torch.from_numpy(ends)).numpy()
    slack = image.sensor.noise.sigma(torch.from_numpy(own)).numpy() * 3.0 + 0.01 * own
    return inside & (around[v, u] > own - slack)
