"""Range images by casting rays with Embree: eq. 17 and 18 without any code of ``torchcal.render``.

Embree finds which triangle a ray meets, in single precision and without gaps along shared edges;
where on the triangle's plane is then worked out in double precision.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from importlib import import_module
from typing import Any

import numpy as np
import torch
import trimesh
from jaxtyping import Float, Int
from numpy import ndarray
from scipy.ndimage import correlate1d

from torchcal.errors import TorchcalError
from torchcal.geometry.projection import Projection
from torchcal.model.sensor import Sensor

SINGLE_PRECISION = 1e-4
"""Relative. Double precision may move a hit no farther: a grazing triangle's plane can be off."""

FLATNESS = 1e-4
"""m. A pixel whose corners lie this near to the plane that its centre shows, shows that plane."""

RAYS_AT_ONCE = 1 << 20


@dataclass(frozen=True, kw_only=True, slots=True)
class Lattice:
    """A square lattice of sub-samples of a pixel; no two of them share a row or a column."""

    samples: int
    turn: int
    """How far in rows the next column's sample is."""


LATTICE = Lattice(samples=277, turn=60)
"""At least 16 x 16 points (277 = 14^2 + 9^2), turned by 33 degrees."""
FINE_LATTICE = Lattice(samples=4001, turn=899)
"""At least 63 x 63 points (4001 = 49^2 + 40^2), for pixels that no beam averages."""


@dataclass(frozen=True, kw_only=True, slots=True)
class View:
    """Triangles as seen from one sensor pose, ready for rays."""

    triangles: Float[ndarray, "face 3 3"]
    """Corners in the sensor's frame (m)."""
    normals: Float[ndarray, "face 3"]
    """Not normalised."""
    embree: Any
    """Embree's own scene: it has no published type."""
    near: float
    """Of a ray that meets a triangle nearer than this or farther than ``far`` nothing returns."""
    far: float


def view(
    meshes: Sequence[trimesh.Trimesh],
    T_world_sensor: Float[ndarray, "4 4"],
    *,
    near: float = 0.0,
    far: float = math.inf,
) -> View:
    """Prepares meshes (m, world frame) for rays from the origin of a sensor with these limits.

    Raises:
        TorchcalError: If Embree is not installed.
    """
    corners = np.concatenate([np.asarray(mesh.triangles, np.float64) for mesh in meshes])
    triangles = (corners - T_world_sensor[:3, 3]) @ T_world_sensor[:3, :3]
    sides = triangles[:, 1:] - triangles[:, :1]
    return View(
        triangles=triangles,
        normals=np.cross(sides[:, 0], sides[:, 1]),
        embree=_embree_scene(triangles),
        near=near,
        far=far,
    )


def cast(
    scene: View, rays: Float[ndarray, "*batch 3"]
) -> tuple[Float[ndarray, "*batch"], Int[ndarray, "*batch"]]:
    """Follows rays from the sensor's origin to the first triangle that each meets.

    Returns:
        The range, in lengths of the ray: ``range * ray`` is the point (m); the triangle's index in
        ``scene.triangles``. NaN and -1 where nothing is met.
    """
    flat = rays.reshape(-1, 3)
    directions = flat.astype(np.float32)
    hits = scene.embree.run(np.zeros_like(directions), directions, output=True)
    face = np.asarray(hits["primID"], np.int64)
    single = np.where(face >= 0, hits["tfar"].astype(np.float64), np.nan)
    ranges = plane_ranges(scene, face, flat)
    exact = np.abs(ranges - single) <= SINGLE_PRECISION * single
    ranges = np.where(exact, ranges, single)
    returned = (ranges >= scene.near) & (ranges <= scene.far)
    shape = rays.shape[:-1]
    ranges, face = np.where(returned, ranges, np.nan), np.where(returned, face, -1)
    return ranges.reshape(shape), face.reshape(shape)


