"""How well pairs of elements agree with a starting value and its covariance.

Residuals are those of the measurement equation (7) at the starting value; their covariance is
H P H^T and that of the measurement (eq. 4).
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchcal.geometry import se3
from torchcal.geometry.alignment import orthonormal_axes
from torchcal.match.features import Lines, Planes, Vertices
from torchcal.match.wholes import whole_lengths


@dataclass(frozen=True, kw_only=True, slots=True)
class Prior:
    """A starting value of the sensor's pose."""

    T_world_sensor: Float[Tensor, "4 4"]
    covariance: Float[Tensor, "6 6"]
    """Of a twist (m, rad) on the right of the pose."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Match:
    """How far apart the elements of pairs are."""

    distance: Float[Tensor, "*pair"]
    """In standard deviations."""
    log_likelihood: Float[Tensor, "*pair"]


def match_planes(
    model: Planes, measured: Planes, prior: Prior, own: Int[Tensor, " pair"], other: Tensor
) -> Match:
    """By normal, offset and whether the measured plane's point lies on the model's outline.

    Args:
        model: In the world's frame.
        measured: In the sensor's frame.
        prior: The starting value.
        own: The model's element of each pair.
        other: The measured element of each pair.
    """
    T = se3.inverse(prior.T_world_sensor)
    centre = se3.transform(T, model.elements.point)[own]
    normal = (model.elements.direction @ T[:3, :3].mT)[own]
    q, e = measured.elements.point[other], measured.elements.direction
    axes = orthonormal_axes(e)
    noise = _projected(measured.elements.covariance, axes[:, 2:], axes[:, :2])[other]
    axes, cosine = axes[other], (normal * e[other]).sum(-1)
    foot = q - normal * (normal * (q - centre)).sum(-1, keepdim=True)
    rows = torch.cat([_moves(axes[:, 2:], foot), _turns(axes[:, :2], normal)], 1)
    errors = [_along(axes[:, 2:], foot - q), _turned(axes[:, :2], normal, cosine)]
    outside = _outside(foot - centre, _radii(model)[own], foot, prior)
    return _match(rows, torch.cat(errors, 1), noise, prior, outside)


def match_lines(
    model: Lines, measured: Lines, prior: Prior, own: Int[Tensor, " pair"], other: Tensor
) -> Match:
    """By direction, offset across, and whether the measured line's point lies on the model's.

    Args:
        model: In the world's frame.
        measured: In the sensor's frame.
        prior: The starting value.
        own: The model's element of each pair.
        other: The measured element of each pair.
    """
    T = se3.inverse(prior.T_world_sensor)
    centre = se3.transform(T, model.elements.point)[own]
    along = (model.elements.direction @ T[:3, :3].mT)[own]
    q, e = measured.elements.point[other], measured.elements.direction
    axes = orthonormal_axes(e)
    noise = _projected(measured.elements.covariance, axes[:, :2], axes[:, :2])[other]
    axes, cosine = axes[other, :2], (along * e[other]).sum(-1)
    foot = centre + along * (along * (q - centre)).sum(-1, keepdim=True)
    along = torch.where(cosine[:, None] < 0.0, -along, along)
    rows = torch.cat([_moves(axes, foot), _turns(axes, along)], 1)
    errors = [_along(axes, foot - q), _turned(axes, along, cosine.abs())]
    reach = (whole_lengths(model) - 0.5 * model.length)[own]
    outside = _outside(foot - centre, reach, foot, prior)
    return _match(rows, torch.cat(errors, 1), noise, prior, outside)


def match_points(
    model: Vertices, measured: Vertices, prior: Prior, own: Int[Tensor, " pair"], other: Tensor
) -> Match:
    """By position.

    Args:
        model: In the world's frame.
        measured: In the sensor's frame.
        prior: The starting value.
        own: The model's element of each pair.
        other: The measured element of each pair.
    """
    T = se3.inverse(prior.T_world_sensor)
    point = se3.transform(T, model.elements.point)[own]
    axes = torch.eye(3).to(point).expand(len(point), 3, 3)
    errors = point - measured.elements.point[other]
    noise = measured.elements.covariance[other, :3, :3]
    return _match(_moves(axes, point), errors, noise, prior, torch.zeros_like(errors[:, 0]))


def _moves(axes: Tensor, point: Tensor) -> Tensor:
    """Derivatives of points, along axes, to the twist: the point moves by -rho - phi x p."""
    lever = _cross(axes, point)
    return torch.cat([-axes.expand_as(lever), lever], -1)


def _turns(axes: Tensor, direction: Tensor) -> Tensor:
    """Derivatives of directions, along axes, to the twist: they turn by -phi x d."""
    turn = _cross(axes, direction)
    return torch.cat([torch.zeros_like(turn), turn], -1)


def _cross(axes: Tensor, vector: Tensor) -> Tensor:
    """The cross product of each of several axes with the vector of each pair."""
    return torch.linalg.cross(*torch.broadcast_tensors(axes, vector[..., None, :]))


def _along(axes: Tensor, vector: Tensor) -> Tensor:
    return (axes * vector[..., None, :]).sum(-1)


def _turned(axes: Tensor, direction: Tensor, cosine: Tensor) -> Tensor:
    """The angle between directions, along the axes across: a sine does not tell 0 from pi."""
    parts = _along(axes, direction)
    sine = parts.norm(dim=-1, keepdim=True)
    # Opposite directions are half a turn apart about any axis.
    towards = torch.where(sine > 1e-9, parts / sine, parts.new_tensor([1.0, 0.0]))
    return towards * torch.atan2(sine, cosine[:, None])


def _projected(covariance: Tensor, position: Tensor, direction: Tensor) -> Tensor:
    """Of the components that count of each measured element."""
    places, turns = position.shape[-2], direction.shape[-2]
    project = position.new_zeros(len(position), places + turns, 6)
    project[:, :places, :3] = position
    project[:, places:, 3:] = direction
    return project @ covariance @ project.mT


def _outside(offset: Tensor, reach: Tensor, point: Tensor, prior: Prior) -> Tensor:
    """By how many standard deviations of the prior points are farther off than an element goes."""
    distance = offset.norm(dim=-1)
    axis = offset / distance.clamp(min=1e-12)[..., None]
    row = torch.cat([-axis, torch.linalg.cross(axis, point.expand_as(axis))], -1)
    sigma = ((row @ prior.covariance) * row).sum(-1).clamp(min=1e-30).sqrt()
    return (distance - reach).clamp(min=0.0) / sigma


def _match(rows: Tensor, errors: Tensor, own: Tensor, prior: Prior, outside: Tensor) -> Match:
    covariance = rows @ prior.covariance @ rows.mT + own
    squared, log_determinant = _squared_distance(covariance, errors)
    squared = squared + outside.square()
    return Match(
        distance=squared.sqrt(),
        log_likelihood=-0.5 * (squared + log_determinant),
    )


def _squared_distance(covariance: Tensor, error: Tensor) -> tuple[Tensor, Tensor]:
    """e^T S^-1 e and log det S by elimination: for many 3x3 and 4x4 it is faster than LAPACK."""
    S, e = covariance, error
    squared = log_determinant = torch.zeros_like(error[..., 0])
    for _ in range(error.shape[-1]):
        pivot = S[..., 0, 0]
        squared = squared + e[..., 0].square() / pivot
        log_determinant = log_determinant + pivot.log()
        factor = S[..., 1:, 0] / pivot[..., None]
        e = e[..., 1:] - factor * e[..., :1]
        S = S[..., 1:, 1:] - factor[..., :, None] * S[..., None, 0, 1:]
    return squared, log_determinant


def _radii(planes: Planes) -> Tensor:
    """How far (m) the farthest corner of each plane is from its point."""
    sizes = [len(corners) for corners in planes.outline]
    if not sizes:
        return planes.area
    of = torch.repeat_interleave(torch.tensor(sizes)).to(planes.area.device)
    distance = (torch.cat(planes.outline) - planes.elements.point[of]).norm(dim=-1)
    return torch.zeros_like(planes.area).scatter_reduce(0, of, distance, "amax")
