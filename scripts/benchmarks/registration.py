"""Other programs that find a sensor's pose from a range image and the mesh of what it sees."""

from collections.abc import Callable
from importlib import import_module
from typing import Any, TypeAlias

import numpy as np
import torch
import trimesh
from torch import Tensor

from torchcal import Sensor, pixel_grid
from torchcal.demo import raycast

Localise: TypeAlias = Callable[[Tensor, Tensor | None], Tensor]
"""T_world_sensor from a range image and a starting value, if there is one."""
Prepare: TypeAlias = Callable[[trimesh.Trimesh, Sensor], Localise]
"""What may be done before there is an image, from the model's mesh in the world (m); raises
ImportError or OSError where the program is not installed."""

BLOCK = 4
"""Pixels: side of the squares of the image whose mean is one point; it lowers the noise."""
MARGIN = 0.2
"""How much wider than the image the view of the model is, on each side."""
RUNS = ((2.0, 1.0), (1.0, 0.5), (0.5, 0.2), (0.15, 0.05))
"""m: how far partners may be in each run, and c of ICP's Tukey kernel."""
DENSITY = 400.0
"""Points on a square metre of the model, for features."""
VOXEL = 0.02
"""m: side of the voxels to which GICP thins points."""
COARSE = 0.10
"""m: side of the voxels for features."""
ITERATIONS = 50
"""Most of each run."""


def image_points(image: Tensor, sensor: Sensor, block: int = BLOCK) -> np.ndarray:
    """Points of blocks of pixels that all have a range, in the sensor's frame (m)."""
    coarse = sensor.projection.resized(block)
    u, v = pixel_grid(coarse, dtype=torch.float64, device=torch.device("cpu"))
    means = torch.nn.functional.avg_pool2d(image[None], block)[0]
    points = means[..., None] * coarse.rays(u, v)
    return points[means.isfinite()].numpy()


def model_points(
    mesh: trimesh.Trimesh, sensor: Sensor, T_world_sensor: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Points (m) and normals, in the world's frame, of what is seen from a starting value."""
    margin = int(MARGIN * sensor.projection.width)
    wide = sensor.projection.widened(margin).resized(2)
    view = raycast.view([mesh], T_world_sensor)
    u, v = pixel_grid(wide, dtype=torch.float64, device=torch.device("cpu"))
    rays = wide.rays(u, v).numpy()
    ranges, face = raycast.cast(view, rays)
    met = face >= 0
    points = ranges[met][:, None] * rays[met]
    return points @ T_world_sensor[:3, :3].T + T_world_sensor[:3, 3], mesh.face_normals[face[met]]


def open3d_icp(mesh: trimesh.Trimesh, sensor: Sensor, block: int = BLOCK) -> Localise:
    """Point-to-plane ICP with a Tukey kernel, with ever nearer partners.

    Args:
        mesh: Of what is seen.
        sensor: What sees it.
        block: Side (pixels) of the squares whose mean is one point.
    """
    o3d = _open3d()

    def localise(image: Tensor, start: Tensor | None) -> Tensor:
        assert start is not None
        source = _cloud(o3d, image_points(image, sensor, block))
        return torch.from_numpy(_icp(o3d, mesh, sensor, source, start.numpy()))

    return localise


def open3d_features(mesh: trimesh.Trimesh, sensor: Sensor) -> Localise:
    """RANSAC on FPFH features of points thinned to ``COARSE``, then the same ICP; no start."""
    o3d = _open3d()
    registration = o3d.pipelines.registration
    target = _sampled(o3d, mesh)
    thin, features = _features(o3d, target.voxel_down_sample(COARSE))
    estimate = registration.TransformationEstimationPointToPoint()
    checks = [
        registration.CorrespondenceCheckerBasedOnEdgeLength(0.9),
        registration.CorrespondenceCheckerBasedOnDistance(2.0 * COARSE),
    ]
    criteria = registration.RANSACConvergenceCriteria(400_000, 0.999)

    def localise(image: Tensor, _: Tensor | None) -> Tensor:
        coarse = _cloud(o3d, image_points(image, sensor)).voxel_down_sample(COARSE)
        coarse.estimate_normals(o3d.geometry.KDTreeSearchParamHybrid(2.0 * COARSE, 30))
        coarse.orient_normals_towards_camera_location(np.zeros(3))
        coarse, own = _features(o3d, coarse)
        found = registration.registration_ransac_based_on_feature_matching(
            coarse, thin, own, features, True, 2.0 * COARSE, estimate, 3, checks, criteria
        ).transformation
        source = _cloud(o3d, image_points(image, sensor))
        return torch.from_numpy(_icp(o3d, mesh, sensor, source, np.array(found)))

    return localise


def small_gicp(mesh: trimesh.Trimesh, sensor: Sensor) -> Localise:
    """GICP of small_gicp, with ever nearer partners."""
    program: Any = import_module("small_gicp")

    def localise(image: Tensor, start: Tensor | None) -> Tensor:
        assert start is not None
        T = start.numpy()
        seen, _ = model_points(mesh, sensor, T)
        target, tree = program.preprocess_points(seen, VOXEL, num_threads=2)
        source, _ = program.preprocess_points(image_points(image, sensor), VOXEL, num_threads=2)
        for near, _ in RUNS:
            T = program.align(
                target,
                source,
                tree,
                init_T_target_source=T,
                registration_type="GICP",
                max_correspondence_distance=near,
                num_threads=2,
                max_iterations=ITERATIONS,
            ).T_target_source
        return torch.from_numpy(np.array(T))

    return localise


def _open3d() -> Any:
    """Open3D, silent: it warns of every image with few features."""
    o3d: Any = import_module("open3d")
    o3d.utility.set_verbosity_level(o3d.utility.VerbosityLevel.Error)
    return o3d


def _icp(o3d: Any, mesh: trimesh.Trimesh, sensor: Sensor, source: Any, T: np.ndarray) -> np.ndarray:
    points, normals = model_points(mesh, sensor, T)
    target = _cloud(o3d, points)
    target.normals = o3d.utility.Vector3dVector(normals)
    registration = o3d.pipelines.registration
    criteria = registration.ICPConvergenceCriteria(max_iteration=ITERATIONS)
    for near, cutoff in RUNS:
        kernel = registration.TukeyLoss(k=cutoff)
        estimate = registration.TransformationEstimationPointToPlane(kernel)
        T = registration.registration_icp(
            source, target, near, T, estimate, criteria
        ).transformation
    return np.array(T)


def _features(o3d: Any, cloud: Any) -> tuple[Any, Any]:
    around = o3d.geometry.KDTreeSearchParamHybrid(5.0 * COARSE, 100)
    return cloud, o3d.pipelines.registration.compute_fpfh_feature(cloud, around)


def _sampled(o3d: Any, mesh: trimesh.Trimesh) -> Any:
    drawn: Any = trimesh.sample.sample_surface(mesh, int(DENSITY * mesh.area), seed=0)
    points, faces = drawn
    cloud = _cloud(o3d, points)
    cloud.normals = o3d.utility.Vector3dVector(mesh.face_normals[faces])
    return cloud


def _cloud(o3d: Any, points: np.ndarray) -> Any:
    return o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