def plane_ranges(
    scene: View, face: Int[ndarray, "*batch"], rays: Float[ndarray, "*batch 3"]
) -> Float[ndarray, "*batch"]:
    """The ranges at which rays meet the infinite planes of faces; meaningless for face -1."""
    normal = scene.normals[face]
    with np.errstate(divide="ignore", invalid="ignore"):
        return _dot(normal, scene.triangles[face, 0]) / _dot(normal, rays)


def pixel_means(
    scene: View, projection: Projection
) -> tuple[Float[ndarray, "h w"], Float[ndarray, "h w"]]:
    """The mean range over each pixel's own area (eq. 17), and the share of the area with a return.

    A pixel that shows one plane takes the mean from that plane; every other one is sampled.

    Returns:
        The mean (m), 0 where the share is 0; the share, 0 to 1.
    """
    v, u = np.meshgrid(
        np.arange(projection.height, dtype=np.float64),
        np.arange(projection.width, dtype=np.float64),
        indexing="ij",
    )
    _, face = cast(scene, _rays(projection, u, v))
    flat = _shows_one_plane(scene, projection, face)
    gauss = np.stack(
        [plane_ranges(scene, face, _rays(projection, u + a, v + b)) for a, b in _GAUSS_POINTS]
    )
    mean = np.where(flat & (face >= 0), gauss.mean(0), 0.0)
    share = np.where(flat & (face >= 0), 1.0, 0.0)
    for rows, columns in _chunks(~flat, LATTICE):
        mean[rows, columns], share[rows, columns] = _sampled(
            scene, projection, columns, rows, LATTICE
        )
    return mean, share


def sampled_means(
    scene: View, projection: Projection, lattice: Lattice = LATTICE
) -> tuple[Float[ndarray, "h w"], Float[ndarray, "h w"]]:
    """The same as ``pixel_means`` with every pixel sampled: slow, and nothing can slip through."""
    shape = projection.height, projection.width
    mean, share = np.zeros(shape), np.zeros(shape)
    for rows, columns in _chunks(np.ones(shape, bool), lattice):
        mean[rows, columns], share[rows, columns] = _sampled(
            scene, projection, columns, rows, lattice
        )
    return mean, share


def predict(scene: View, projection: Projection, beam: int) -> Float[ndarray, "h w"]:
    """What a sensor without noise measures.

    Args:
        scene: What the sensor sees, from where it stands.
        projection: Its optics.
        beam: Side in pixels of the box of eq. 18; 1: a pixel's own area; 0: an ideal ray.

    Returns:
        Depth or distance (m), as the projection has it; NaN where nothing is met.
    """
    if beam == 0:
        v, u = np.mgrid[: projection.height, : projection.width].astype(np.float64)
        return cast(scene, _rays(projection, u, v))[0]
    return box_mean(*pixel_means(scene, projection), beam)


def box_mean(
    mean: Float[ndarray, "h w"], share: Float[ndarray, "h w"], beam: int
) -> Float[ndarray, "h w"]:
    """The mean over the square of ``beam`` x ``beam`` pixels around each pixel (eq. 18).

    At the border it is the mean over the part inside the image. Area without a return is left out;
    NaN where the whole square has none. An even square covers half of its outermost pixels.
    """
    half = beam // 2
    weights = np.ones(2 * half + 1)
    weights[[0, -1]] = 1.0 if beam % 2 else 0.5
    total, area = (_sum_over(image, weights) for image in (mean * share, share))
    least = 0.5 / FINE_LATTICE.samples
    return np.where(area > least, total / np.maximum(area, least), np.nan)


def measure(
    predicted: Float[ndarray, "h w"], sensor: Sensor, rng: np.random.Generator
) -> Float[ndarray, "h w"]:
    """Adds the sensor's independent noise; NaN outside its limits."""
    sigma = sensor.noise.sigma(torch.from_numpy(predicted)).numpy()
    noisy = predicted + sigma * rng.standard_normal(predicted.shape)
    inside = (noisy >= sensor.near) & (noisy <= sensor.far)
    return np.where(inside, noisy, np.nan)


