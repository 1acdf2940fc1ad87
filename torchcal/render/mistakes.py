"""What a caller of the synthesis may get wrong: cheap checks, made before anything is rendered."""

import torch
from torch import Tensor

from torchcal.errors import TorchcalError
from torchcal.model.scene import Surface
from torchcal.model.sensor import Sensor

NO_ROTATION = 1e-3
"""How far R^T R may be from the identity: products of many single-precision poses are nearer."""


def check_views(
    surface: Surface, Ts_sensor_body: Tensor, sensor: Sensor, motion: Tensor | None
) -> None:
    """Finds what cannot be rendered.

    A pose with NaN is no mistake of the caller: it empties its own view.

    Raises:
        TorchcalError: If the sensor's beam or limits, the mesh, the poses or the motion are wrong;
            it says what was found and what is expected.
    """
    _check_sensor(sensor)
    bodies = _check_surface(surface)
    _check_poses(Ts_sensor_body, bodies, surface)
    if motion is not None:
        _check_motion(motion, Ts_sensor_body)


def _check_sensor(sensor: Sensor) -> None:
    if sensor.beam < 0 or (sensor.beam > 0 and sensor.beam % 2 == 0):
        raise TorchcalError(f"found a beam of {sensor.beam} pixels; expected 0, 1 or an odd number")
    if not 0 <= sensor.near < sensor.far:
        raise TorchcalError(
            f"found limits of {sensor.near} to {sensor.far} m; expected 0 <= near < far"
        )


def _check_surface(surface: Surface) -> int:
    """Returns how many bodies it has."""
    vertices, faces, edges = surface.vertices, surface.faces, surface.edges
    if vertices.ndim != 2 or vertices.shape[1] != 3 or faces.ndim != 2 or faces.shape[1] != 3:
        raise TorchcalError(
            f"found vertices {_shape(vertices)} and faces {_shape(faces)}; "
            "expected (vertex, 3) and (face, 3)"
        )
    if not len(faces):
        raise TorchcalError("found a mesh without faces; expected at least one triangle")
    if not vertices.is_floating_point():
        raise TorchcalError(f"found vertices of {vertices.dtype}; expected a floating-point dtype")
    if not vertices.isfinite().all():
        wrong = int(torch.nonzero(~vertices.isfinite().all(-1))[0, 0])
        raise TorchcalError(f"found vertex {wrong} at {vertices[wrong].tolist()}; expected metres")
    _check_indices("a face", faces, len(vertices))
    _check_indices("an edge", edges, len(vertices))
    if surface.vertex_body.shape != vertices.shape[:1]:
        raise TorchcalError(
            f"found bodies of {_shape(surface.vertex_body)} vertices; expected ({len(vertices)},)"
        )
    return int(surface.vertex_body.max()) + 1


def _check_indices(what: str, index: Tensor, count: int) -> None:
    if not index.numel():
        return
    low, high = torch.aminmax(index)
    if low < 0 or high >= count:
        raise TorchcalError(
            f"found {what} with vertex {int(low) if low < 0 else int(high)}; "
            f"expected 0 to {count - 1}"
        )


def _check_poses(poses: Tensor, bodies: int, surface: Surface) -> None:
    if poses.ndim < 3 or poses.shape[-2:] != (4, 4) or poses.shape[-3] < bodies:
        raise TorchcalError(
            f"found poses {_shape(poses)}; expected (*batch, {bodies}, 4, 4), one for each body"
        )
    if not poses.is_floating_point() or poses.device != surface.vertices.device:
        raise TorchcalError(
            f"found poses of {poses.dtype} on {poses.device}; expected a floating-point dtype on "
            f"{surface.vertices.device}"
        )
    if not poses.numel():
        return
    T = poses.detach()
    R, last = T[..., :3, :3], T[..., 3, :]
    identity = torch.eye(4, dtype=T.dtype, device=T.device)
    skew = (R.mT @ R - identity[:3, :3]).abs().amax((-1, -2))
    mirror = torch.linalg.cross(R[..., 0], R[..., 1]).mul(R[..., 2]).sum(-1) < 0
    wrong = (skew > NO_ROTATION) | mirror | ((last - identity[3]).abs() > NO_ROTATION).any(-1)
    if wrong.any():
        found = T[wrong][0].tolist()
        raise TorchcalError(f"found a pose {found}; expected a rotation and a translation")


def _check_motion(motion: Tensor, poses: Tensor) -> None:
    expected = poses.shape[:-2]
    if motion.ndim < 3 or motion.shape[:-2] != expected or motion.shape[-2] != 6:
        raise TorchcalError(
            f"found a motion {_shape(motion)}; expected "
            f"({', '.join(map(str, expected))}, 6, parameter)"
        )
    if motion.dtype != poses.dtype or motion.device != poses.device:
        raise TorchcalError(
            f"found a motion of {motion.dtype} on {motion.device}; expected {poses.dtype} on "
            f"{poses.device}, as the poses"
        )


def _shape(tensor: Tensor) -> str:
    return str(tuple(tensor.shape))
