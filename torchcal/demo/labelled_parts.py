"""Extracted planes against the labelled parts of real range images of a depth camera."""

from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from torchcal.geometry.projection import Pinhole
from torchcal.match.image.features import image_labels
from torchcal.model.sensor import Noise, Sensor

CAMERA = Sensor(
    projection=Pinhole(width=640, height=480, fx=525.0, fy=525.0, cx=319.5, cy=239.5),
    noise=Noise(a=0.001, c=0.0015),
    near=0.3,
    far=10.0,
    beam=1,
)
FIRST_PART = 20
"""Smaller labels are the table and what is unlabelled."""
FLAT = 2e-3
"""m. A part is flat whose median distance from its own plane is smaller."""
FOUND = 0.7
"""Intersection over union of a part and a plane that are one."""


def part_scores(folder: Path) -> dict[str, float]:
    """Measures the planes found in all images of a folder.

    Returns:
        Percent of the flat parts' area that is found as one plane; percent of the area of planes
        on parts that lies across the border of the plane's part.
    """
    flat_area = found_area = plane_area = across_area = 0
    for file in sorted(folder.glob("*.npz")):
        data = np.load(file)
        depth = torch.from_numpy(data["depth"]).double()
        label = image_labels(depth, CAMERA).numpy()
        parts = np.where((data["depth"] > 0) & (data["label"] >= FIRST_PART), data["label"], 0)
        for name in np.unique(parts[parts > 0]):
            part = parts == name
            if _distance(depth.numpy(), part) < FLAT:
                flat_area += part.sum()
                found_area += part.sum() * (_best(label, part) > FOUND)
        shown, outside = _across(label, data["label"], data["depth"] > 0)
        plane_area += shown
        across_area += outside
    return {
        "found_percent": 100.0 * float(found_area) / max(float(flat_area), 1.0),
        "across_percent": 100.0 * float(across_area) / max(float(plane_area), 1.0),
    }


def _distance(depth: Float[ndarray, "h w"], part: Bool[ndarray, "h w"]) -> float:
    """The median distance (m) of a part's pixels from the plane that fits them best."""
    v, u = np.nonzero(part)
    rays = CAMERA.projection.rays(torch.from_numpy(u * 1.0), torch.from_numpy(v * 1.0)).numpy()
    points = rays * depth[v, u, None]
    used = np.ones(len(points), bool)
    off = np.zeros(len(points))
    for _ in range(5):
        middle = points[used].mean(0)
        normal = np.linalg.svd((points[used] - middle).T @ (points[used] - middle))[0][:, 2]
        off = np.abs((points - middle) @ normal)
        used = off <= 3.0 * np.median(off)
    return float(np.median(off))


def _best(label: Int[ndarray, "h w"], part: Bool[ndarray, "h w"]) -> float:
    """The largest intersection over union of a plane and a part."""
    planes = np.unique(label[part & (label >= 0)])
    shares = [(part & (label == p)).sum() / (part | (label == p)).sum() for p in planes]
    return max(shares, default=0.0)


def _across(
    label: Int[ndarray, "h w"], truth: ndarray, valid: Bool[ndarray, "h w"]
) -> tuple[int, int]:
    """Pixels of the planes that show mostly parts, and those of them not on the plane's part."""
    shown = outside = 0
    for plane in np.unique(label[label >= 0]):
        names, counts = np.unique(truth[(label == plane) & valid], return_counts=True)
        if len(names) and names[counts.argmax()] >= FIRST_PART:
            shown += int(counts.sum())
            outside += int(counts.sum() - counts.max())
    return shown, outside
