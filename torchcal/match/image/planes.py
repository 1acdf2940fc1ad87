"""The planes of a range image with their areas and outlines."""

from itertools import pairwise

import numpy as np
import torch
from jaxtyping import Float, Int
from numpy import ndarray
from scipy.spatial import ConvexHull, QhullError
from torch import Tensor

from torchcal.match.elements import Elements
from torchcal.match.features import Planes
from torchcal.match.image.labels import Planar
from torchcal.match.image.windows import Image

BORDER = 0.5
"""Pixels by which the border of a region may be off."""


def image_planes(image: Image, planar: Planar) -> Planes:
    """One element for each plane, at the middle of what is seen of it."""
    count = len(planar.m)
    rows, columns = np.nonzero(planar.label >= 0)
    order = np.argsort(planar.label[rows, columns], kind="stable")
    rows, columns = rows[order], columns[order]
    name = planar.label[rows, columns]
    rays = image.rays[rows, columns]
    plane = torch.from_numpy(name)
    m = planar.m
    inverse = (m[plane] * rays).sum(-1)
    points = rays / inverse[:, None]
    size = torch.bincount(plane, minlength=count).clamp(min=1)
    middle = torch.stack(
        [torch.bincount(plane, points[:, k], minlength=count).to(m) / size for k in range(3)], -1
    )
    patch = _patch(image, rows, columns) / inverse**3 * m.norm(dim=-1)[plane]
    area = torch.bincount(plane, patch.abs(), minlength=count).to(m)
    perimeter = torch.bincount(
        plane, torch.from_numpy(_edge(planar.label)[rows, columns]) * 1.0, minlength=count
    )
    return Planes(
        elements=_elements(m, planar.covariance * planar.excess, middle),
        area=area,
        area_sigma=area * BORDER * perimeter.to(m) / size,
        outline=_outlines(points, name, count),
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


def _patch(image: Image, rows: ndarray, columns: ndarray) -> Float[Tensor, " pixel"]:
    """The solid angle of each pixel in lengths of its ray: ray . (dray/du x dray/dv)."""
    u = torch.as_tensor(columns, dtype=image.range.dtype)
    v = torch.as_tensor(rows, dtype=image.range.dtype)
    du, dv = image.sensor.projection.ray_derivatives(u, v)
    return (image.rays[rows, columns] * torch.linalg.cross(du, dv)).sum(-1)


def _edge(label: Int[ndarray, "h w"]) -> ndarray:
    """Pixels with another label to the right or below."""
    edge = np.zeros(label.shape, bool)
    edge[:, :-1] |= label[:, :-1] != label[:, 1:]
    edge[:-1] |= label[:-1] != label[1:]
    return edge


def _outlines(points: Tensor, name: ndarray, count: int) -> tuple[Tensor, ...]:
    starts = np.searchsorted(name, np.arange(count + 1))
    return tuple(_hull(points[first:last]) for first, last in pairwise(starts))


def _hull(points: Float[Tensor, "point 3"]) -> Float[Tensor, "corner 3"]:
    flat = points - points.mean(0)
    axes = torch.linalg.svd(flat.mT @ flat).U[:, :2]
    try:
        return points[ConvexHull((flat @ axes).numpy()).vertices]
    except QhullError:
        return points
