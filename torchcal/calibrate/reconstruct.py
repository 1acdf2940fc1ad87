"""Meshes of what was measured and is not in the model (section 2.5)."""

import math

import numpy as np
import torch
import trimesh
from jaxtyping import Bool, Float, Int
from scipy import ndimage
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from torch import Tensor

from torchcal.calibrate.flatten import flattened
from torchcal.calibrate.regions import box_mean
from torchcal.geometry.projection import Projection, pixel_grid

STEEPEST = 6.0
"""Range step between pixels, in their widths, of a surface seen at 80 degrees; more is a jump."""

FINEST = 0.01
"""Of a pixel's width: ranges are not known better than that, whatever the noise is."""

WIDEST_SMOOTHING = 21
"""Pixels; wider averages would round the object away before they calm the noise."""

SLOPE_SIDE = 5
"""Pixels: at least the side of the square in which a slope is found."""

TELLING = 6.0
"""Standard deviations of an averaged range between object and background that tell their shares."""

LEAST_SHARE = 0.05
"""Pieces of a patch with less of its faces are wild pixels at an edge."""


def mesh_of_region(
    ranges: Float[Tensor, "h w"],
    mask: Bool[Tensor, "h w"],
    projection: Projection,
    T_world_sensor: Float[Tensor, "4 4"],
    *,
    sigma: float,
    beam: int = 1,
    behind: Float[Tensor, "h w"] | None = None,
) -> trimesh.Trimesh:
    """A mesh of the pixels of a region, turned towards the sensor.

    Noise that is wider than the pixels is averaged away within each surface, pixels in which the
    beam mixes the object with what stands beside it carry on the surface of the pure ones, or are
    left out where it is mostly what stands behind, and no triangle crosses a jump in range.

    Args:
        ranges: m; NaN where nothing was measured.
        mask: The region's pixels.
        projection: The sensor's optics.
        T_world_sensor: The pose from which the image was taken.
        sigma: Standard deviation (m) of one pixel's range.
        beam: Side (pixels) of the beam's box.
        behind: What stands behind the object (m); NaN where nobody knows, None if nowhere.

    Returns:
        In the world frame, in metres; empty where the region holds no triangle.
    """
    crop = _around(mask & ranges.isfinite(), margin=beam)
    measured, inside = ranges[crop].double().cpu().numpy(), mask[crop].cpu().numpy()
    inside = inside & np.isfinite(measured)
    if not inside.any():
        return trimesh.Trimesh()
    width = pixel_width(projection) * float(np.median(measured[inside]))
    side = smoothing_side(sigma, width)
    pure = unmixed(inside, beam)
    u, v = (c.cpu()[crop] for c in pixel_grid(projection, dtype=torch.float64, device=mask.device))
    rays = projection.rays(u, v).numpy()
    calm = extended(smoothed(measured, pure, side, sigma), pure, max(beam, SLOPE_SIDE) | 1)
    if behind is not None:
        far = behind[crop].double().cpu().numpy()
        inside &= pure | filled_by_half(measured, calm, far, side, sigma)
    smooth = flattened(calm, inside, rays, max(sigma / side, FINEST * width))
    faces = largest_pieces(
        grid_faces(smooth, inside, STEEPEST * width + 3.0 * math.sqrt(2.0) * sigma / side)
    )
    used, numbers = np.unique(faces, return_inverse=True)
    p_sensor = (rays * smooth[..., None]).reshape(-1, 3)
    mesh = trimesh.Trimesh(p_sensor[used], numbers.reshape(-1, 3), process=False)
    mesh = turned_to_sensor(mesh)
    mesh.apply_transform(T_world_sensor.double().cpu().numpy())
    mesh.metadata.update(source="range image", pixels=int(inside.sum()), sigma_m=sigma)
    return mesh


