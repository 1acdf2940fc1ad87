"""Extracted lines and planes against the visible edges and surfaces of known meshes."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from torchcal.demo import raycast
from torchcal.demo.visible_edges import VisibleEdges
from torchcal.geometry.projection import Projection, pixel_grid
from torchcal.match.elements import Elements

ANGLE, DISTANCE = np.radians(2.0), 5.0
"""rad and pixels within which a line in the image is an edge."""
SHARED = 0.5
"""Of the shorter one's length that both must have in common."""
SHORTEST = 15.0
"""Pixels. Shorter visible pieces of edges are none."""
STEP = 8
"""Pixels from one to the next of those whose surfaces count as seen."""


@dataclass(frozen=True, kw_only=True, slots=True)
class LineScore:
    """Which edges are found, and which lines are true."""

    found: Bool[ndarray, " target"]
    """Of the strong edges, those that could pass for another one counted once."""
    alone: Bool[ndarray, " target"]
    """Those with no other strong edge beside them within the beam."""
    edge: Int[ndarray, " line"]
    """The visible edge that each line is; -1: spurious, or found already."""


def score_lines(
    lines: Float[ndarray, "line 2 2"], edges: VisibleEdges, *, longest: float, beam: float = 0.0
) -> LineScore:
    """Assigns each line at most one edge and each edge at most one line, strong edges first.

    Args:
        lines: Both ends of each line in the image.
        edges: What there is to be seen.
        longest: Pixels that an edge's strong part must be longer than to be looked for.
        beam: Pixels within which the blur mixes edges side by side.
    """
    strong = edges.strong > longest
    targets = _distinct(edges.pixels, np.where(strong, edges.strong, -1.0))
    fit = _fits(lines, edges.pixels) & (edges.weak >= SHORTEST)
    off = np.where(fit, _offset(lines, edges.pixels), np.inf)
    edge = np.full(len(lines), -1)
    for wanted in (targets, np.arange(len(edges.weak))):
        _assign(off, edge, wanted)
    twin = _fits(edges.pixels, edges.pixels)
    taken = np.zeros(len(edges.weak), bool)
    for k, each in enumerate(edge):
        if each >= 0 and taken[each]:
            edge[k] = -1
        elif each >= 0 and each not in targets:
            near = twin[each] & np.isin(np.arange(len(taken)), edge[:k])
            taken |= near
        taken[max(each, 0)] |= each >= 0
    crowd = _fits(edges.pixels, edges.pixels, np.radians(15.0), beam)[np.ix_(targets, targets)]
    alone = (crowd | crowd.T).sum(1) <= 1
    return LineScore(found=np.isin(targets, edge), alone=alone, edge=edge)


def _assign(off: Float[ndarray, "line edge"], edge: Int[ndarray, " line"], wanted: ndarray) -> None:
    """The nearest pairs first, each line and edge once; in place."""
    allowed = np.full_like(off, np.inf)
    allowed[:, wanted] = off[:, wanted]
    allowed[edge >= 0] = np.inf
    allowed[:, edge[edge >= 0]] = np.inf
    while allowed.size and np.isfinite(allowed).any():
        line, own = np.unravel_index(np.argmin(allowed), allowed.shape)
        edge[line] = own
        allowed[line], allowed[:, own] = np.inf, np.inf


def _distinct(pixels: Float[ndarray, "edge 2 2"], weight: Float[ndarray, " edge"]) -> ndarray:
    """The edges with weight, without those that could be found as another one."""
    same = _fits(pixels, pixels)
    kept: list[int] = []
    for edge in np.argsort(-weight):
        if weight[edge] > 0 and not same[edge, kept].any():
            kept.append(int(edge))
    return np.array(kept, dtype=int)


def _fits(
    lines: Float[ndarray, "line 2 2"],
    edges: Float[ndarray, "edge 2 2"],
    most_angle: float = float(ANGLE),
    distance: float = DISTANCE,
) -> ndarray:
    along, length = _along(lines)
    own, size = _along(edges)
    angle = np.arccos(np.clip(np.abs(along @ own.T), 0.0, 1.0))
    place = np.einsum("leik,lk->lei", edges[None] - lines[:, None, :1], along)
    shared = np.minimum(place.max(-1), length[:, None]) - np.maximum(place.min(-1), 0.0)
    shorter = np.minimum(length[:, None], size)
    near = _offset(lines, edges) <= distance
    return (angle < most_angle) & near & (shared > SHARED * shorter)


