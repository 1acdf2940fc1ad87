"""Rigid motions in SE(3) as 4x4 matrices, any leading batch.

``T_a_b`` maps coordinates, ``p_a = T_a_b @ p_b``. A twist is (translation, rotation) in metres and
radians and acts on the right, ``T @ exp(xi)``; covariances of poses are of that twist.
"""

import torch
from jaxtyping import Float
from kornia.geometry.conversions import (
    quaternion_to_axis_angle,
    quaternion_to_rotation_matrix,
    rotation_matrix_to_quaternion,
)
from torch import Tensor


def hat(w: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3 3"]:
    """The matrix of the cross product, ``hat(w) @ p = w x p``."""
    zero = torch.zeros_like(w[..., 0])
    x, y, z = w.unbind(-1)
    return torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).unflatten(-1, (3, 3))


def exp(xi: Float[Tensor, "*batch 6"]) -> Float[Tensor, "*batch 4 4"]:
    """The motion of a twist (m, rad)."""
    rho, w = xi[..., :3, None], xi[..., 3:]
    a, b, c = _rotation_series(w.square().sum(-1)[..., None, None])
    W = hat(w)
    W_squared = W @ W
    eye = torch.eye(3, dtype=xi.dtype, device=xi.device)
    V_rho = rho + b * (W @ rho) + c * (W_squared @ rho)
    return from_rotation_translation(eye + a * W + b * W_squared, V_rho[..., 0])


def _rotation_series(squared: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """sin(x)/x, (1 - cos(x))/x^2 and (x - sin(x))/x^3, of x^2 and smooth at 0."""
    small = squared < 1e-2  # the series' next terms are below 1e-16 there
    x = torch.where(small, torch.ones_like(squared), squared).sqrt()
    sine, versine = torch.sin(x), 2.0 * torch.sin(0.5 * x).square()

    def series(first: float, step: int) -> Tensor:
        term = total = torch.full_like(squared, first)
        for k in range(step, step + 10, 2):
            term = -term * squared / (k * (k + 1))
            total = total + term
        return total

    return (
        torch.where(small, series(1.0, 2), sine / x),
        torch.where(small, series(1 / 2, 3), versine / x.square()),
        torch.where(small, series(1 / 6, 4), (x - sine) / x**3),
    )


def log(T: Float[Tensor, "*batch 4 4"]) -> Float[Tensor, "*batch 6"]:
    """The twist of a motion, with a rotation of at most pi: ``exp(log(T)) = T``."""
    w = rotation_log(T[..., :3, :3])
    angle = w.norm(dim=-1)[..., None, None]
    half = 0.5 * angle
    small = angle < 1e-3  # below it the series is exact to 1e-13
    safe = torch.where(small, torch.ones_like(half), half)
    closed = (1.0 - safe / torch.tan(safe)) / (4.0 * safe.square())
    coefficient = torch.where(small, 1.0 / 12.0 + angle.square() / 720.0, closed)
    W = hat(w)
    eye = torch.eye(3, dtype=T.dtype, device=T.device)
    rho = (eye - 0.5 * W + coefficient * (W @ W)) @ T[..., :3, 3:]
    return torch.cat([rho[..., 0], w], -1)


def rotation_log(R: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 3"]:
    """The rotation vector (rad) of a rotation matrix, of length at most pi."""
    quaternion = rotation_matrix_to_quaternion(R.contiguous())
    return quaternion_to_axis_angle(torch.where(quaternion[..., :1] < 0, -quaternion, quaternion))


def inverse(T: Float[Tensor, "*batch 4 4"]) -> Float[Tensor, "*batch 4 4"]:
    """``T_b_a`` of ``T_a_b``."""
    R_t = T[..., :3, :3].mT
    return from_rotation_translation(R_t, -(R_t @ T[..., :3, 3:])[..., 0])


def adjoint(T: Float[Tensor, "*batch 4 4"]) -> Float[Tensor, "*batch 6 6"]:
    """Moves a twist to another frame: ``T_a_b @ exp(xi) = exp(adjoint(T_a_b) @ xi) @ T_a_b``."""
    R, t = T[..., :3, :3], T[..., :3, 3]
    top = torch.cat([R, hat(t) @ R], -1)
    bottom = torch.cat([torch.zeros_like(R), R], -1)
    return torch.cat([top, bottom], -2)


def from_rotation_translation(
    R: Float[Tensor, "*batch 3 3"], t: Float[Tensor, "*batch 3"]
) -> Float[Tensor, "*batch 4 4"]:
    """The 4x4 matrix of a rotation and a translation (m)."""
    top = torch.cat([R, t[..., None]], -1)
    bottom = torch.zeros_like(top[..., :1, :])
    bottom[..., 3] = 1.0
    return torch.cat([top, bottom], -2)


def random_rotations(count: int, *, generator: torch.Generator) -> Float[Tensor, "count 3 3"]:
    """Uniformly distributed rotation matrices, in float64 on the CPU."""
    quaternion = torch.randn(count, 4, dtype=torch.float64, generator=generator)
    return quaternion_to_rotation_matrix(torch.nn.functional.normalize(quaternion, dim=-1))


def from_xyz_rpy(
    xyz: Float[Tensor, "*batch 3"], rpy: Float[Tensor, "*batch 3"]
) -> Float[Tensor, "*batch 4 4"]:
    """A pose from metres and roll, pitch, yaw (rad) as in URDF: R = Rz(yaw) Ry(pitch) Rx(roll)."""
    axes = torch.eye(3, dtype=rpy.dtype, device=rpy.device)
    roll, pitch, yaw = (
        torch.linalg.matrix_exp(hat(rpy[..., i : i + 1] * axes[i])) for i in range(3)
    )
    return from_rotation_translation(yaw @ pitch @ roll, xyz)


def from_quaternion(
    xyz: Float[Tensor, "*batch 3"], wxyz: Float[Tensor, "*batch 4"]
) -> Float[Tensor, "*batch 4 4"]:
    """A pose from metres and a quaternion of any length but 0, its real part first."""
    unit = torch.nn.functional.normalize(wxyz, dim=-1)
    return from_rotation_translation(quaternion_to_rotation_matrix(unit), xyz)


def to_xyz_rpy(
    T: Float[Tensor, "*batch 4 4"],
) -> tuple[Float[Tensor, "*batch 3"], Float[Tensor, "*batch 3"]]:
    """The inverse of ``from_xyz_rpy``: metres and rpy (rad); roll is 0 where pitch is +-pi/2."""
    R = T[..., :3, :3]
    cos_pitch = torch.hypot(R[..., 0, 0], R[..., 1, 0])
    pitch = torch.atan2(-R[..., 2, 0], cos_pitch)
    locked = cos_pitch < 1e-9
    roll = torch.where(locked, torch.zeros_like(pitch), torch.atan2(R[..., 2, 1], R[..., 2, 2]))
    free_yaw = torch.atan2(R[..., 1, 0], R[..., 0, 0])
    yaw = torch.where(locked, torch.atan2(-R[..., 0, 1], R[..., 1, 1]), free_yaw)
    return T[..., :3, 3], torch.stack([roll, pitch, yaw], -1)


def transform(
    T_a_b: Float[Tensor, "*#batch 4 4"], p_b: Float[Tensor, "*#batch point 3"]
) -> Float[Tensor, "*#batch point 3"]:
    """Points (m) of frame b in frame a; the batches broadcast."""
    return p_b @ T_a_b[..., :3, :3].mT + T_a_b[..., None, :3, 3]