def pixel_width(projection: Projection) -> float:
    """The mean width of a pixel in the middle of the image at a range of 1 m (m)."""
    u = torch.tensor(0.5 * projection.width, dtype=torch.float64)
    v = torch.tensor(0.5 * projection.height, dtype=torch.float64)
    along_u, along_v = projection.ray_derivatives(u, v)
    return float(torch.sqrt(along_u.norm() * along_v.norm()))


def smoothing_side(sigma: float, width: float) -> int:
    """Side (pixels, odd) of the average that makes the noise as small as a pixel is wide (m)."""
    return min(math.ceil(sigma / width), WIDEST_SMOOTHING) | 1


def smoothed(
    ranges: Float[np.ndarray, "h w"], inside: Bool[np.ndarray, "h w"], side: int, sigma: float
) -> Float[np.ndarray, "h w"]:
    """The average of each pixel's neighbours on its own surface (m).

    A neighbour belongs to the surface when it is within three sigma of a first average, which is
    taken over the pixels within three sigma of the difference of two single ones.
    """
    if side == 1:
        return ranges
    first = _average_near(ranges, ranges, inside, side, 3.0 * math.sqrt(2.0) * sigma)
    return _average_near(ranges, first, inside, side, 3.0 * sigma)


def unmixed(inside: Bool[np.ndarray, "h w"], beam: int) -> Bool[np.ndarray, "h w"]:
    """The pixels of a region in which the beam mixes in nothing of what stands beside it.

    They lie half a beam inside its edge, of a beam of one pixel that pixel; parts too thin to have
    any keep all their pixels.
    """
    reach = max(beam // 2, min(beam, 1))
    if reach == 0:
        return inside
    square = np.ones((2 * reach + 1, 2 * reach + 1), bool)
    # Pixels that miss a measurement are no edge of the object.
    whole = ndimage.binary_closing(np.pad(inside, reach), square)[reach:-reach, reach:-reach]
    pure = ndimage.binary_erosion(whole | inside, square, border_value=1) & inside
    if not pure.any():
        return inside
    distance = np.asarray(ndimage.distance_transform_edt(~pure))
    return pure | (inside & (distance > 2 * reach))


def filled_by_half(
    measured: Float[np.ndarray, "h w"],
    surface: Float[np.ndarray, "h w"],
    behind: Float[np.ndarray, "h w"],
    side: int,
    sigma: float,
) -> Bool[np.ndarray, "h w"]:
    """Where an object fills half of the beam or more, or nobody can tell.

    The beam's mean (eq. 18) lies between the object and what is behind it by the share of each.

    Args:
        measured: m; NaN where nothing was measured.
        surface: Range of the object, carried on beyond its edge (m).
        behind: Range of what stands behind it (m); NaN where nobody knows.
        side: Of the square (pixels) over which the share is averaged.
        sigma: Standard deviation (m) of one pixel's range.
    """
    step = behind - surface
    known = np.isfinite(measured) & (step > TELLING * sigma / side)
    share = (behind - measured) / np.where(known, step, 1.0)
    return ~known | (box_mean(share, known, side)[0] >= 0.5)


def extended(
    ranges: Float[np.ndarray, "h w"], pure: Bool[np.ndarray, "h w"], side: int
) -> Float[np.ndarray, "h w"]:
    """The ranges (m) of the pure pixels, carried on over all others with the slope found nearby.

    The slope is that of the plane fitted to the pure pixels in a square around the nearest one.
    """
    v, u = np.indices(ranges.shape)
    near_v, near_u = np.asarray(
        ndimage.distance_transform_edt(~pure, return_distances=False, return_indices=True)
    )
    slope_v, slope_u = slopes(ranges, pure, side)
    nearest = (near_v, near_u)
    carried = slope_v[nearest] * (v - near_v) + slope_u[nearest] * (u - near_u)
    return ranges[nearest] + carried


def slopes(
    ranges: Float[np.ndarray, "h w"], mask: Bool[np.ndarray, "h w"], side: int
) -> tuple[Float[np.ndarray, "h w"], Float[np.ndarray, "h w"]]:
    """The slopes (m per pixel) along v and u of the least squares plane in a square."""
    v, u = np.indices(ranges.shape, dtype=float)

    def mean(image: np.ndarray) -> np.ndarray:
        return box_mean(image, mask, side)[0]

    z0, v0, u0 = mean(ranges), mean(v), mean(u)
    # A hundredth of a square pixel keeps the slope of a single line or pixel finite.
    vv, uu = mean(v * v) - v0 * v0 + 0.01, mean(u * u) - u0 * u0 + 0.01
    uv, zv, zu = mean(u * v) - u0 * v0, mean(ranges * v) - z0 * v0, mean(ranges * u) - z0 * u0
    determinant = vv * uu - uv * uv
    return (uu * zv - uv * zu) / determinant, (vv * zu - uv * zv) / determinant


def grid_faces(
    ranges: Float[np.ndarray, "h w"], inside: Bool[np.ndarray, "h w"], jump: float
) -> Int[np.ndarray, "face 3"]:
    """Triangles of neighbouring pixels (flat indices) whose ranges differ by at most a jump (m)."""
    index = np.arange(ranges.size).reshape(ranges.shape)
    corners = index[:-1, :-1], index[1:, :-1], index[:-1, 1:], index[1:, 1:]
    a, below, right, across = (corner.ravel() for corner in corners)
    faces = np.concatenate([np.stack([a, below, right], 1), np.stack([right, below, across], 1)])
    faces = faces[inside.ravel()[faces].all(1)]
    return faces[np.ptp(ranges.ravel()[faces], axis=1) <= jump]


def largest_pieces(faces: Int[np.ndarray, "face 3"]) -> Int[np.ndarray, "kept 3"]:
    """The faces without the pieces that hold hardly any of them."""
    if len(faces) == 0:
        return faces
    used, local = np.unique(faces, return_inverse=True)
    local = local.reshape(-1, 3)
    links = np.concatenate([local[:, :2], local[:, 1:]])
    graph = coo_array((np.ones(len(links)), (links[:, 0], links[:, 1])), shape=(len(used),) * 2)
    piece = connected_components(graph, directed=False)[1][local[:, 0]]
    size = np.bincount(piece)
    return faces[size[piece] >= LEAST_SHARE * len(faces)]


def turned_to_sensor(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """The mesh (sensor frame) with its faces turned to the sensor; all were made in one sense."""
    away = np.einsum("fi,fi->f", np.cross(*_sides(mesh)), mesh.triangles_center)
    if away.sum() <= 0.0:
        return mesh
    return trimesh.Trimesh(mesh.vertices, mesh.faces[:, ::-1], process=False)


def _around(mask: Bool[Tensor, "h w"], margin: int) -> tuple[slice, slice]:
    """The rows and columns around a mask; none of an empty one."""
    crop = []
    for axis in (1, 0):
        hit = mask.any(axis).nonzero()
        low, high = (int(hit.min()), int(hit.max()) + 1) if len(hit) else (0, 0)
        crop.append(slice(max(low - margin, 0), high + margin if high else 0))
    return crop[0], crop[1]


def _average_near(
    ranges: np.ndarray, centre: np.ndarray, inside: np.ndarray, side: int, reach: float
) -> np.ndarray:
    """The mean of the ranges in a square that lie within ``reach`` of the centre's value."""
    half = side // 2
    padded = np.pad(np.where(inside, ranges, np.nan), half, constant_values=np.nan)
    height, width = ranges.shape
    total, count = np.zeros(ranges.shape), np.zeros(ranges.shape)
    for dv in range(side):
        for du in range(side):
            other = padded[dv : dv + height, du : du + width]
            near = np.abs(other - centre) <= reach
            total += np.where(near, other, 0.0)
            count += near
    return np.where(inside & (count > 0), total / np.maximum(count, 1), ranges)


def _sides(mesh: trimesh.Trimesh) -> tuple[np.ndarray, np.ndarray]:
    corner = mesh.triangles
    return corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]
