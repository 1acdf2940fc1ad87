"""Other programs that find the pose of points from uncertain correspondences."""

from collections.abc import Callable
from importlib import import_module
from typing import Any, TypeAlias

import numpy as np
import torch
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from torch import Tensor

from torchcal.demo.brick import SIGMA, BrickTrials, brick_model

Solve: TypeAlias = Callable[[BrickTrials, int], Tensor]
"""Poses T_measured_brick of all trials, from a seed."""

NEAR = 0.1
"""How far a point may be from its partner (m)."""
CONFIDENCE = 0.999
"""At which Open3D stops before its last iteration; its default."""
STARTS = 10
"""Random rotations that SciPy starts from."""

_Pose: TypeAlias = Callable[[Any, Any, np.ndarray], np.ndarray]
"""From the clouds of the model and of one trial and from its candidates."""


def scipy_multi_start() -> Solve:
    """Nonlinear least squares over all candidate pairs with a Cauchy loss; the lowest cost wins."""
    model = brick_model().point.numpy()

    def solve(trials: BrickTrials, seed: int) -> Tensor:
        generator = np.random.default_rng(seed)
        points = trials.measured.point.numpy()
        pairs = [np.nonzero(allowed) for allowed in trials.candidates.numpy()]
        poses = [
            _lowest_cost(model[i], measured[j], measured.mean(0), generator)
            for measured, (i, j) in zip(points, pairs, strict=True)
        ]
        return torch.from_numpy(np.stack(poses))

    return solve


def _lowest_cost(
    model: np.ndarray, measured: np.ndarray, centre: np.ndarray, generator: np.random.Generator
) -> np.ndarray:
    """The best of all starts from partners, one pair a row."""

    def residuals(x: np.ndarray) -> np.ndarray:
        moved = Rotation.from_rotvec(x[3:]).apply(model) + x[:3]
        return ((moved - measured) / SIGMA).ravel()

    starts = Rotation.random(STARTS, rng=generator).as_rotvec()
    fits = [
        least_squares(residuals, np.r_[centre, start], loss="cauchy", f_scale=NEAR / SIGMA)
        for start in starts
    ]
    best = min(fits, key=lambda fit: fit.cost).x
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_rotvec(best[3:]).as_matrix(), best[:3]
    return T


def open3d_ransac(iterations: int) -> Solve:
    """RANSAC on the candidate pairs.

    Raises:
        ImportError: If Open3D is not installed.
        OSError: If a library of the system that it needs is not installed.
    """
    o3d = import_module("open3d")
    return _one_by_one(o3d, _ransac(o3d, iterations))


def open3d_ransac_icp(iterations: int) -> Solve:
    """The same, then ICP: correspondences detected again among all pairs, and a fit to them.

    Raises:
        ImportError: If Open3D is not installed.
        OSError: If a library of the system that it needs is not installed.
    """
    o3d = import_module("open3d")
    ransac = _ransac(o3d, iterations)
    icp = o3d.pipelines.registration.registration_icp

    def pose(model: Any, measured: Any, candidates: np.ndarray) -> np.ndarray:
        start = ransac(model, measured, candidates)
        return icp(model, measured, NEAR, start).transformation

    return _one_by_one(o3d, pose)


def _ransac(o3d: Any, iterations: int) -> _Pose:
    registration = o3d.pipelines.registration
    criteria = registration.RANSACConvergenceCriteria(iterations, CONFIDENCE)
    estimate = registration.TransformationEstimationPointToPoint()

    def pose(model: Any, measured: Any, candidates: np.ndarray) -> np.ndarray:
        pairs = o3d.utility.Vector2iVector(np.argwhere(candidates).astype(np.int32))
        return registration.registration_ransac_based_on_correspondence(
            model, measured, pairs, NEAR, estimate, 3, [], criteria
        ).transformation

    return pose


def _one_by_one(o3d: Any, pose: _Pose) -> Solve:
    def cloud(points: np.ndarray) -> Any:
        return o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))

    def solve(trials: BrickTrials, seed: int) -> Tensor:
        o3d.utility.random.seed(seed)
        model = cloud(brick_model().point.numpy())
        data = zip(trials.measured.point.numpy(), trials.candidates.numpy(), strict=True)
        poses = [pose(model, cloud(points), candidates) for points, candidates in data]
        return torch.from_numpy(np.stack(poses))

    return solve
