"""Where the camera is on the flange, roughly and in closed form, from one axis in all views."""

import numpy as np
from scipy.spatial.transform import Rotation

STARTS = 64
ROUNDS = 200


def mount_and_axis(
    Ts_base_flange: np.ndarray,
    centres: np.ndarray,
    axes: np.ndarray,
    rng: np.random.Generator,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The mount that makes the axes of all views one line in the base.

    Args:
        Ts_base_flange: (view 4 4).
        centres: (view 3), a point of the axis in the camera's frame (m).
        axes: (view 3), its direction there, in all views towards the same end.
        rng: Draws the first rotations.

    Returns:
        T_flange_camera; in the base the line's middle (m) and its direction.
    """
    turns = Ts_base_flange[:, :3, :3]
    tries = [
        _turned(turns, axes, start)
        for start in Rotation.from_quat(rng.standard_normal((STARTS, 4)))
    ]
    mount, axis, _ = max(tries, key=lambda each: each[2])
    across = np.linalg.svd(axis[None])[2][1:]
    seen = centres @ mount.as_matrix().T
    # R (X c + t) + p lies on the line through q: linear in t and in q across the axis.
    matrix = np.concatenate([np.concatenate([across @ R, -np.eye(2)], 1) for R in turns])
    placed = np.einsum("kij,kj->ki", turns, seen) + Ts_base_flange[:, :3, 3]
    found = np.linalg.lstsq(matrix, -(placed @ across.T).ravel(), rcond=None)[0]
    T_flange_camera = np.eye(4)
    T_flange_camera[:3, :3], T_flange_camera[:3, 3] = mount.as_matrix(), found[:3]
    along = np.median((placed + turns @ found[:3]) @ axis)
    return T_flange_camera, found[3:] @ across + along * axis, axis


def _turned(
    turns: np.ndarray, axes: np.ndarray, start: Rotation
) -> tuple[Rotation, np.ndarray, float]:
    """The rotation of the mount, the axis in the base and how well the views agree."""
    mount, axis = start, _mean_axis(turns, start, axes)
    for _ in range(ROUNDS):
        mount = Rotation.align_vectors(axis @ turns, axes)[0]
        axis = _mean_axis(turns, mount, axes)
    agreement = float((np.einsum("kij,kj->ki", turns, mount.apply(axes)) @ axis).sum())
    return mount, axis, agreement


def _mean_axis(turns: np.ndarray, mount: Rotation, axes: np.ndarray) -> np.ndarray:
    axis = np.einsum("kij,kj->i", turns, mount.apply(axes))
    return axis / np.linalg.norm(axis)


def rounded(T: np.ndarray, *, metres: float, degrees: float) -> tuple[np.ndarray, np.ndarray]:
    """Xyz (m) and roll, pitch, yaw (degrees) as a person would measure them."""
    yaw, pitch, roll = Rotation.from_matrix(T[:3, :3]).as_euler("ZYX", degrees=True)
    turn = degrees * np.round(np.array([roll, pitch, yaw]) / degrees)
    return metres * np.round(T[:3, 3] / metres), turn


def along_z(middle: np.ndarray, axis: np.ndarray) -> np.ndarray:
    """A pose whose z axis is the line."""
    T = np.eye(4)
    across = np.linalg.svd(axis[None])[2][1]
    T[:3, 0], T[:3, 2], T[:3, 3] = across, axis, middle
    T[:3, 1] = np.cross(axis, across)
    return T
