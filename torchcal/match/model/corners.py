"""Points where straight edges of a model meet. Numpy, as the regions."""

from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray
from scipy.spatial import KDTree

from torchcal.match.model.edges import Segments

MOST_LINES = 5
"""That may meet in a point: more are the tip of a cone, and no three of them tell it."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Corners:
    """Every three lines that meet."""

    points: Float[ndarray, "corner 3"]
    """m"""
    lines: Int[ndarray, "corner 3"]
    ends: Int[ndarray, "corner 3"]
    """Which end of each line is there: 0 or 1."""
    angles: Float[ndarray, "corner 3"]
    """Between every two of the lines (rad), in ascending order."""


def find_corners(found: Segments, reach: float, least_volume: float) -> Corners:
    """Where ends of three lines meet; of more lines, every three.

    Args:
        found: Lines.
        reach: How far apart (m) the ends may be.
        least_volume: Of three unit vectors along the lines: lines in one plane fix no corner.
    """
    lines, points = _meeting(found, reach)
    away = np.linalg.norm(found.ends[lines] - points[:, None, None], axis=-1)
    ends = away.argmin(-1)
    outwards = found.direction[lines] * np.where(ends == 0, 1.0, -1.0)[..., None]
    one, two = outwards[:, [0, 0, 1]], outwards[:, [1, 2, 2]]
    sine = np.linalg.norm(np.cross(one, two), axis=-1)
    angles = np.sort(np.arctan2(sine, (one * two).sum(-1)), axis=1)
    kept = np.abs(np.linalg.det(outwards)) > least_volume
    return Corners(points=points[kept], lines=lines[kept], ends=ends[kept], angles=angles[kept])


def with_ends_at(found: Segments, corners: Corners) -> Segments:
    """Lines that end at corners end there truly."""
    is_end = found.is_end.copy()
    is_end[corners.lines, corners.ends] = True
    return replace(found, is_end=is_end)


def _meeting(found: Segments, reach: float) -> tuple[ndarray, ndarray]:
    """Triples of lines with ends in one place, and the place."""
    ends = found.ends.reshape(-1, 3)
    triples: list[tuple[int, ...]] = []
    points: list[ndarray] = []
    groups = KDTree(ends).query_ball_point(ends, reach) if len(ends) else []
    for group in sorted({tuple(sorted(each)) for each in groups}):
        lines = sorted({end // 2 for end in group})
        if 3 <= len(lines) <= MOST_LINES:
            threes = list(combinations(lines, 3))
            triples += threes
            points += [ends[list(group)].mean(0)] * len(threes)
    return np.array(triples, np.int64).reshape(-1, 3), np.array(points).reshape(-1, 3)
