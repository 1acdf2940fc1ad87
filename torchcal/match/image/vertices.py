"""Vertexes of a range image: where three lines meet."""

from itertools import combinations

import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray
from scipy.spatial import KDTree

from torchcal.match.elements import Elements
from torchcal.match.features import Lines, Vertices

NEAR = 0.12
"""Of the range: how far from a vertex the nearest ends of its lines may be."""
SURE = 3.5
"""Standard deviations by which a line may miss a vertex."""
LEAST_ANGLE = np.radians(20.0)
"""Between any two lines of a vertex."""
SLACK = 0.004
"""Of the range: what the rounding of corners by the beam adds to each line's uncertainty."""


def image_vertices(lines: Lines) -> Vertices:
    """Points where three lines meet near their ends, each once.

    A point is the weighted mean of the three lines; its covariance follows from theirs.
    """
    found = [each for trio in _trios(lines) if (each := _vertex(lines, trio)) is not None]
    new = lines.ends.new_tensor
    return Vertices(
        elements=Elements.points(
            new(np.array([each[1] for each in found]).reshape(-1, 3)),
            new(np.array([each[2] for each in found]).reshape(-1, 3, 3)),
        ),
        lines=torch.tensor([each[0] for each in found], dtype=torch.long).reshape(-1, 3),
        angles=new(np.array([each[3] for each in found]).reshape(-1, 3)),
        angles_sigma=new(np.array([each[4] for each in found]).reshape(-1, 3)),
    )


def _trios(lines: Lines) -> list[tuple[int, ...]]:
    """Three lines each of which ends near the ends of the others."""
    ends = lines.ends.numpy().reshape(-1, 3)
    if len(ends) == 0:
        return []
    reach = NEAR * float(np.median(np.linalg.norm(ends, axis=1)))
    trios: set[tuple[int, ...]] = set()
    for around in KDTree(ends).query_ball_tree(KDTree(ends), reach):
        names = sorted({end // 2 for end in around})
        trios.update(combinations(names, 3))
    return sorted(trios)


def _vertex(
    lines: Lines, trio: tuple[int, ...]
) -> tuple[tuple[int, ...], ndarray, ndarray, ndarray, ndarray] | None:
    members = list(trio)
    direction = lines.elements.direction[members].numpy()
    cosines = np.abs([direction[a] @ direction[b] for a, b in combinations(range(3), 2)])
    if cosines.max() > np.cos(LEAST_ANGLE):
        return None
    place = lines.ends[members].numpy()
    start = place[np.arange(3), _nearest_ends(place)]
    weights = [_weight(lines, line, start.mean(0)) for line in members]
    points = lines.elements.point[members].numpy()
    covariance = np.linalg.inv(sum(weights))
    point = covariance @ sum(w @ p for w, p in zip(weights, points, strict=True))
    misfit = sum((point - p) @ w @ (point - p) for w, p in zip(weights, points, strict=True))
    distance = np.linalg.norm(point)
    if misfit > 3 * SURE**2 or np.linalg.norm(start - point, axis=1).max() > NEAR * distance:
        return None
    outward = place[np.arange(3), 1 - _nearest_ends(place)] - point
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    angles, sigmas = _angles(outward, lines.elements.covariance[members, 3:, 3:].numpy())
    return trio, point, covariance, angles, sigmas


def _nearest_ends(place: Float[ndarray, "3 2 3"]) -> ndarray:
    """Which end of each of three lines is near the others."""
    choices = [(a, b, c) for a in (0, 1) for b in (0, 1) for c in (0, 1)]
    spread = [np.var(place[np.arange(3), list(each)], axis=0).sum() for each in choices]
    return np.array(choices[int(np.argmin(spread))])


def _weight(lines: Lines, line: int, at: Float[ndarray, "3"]) -> Float[ndarray, "3 3"]:
    """The information on a point that a line passes through, none along it."""
    direction = lines.elements.direction[line].numpy()
    full = lines.elements.covariance[line].numpy()
    place = (at - lines.elements.point[line].numpy()) @ direction
    moved = np.hstack([np.eye(3), place * np.eye(3)])
    across = np.linalg.svd(direction[None])[2][1:]
    slack = (SLACK * np.linalg.norm(at)) ** 2 * np.eye(2)
    small = across @ moved @ full @ moved.T @ across.T + slack
    return across.T @ np.linalg.inv(small) @ across


def _angles(
    outward: Float[ndarray, "3 3"], covariance: Float[ndarray, "3 3 3"]
) -> tuple[ndarray, ndarray]:
    """Between every two of three directions, in ascending order, and their deviations (rad)."""
    angles, sigmas = [], []
    for a, b in combinations(range(3), 2):
        cosine = float(np.clip(outward[a] @ outward[b], -1.0, 1.0))
        sine = max(np.sqrt(1.0 - cosine**2), 1e-6)
        to_a, to_b = outward[b] / sine, outward[a] / sine
        angles.append(np.arccos(cosine))
        sigmas.append(np.sqrt(to_a @ covariance[a] @ to_a + to_b @ covariance[b] @ to_b))
    order = np.argsort(angles)
    return np.array(angles)[order], np.array(sigmas)[order]
