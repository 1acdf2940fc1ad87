"""The straight lines of a range image: creases and jump edges, each once."""

from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Bool, Float
from numpy import ndarray

from torchcal.match.elements import Elements
from torchcal.match.features import Lines
from torchcal.match.image.blocks import Blocks
from torchcal.match.image.creases import Found, found_creases, straight_borders
from torchcal.match.image.edges import jump_segments
from torchcal.match.image.jumps import jumps
from torchcal.match.image.labels import Planar
from torchcal.match.image.windows import Image

SHORTEST = 34.0
"""Pixels."""
MARGIN = 10.0
"""Pixels beyond half the beam to which the strips along lines reach."""
UNSURE_PLACE, UNSURE_TURN = 40.0, np.radians(60.0)
"""Pixels and rad: the largest standard deviations of a line that is reported."""
PARALLEL = float(np.cos(np.radians(35.0)))
"""Segments that are more parallel share the room between them."""
LONGEST_GAP = 40.0
"""Pixels between two parts of one line."""
SAME_PLACE, SAME_WAY = 5.0, float(np.cos(np.radians(8.0)))
"""Pixels, and of the angle, within which two lines in the image are one."""
END = 3.0
"""Pixels by which an end may be off."""


def image_jumps(image: Image, blocks: Blocks) -> list[Found]:
    """Jump edges, each once; the planes beside them are not known yet."""
    segments = jump_segments(blocks, SHORTEST).ends
    return _once(jumps(image, blocks, segments, _room(segments, max(image.sensor.beam, 1))))


def image_lines(image: Image, blocks: Blocks, planar: Planar, jumping: list[Found]) -> Lines:
    """Jump edges and the creases between planes."""
    beam = max(image.sensor.beam, 1)
    meeting = found_creases(image, planar, SHORTEST)
    borders = straight_borders(image, planar, SHORTEST)
    edges = np.array([each.pixels for each in jumping]).reshape(-1, 2, 2)
    sides = _room(np.concatenate([borders, edges]), beam)[: len(borders)]
    found = _once([*jumping, *meeting, *jumps(image, blocks, borders, sides)])
    return _lines(image, [_with_planes(each, planar, beam) for each in found if _sure(image, each)])


def _sure(image: Image, line: Found) -> bool:
    """Whether the line's place and direction are known well enough to be of use."""
    u, v = image.range.new_tensor(line.pixels.mean(0))
    du, _ = image.sensor.projection.ray_derivatives(u, v)
    distance = float(np.linalg.norm(line.point))
    place, turn = (
        float(np.sqrt(np.linalg.eigvalsh(line.covariance[part, part])[-1]))
        for part in (slice(0, 3), slice(3, 6))
    )
    return bool(place < UNSURE_PLACE * distance * float(du.norm()) and turn < UNSURE_TURN)


def _with_planes(line: Found, planar: Planar, beam: int) -> Found:
    """The planes that most pixels show a little way off the line: of the nearer surface first."""
    if max(line.planes) >= 0:
        return line
    ends = line.pixels
    along = (ends[1] - ends[0]) / _length(ends)
    normal = np.array([along[1], -along[0]])
    places = ends[0] + np.linspace(0.1, 0.9, 17)[:, None] * (ends[1] - ends[0])
    h, w = planar.label.shape
    names = []
    for side in (1.0, -1.0):
        u, v = np.round(places + side * (beam / 2 + 2.0) * normal).astype(int).T
        shown = planar.label[np.clip(v, 0, h - 1), np.clip(u, 0, w - 1)]
        values, counts = np.unique(shown, return_counts=True)
        names.append(int(values[np.argmax(counts)]))
    return replace(line, planes=(names[0], names[1]))


