"""The planes of a range image with their areas and outlines."""

from itertools import pairwise

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from numpy import ndarray
from scipy.spatial import ConvexHull, QhullError
from torch import Tensor

from torchcal.match.elements import Elements
from torchcal.match.features import Planes
from torchcal.match.image.blocks import Blocks
from torchcal.match.image.labels import Planar
from torchcal.match.image.windows import Image

BORDER = 0.5
"""Pixels by which the border of a region may be off."""
BESIDE = ((0, 1), (0, -1), (1, 0), (-1, 0))
"""Steps to the pixels beside one, down and to the right."""


def image_planes(image: Image, blocks: Blocks, planar: Planar) -> Planes:
    """One element for each plane, at the middle of what is seen of it."""
    count = len(planar.m)
    label = blocks.of(planar.label)
    rows, columns = np.nonzero(label >= 0)
    plane = torch.from_numpy(label[rows, columns])
    m = planar.m
    rays = torch.from_numpy(blocks.rays[rows, columns])
    inverse = (m[plane] * rays).sum(-1)
    points = rays / inverse[:, None]
    size = torch.bincount(plane, minlength=count).clamp(min=1)
    middle = torch.stack(
        [torch.bincount(plane, points[:, k], minlength=count).to(m) / size for k in range(3)], -1
    )
    patch = _patch(image, blocks, rows, columns) / inverse**3 * m.norm(dim=-1)[plane]
    seen = np.bincount(planar.label[planar.label >= 0], minlength=count)
    area = torch.bincount(plane, patch.abs(), minlength=count).to(m) / size * m.new_tensor(seen)
    border = _border(planar.label)
    perimeter = m.new_tensor(np.bincount(planar.label[border], minlength=count))
    return Planes(
        elements=_elements(m, planar.covariance * planar.excess, middle),
        area=area,
        area_sigma=area * BORDER * perimeter / m.new_tensor(seen).clamp(min=1.0),
        outline=_outlines(image, planar, border),
    )


def _elements(m: Tensor, covariance: Tensor, middle: Tensor) -> Elements:
    """Point and normal to the sensor with their covariance, from that of m."""
    size = m.norm(dim=-1, keepdim=True)
    normal = -m / size
    eye = torch.eye(3, dtype=m.dtype, device=m.device)
    off_axis = (eye - normal[..., :, None] * normal[..., None, :]) / size[..., None]
    along = normal / size
    point = middle + along * ((middle * m).sum(-1, keepdim=True) - 1.0)
    jacobian = torch.cat([along[..., :, None] * point[..., None, :], -off_axis], -2)
    full = jacobian @ covariance @ jacobian.mT
    return Elements.planes(point, normal, full)


def _patch(
    image: Image, blocks: Blocks, rows: ndarray, columns: ndarray
) -> Float[Tensor, " block"]:
    """The solid angle of a block's pixels in lengths of its ray: ray . (dray/du x dray/dv)."""
    u, v = (torch.from_numpy(blocks.side * each + blocks.offset) for each in (columns, rows))
    du, dv = image.sensor.projection.ray_derivatives(u, v)
    return (torch.from_numpy(blocks.rays[rows, columns]) * torch.linalg.cross(du, dv)).sum(-1)


def _border(label: Int[ndarray, "h w"]) -> Bool[ndarray, "h w"]:
    """Pixels of planes beside another label or the image's border."""
    around = np.pad(label, 1, constant_values=-1)
    h, w = label.shape
    beside = (around[1 + v : h + 1 + v, 1 + u : w + 1 + u] for v, u in BESIDE)
    return (label >= 0) & np.logical_or.reduce([each != label for each in beside])


def _outlines(image: Image, planar: Planar, border: Bool[ndarray, "h w"]) -> tuple[Tensor, ...]:
    rows, columns = np.nonzero(border)
    name = planar.label[rows, columns]
    order = np.argsort(name, kind="stable")
    rays = image.rays[rows[order], columns[order]]
    points = rays / (planar.m[torch.from_numpy(name[order])] * rays).sum(-1, keepdim=True)
    starts = np.searchsorted(name[order], np.arange(len(planar.m) + 1))
    return tuple(_hull(points[first:last]) for first, last in pairwise(starts))


def _hull(points: Float[Tensor, "point 3"]) -> Float[Tensor, "corner 3"]:
    flat = points - points.mean(0)
    axes = torch.linalg.svd(flat.mT @ flat).U[:, :2]
    try:
        return points[ConvexHull((flat @ axes).numpy()).vertices]
    except QhullError:
        return points