_GAUSS_POINTS = [(a, b) for a in (-(12**-0.5), 12**-0.5) for b in (-(12**-0.5), 12**-0.5)]
"""Their mean is the mean over a pixel for everything up to third order in u and in v."""


def _embree_scene(triangles: Float[ndarray, "face 3 3"]) -> Any:
    try:
        rtcore_scene = import_module("embreex.rtcore_scene")
        mesh_construction = import_module("embreex.mesh_construction")
    except ImportError as error:
        raise TorchcalError(
            "found no Embree to cast rays with; expected the package embreex, which has wheels for "
            "Linux on x86, macOS and Windows"
        ) from error
    scene = rtcore_scene.EmbreeScene(robust=True)
    vertices = triangles.reshape(-1, 3).astype(np.float32)
    indices = np.arange(len(vertices), dtype=np.int32).reshape(-1, 3)
    mesh_construction.TriangleMesh(scene=scene, vertices=vertices, indices=indices)
    return scene


def _shows_one_plane(scene: View, projection: Projection, face: Int[ndarray, "h w"]) -> ndarray:
    """Pixels whose corners lie on the plane that their centre shows; or show nothing at all."""
    v, u = np.meshgrid(
        np.arange(projection.height + 1) - 0.5,
        np.arange(projection.width + 1) - 0.5,
        indexing="ij",
    )
    rays = _rays(projection, u, v)
    ranges, _ = cast(scene, rays)
    flat = np.ones(face.shape, bool)
    h, w = face.shape
    for rows in (slice(0, h), slice(1, h + 1)):
        for columns in (slice(0, w), slice(1, w + 1)):
            corner = ranges[rows, columns]
            beside = np.abs(plane_ranges(scene, face, rays[rows, columns]) - corner)
            flat &= np.where(face >= 0, beside < FLATNESS, np.isnan(corner))
    return flat


def _sampled(
    scene: View, projection: Projection, columns: ndarray, rows: ndarray, lattice: Lattice
) -> tuple[Float[ndarray, " pixel"], Float[ndarray, " pixel"]]:
    """The mean range and the share of the area with a return, from the lattice of sub-samples."""
    index, samples = np.arange(lattice.samples), lattice.samples
    along_u = (index + 0.5) / samples - 0.5
    along_v = ((index * lattice.turn + samples // 2) % samples + 0.5) / samples - 0.5
    rays = _rays(projection, columns[:, None] + along_u, rows[:, None] + along_v)
    ranges, _ = cast(scene, rays)
    returned = np.isfinite(ranges)
    count = returned.sum(1)
    return np.where(returned, ranges, 0.0).sum(1) / np.maximum(count, 1), count / samples


def _chunks(mask: ndarray, lattice: Lattice) -> Iterator[tuple[ndarray, ndarray]]:
    """Rows and columns of the pixels of a mask, so many at a time that their rays fit in memory."""
    rows, columns = np.nonzero(mask)
    step = RAYS_AT_ONCE // lattice.samples
    for start in range(0, len(rows), step):
        yield rows[start : start + step], columns[start : start + step]


def _rays(projection: Projection, u: ndarray, v: ndarray) -> Float[ndarray, "*batch 3"]:
    return projection.rays(torch.from_numpy(u), torch.from_numpy(v)).numpy()


def _dot(a: Float[ndarray, "*batch 3"], b: Float[ndarray, "*batch 3"]) -> Float[ndarray, "*batch"]:
    return np.einsum("...i,...i->...", a, b)


def _sum_over(image: Float[ndarray, "h w"], weights: ndarray) -> Float[ndarray, "h w"]:
    rows = correlate1d(image, weights, axis=0, mode="constant")
    return correlate1d(rows, weights, axis=1, mode="constant")