def _offset(lines: Float[ndarray, "line 2 2"], edges: Float[ndarray, "edge 2 2"]) -> ndarray:
    """Of the line from the edge, at the middle of what both have in common."""
    along, length = _along(lines)
    own, _ = _along(edges)
    place = np.einsum("leik,lk->lei", edges[None] - lines[:, None, :1], along)
    first = np.maximum(place.min(-1), 0.0)
    last = np.minimum(place.max(-1), length[:, None])
    middle = lines[:, None, 0] + 0.5 * (first + last)[..., None] * along[:, None]
    normal = np.stack([-own[:, 1], own[:, 0]], -1)
    return np.abs(((middle - edges[None, :, 0]) * normal).sum(-1))


def _along(pixels: Float[ndarray, "line 2 2"]) -> tuple[ndarray, ndarray]:
    along = pixels[:, 1] - pixels[:, 0]
    length = np.linalg.norm(along, axis=1)
    return along / np.maximum(length, 1e-9)[:, None], length


def line_nees(
    elements: Elements, edge: Int[ndarray, " line"], edges: VisibleEdges
) -> Float[ndarray, " true"]:
    """Squared errors of true lines across themselves, in units of their covariance.

    Returns:
        The mean of the four degrees of freedom of each line.
    """
    true = np.nonzero(edge >= 0)[0]
    ends = edges.ends[edge[true]]
    direction = elements.direction[true].numpy()
    along = ends[:, 1] - ends[:, 0]
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    along *= np.sign((along * direction).sum(1, keepdims=True))
    point = elements.point[true].numpy()
    foot = ends[:, 0] + ((point - ends[:, 0]) * along).sum(1, keepdims=True) * along
    error = np.concatenate([point - foot, direction - along], 1)
    return _whitened(error, elements.covariance[true].numpy(), _across(direction)) / 4


def plane_nees(
    elements: Elements, scene: raycast.View, projection: Projection
) -> tuple[Float[ndarray, " plane"], Float[ndarray, " plane"]]:
    """Squared errors of planes against the nearest visible surface, per degree of freedom.

    Returns:
        The mean of the three degrees of freedom; the distance (m) from the surface.
    """
    grid = pixel_grid(projection, dtype=torch.float64, device=torch.device("cpu"))
    rays = projection.rays(*(each[::STEP, ::STEP] for each in grid)).numpy()
    faces = np.unique(raycast.cast(scene, rays)[1])
    faces = faces[faces >= 0]
    normals = scene.normals[faces]
    normals = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    point, own = elements.point.numpy(), elements.direction.numpy()
    off = ((point[:, None] - scene.triangles[faces, 0]) * normals).sum(-1)
    sign = np.sign(own @ normals.T)
    tilt = own[:, None] - sign[..., None] * normals
    closeness = np.abs(off) + 2.0 * np.linalg.norm(tilt, axis=-1)
    best = closeness.argmin(1)
    row = np.arange(len(best))
    error = np.concatenate([(off[row, best] * sign[row, best])[:, None] * own, tilt[row, best]], 1)
    axes = _across(own)
    frame = np.zeros((len(own), 3, 6))
    frame[:, 0, :3] = own
    frame[:, 1:, 3:] = axes[:, :2, :3]
    nees = _whitened(error, elements.covariance.numpy(), frame) / 3
    return nees, closeness[row, best]


def _across(direction: Float[ndarray, "line 3"]) -> Float[ndarray, "line 4 6"]:
    """Axes of point and direction across lines."""
    other = np.eye(3)[np.abs(direction).argmin(1)]
    first = np.cross(direction, other)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    pair = np.stack([first, np.cross(direction, first)], 1)
    frame = np.zeros((len(direction), 4, 6))
    frame[:, :2, :3], frame[:, 2:, 3:] = pair, pair
    return frame


def _whitened(error: ndarray, covariance: ndarray, frame: ndarray) -> Float[ndarray, " element"]:
    short = np.einsum("eij,ej->ei", frame, error)
    matrix = frame @ covariance @ frame.transpose(0, 2, 1)
    return np.einsum("ei,ei->e", short, np.linalg.solve(matrix, short[..., None])[..., 0])