def _place(
    of: Float[ndarray, "other 2 2"], on: Float[ndarray, "segment 2 2"]
) -> tuple[ndarray, ndarray, ndarray]:
    """How far along segments and to their left both ends of others are; the cosines between."""
    along = on[:, 1] - on[:, 0]
    along = along / np.maximum(np.linalg.norm(along, axis=1), 1e-9)[:, None]
    own = of[:, 1] - of[:, 0]
    own = own / np.maximum(np.linalg.norm(own, axis=1), 1e-9)[:, None]
    normal = np.stack([along[:, 1], -along[:, 0]], -1)
    apart = of[None] - on[:, None, :1]
    return (
        np.einsum("soek,sk->soe", apart, along),
        np.einsum("soek,sk->soe", apart, normal),
        np.abs(along @ own.T),
    )


def _beside(place: ndarray, cosine: ndarray, length: ndarray) -> Bool[ndarray, "segment other"]:
    """Whether others run beside a segment for a part of its way."""
    first, last = place.min(-1), place.max(-1)
    shared = np.minimum(last, length[:, None]) - np.maximum(first, 0.0)
    return (shared > 0.3 * length[:, None]) & (cosine > PARALLEL)


def _room(ends: Float[ndarray, "segment 2 2"], beam: int) -> Float[ndarray, "segment 2"]:
    """Pixels to the left and right of each segment that no other one beside it blurs."""
    most = beam / 2 + MARGIN
    if len(ends) == 0:
        return np.zeros((0, 2))
    place, left, cosine = _place(ends, ends)
    beside = _beside(place, cosine, np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1))
    left = left.mean(-1)
    free = np.maximum(np.abs(left) / 2, np.abs(left) - beam / 2)
    np.fill_diagonal(beside, False)
    return np.stack(
        [
            np.where(beside & (sign * left > 8.0), free, most).min(1, initial=most)
            for sign in (1.0, -1.0)
        ],
        -1,
    )


def _once(found: list[Found]) -> list[Found]:
    """Longer lines first; one that runs along a line or carries it on becomes a part of it."""
    kept: list[Found] = []
    for line in sorted(found, key=lambda each: -_length(each.pixels)):
        longer = np.array([each.pixels for each in kept]).reshape(-1, 2, 2)
        same = np.nonzero(_same(longer, line.pixels))[0]
        if len(same):
            kept[same[0]] = _extended(kept[same[0]], line)
        else:
            kept.append(line)
    return kept


def _same(
    longer: Float[ndarray, "kept 2 2"], shorter: Float[ndarray, "2 2"]
) -> Bool[ndarray, " kept"]:
    place, left, cosine = (each[:, 0] for each in _place(shorter[None], longer))
    length = np.linalg.norm(longer[:, 1] - longer[:, 0], axis=1)
    gap = np.maximum(place.min(1) - length, np.maximum(-place.max(1), 0.0))
    near = gap < np.clip(_length(shorter) / 2, 8.0, LONGEST_GAP)
    return near & (cosine >= SAME_WAY) & (np.abs(left).mean(1) <= SAME_PLACE)


def _extended(longer: Found, shorter: Found) -> Found:
    """The longer one with the ends of both."""
    along = longer.direction
    place = (np.concatenate([longer.ends, shorter.ends]) - longer.point) @ along
    low, high = place.argmin(), place.argmax()
    pixels = np.concatenate([longer.pixels, shorter.pixels])
    order = [low, high] if place[1] > place[0] else [high, low]
    return replace(
        longer,
        pixels=pixels[order],
        ends=longer.point + np.outer(place[order], along),
    )


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
    rows, columns = np.mgrid[-2:3, -2:3].reshape(2, -1)
    patch = ranges[
        np.clip(v[..., None] + rows, 0, h - 1), np.clip(u[..., None] + columns, 0, w - 1)
    ]
    own = image.sensor.projection.ranges(torch.from_numpy(ends)).numpy()
    slack = image.sensor.noise.sigma(torch.from_numpy(own)).numpy() * 3.0 + 0.01 * own
    return inside & (np.median(patch, -1) > own - slack)
