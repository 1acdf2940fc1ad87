"""How well pairs of elements agree with what is known of the pose beforehand.

Residuals are those of the measurement equation (7) at the expected pose; their covariance is
A P A^T and that of the measurement (eq. 4).
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchcal.geometry import se3
from torchcal.match.elements import Elements, Kind
from torchcal.match.features import Features, Planes
from torchcal.match.pairs import Pairs
from torchcal.match.residuals import PairResiduals, Whitening
from torchcal.match.wholes import whole_lengths

BORDER = 0.05
"""m: how far off an image may show the middle of what it sees of an element."""

TURNED = 0.5
"""Cosine between directions under which a pair is out of the question."""


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


@dataclass(frozen=True, kw_only=True, slots=True)
class Innovation:
    """What pairs say at expected poses: residuals, and how likely they are."""

    residual: Float[Tensor, "pose pair component"]
    """v of eq. 15, in standard deviations of the measurement."""
    jacobian: Float[Tensor, "pose pair component 6"]
    """A of eq. 13 for a twist on the right of T_sensor_world, in the same units."""
    match: Match


@dataclass(frozen=True, kw_only=True, slots=True)
class Expectation:
    """Elements of a model and of an image, to be compared at any pose."""

    model: Elements
    measured: Elements
    whitening: Whitening
    reach: Float[Tensor, " model"]
    """How far (m) each element of the model goes from its point."""

    @staticmethod
    def of(model: Features, measured: Features) -> "Expectation":
        """With planes first, then lines, then vertexes."""
        others = _listed(measured)
        corners = torch.zeros_like(model.vertices.elements.point[:, 0])
        along = whole_lengths(model.lines) - 0.5 * model.lines.length
        return Expectation(
            model=_listed(model),
            measured=others,
            whitening=Whitening.of(others),
            reach=torch.cat([_radii(model.planes), along, corners]),
        )

    def at(
        self,
        T_sensor_world: Float[Tensor, "pose 4 4"],
        covariance: Float[Tensor, "pose 6 6"],
        own: Int[Tensor, " pair"],
        other: Int[Tensor, " pair"],
    ) -> Innovation:
        """By the residuals, and by whether the measured one's point is where the model's ends.

        Args:
            T_sensor_world: The expected poses.
            covariance: Of twists (m, rad) on the right of them.
            own: The model's element of each pair.
            other: The measured element of each pair, of the same kind.
        """
        one = own.new_zeros(1)
        valid = torch.ones_like(own, dtype=torch.bool)[None]
        pairs = Pairs(model=own[None], measured=other[None], valid=valid)
        residuals = PairResiduals.of(self.model, self.measured, self.whitening, one, pairs)
        v, A = residuals.linearise(T_sensor_world, one.expand(len(T_sensor_world)))
        P = covariance[:, None]
        S = A @ P @ A.mT + torch.eye(v.shape[-1]).to(v)
        squared, log_determinant = _squared_distance(S, v)
        squared = squared + self._outside(T_sensor_world, P, own, other).square()
        noise = self.whitening.root.diagonal(dim1=-2, dim2=-1)[0, other]
        present = self.whitening.present[0, other]
        scale = torch.where(present, noise, 1.0).log().sum(-1)
        scale = scale - 0.5 * math.log(2.0 * math.pi) * present.sum(-1)
        return Innovation(
            residual=v,
            jacobian=A,
            match=Match(
                distance=torch.where(
                    self._are_turned(T_sensor_world, own, other), torch.inf, squared.sqrt()
                ),
                log_likelihood=scale - 0.5 * (squared + log_determinant),
            ),
        )

    def _are_turned(self, T: Tensor, own: Tensor, other: Tensor) -> Tensor:
        """Whether the directions are so far apart that linear equations tell nothing."""
        cosine = (
            (self.model.direction[0, own] @ T[:, :3, :3].mT) * self.measured.direction[0, other]
        ).sum(-1)
        kind = self.model.kind[0, own]
        cosine = torch.where(kind == Kind.LINE, cosine.abs(), cosine)
        return (cosine < TURNED) & (kind != Kind.POINT)

    def _outside(self, T: Tensor, covariance: Tensor, own: Tensor, other: Tensor) -> Tensor:
        """By how many standard deviations measured points are farther off than an element goes."""
        kind, middle, d = (
            values[0, own] for values in (self.model.kind, self.model.point, self.model.direction)
        )
        place = se3.transform(se3.inverse(T), self.measured.point[0, other])
        along = d * (d * (place - middle)).sum(-1, keepdim=True)
        offset = torch.where((kind == Kind.PLANE)[:, None], place - middle - along, along)
        distance = offset.norm(dim=-1)
        axis = offset / distance.clamp(min=1e-12)[..., None]
        row = torch.cat([axis, torch.linalg.cross(place, axis)], -1)[..., None, :]
        variance = (row @ covariance @ row.mT)[..., 0, 0] + BORDER**2
        return (distance - self.reach[own]).clamp(min=0.0) * variance.rsqrt()


def moved_to_sensor(prior: Prior) -> tuple[Float[Tensor, "4 4"], Float[Tensor, "6 6"]]:
    """T_sensor_world and the covariance of a twist on its right."""
    moved = se3.adjoint(prior.T_world_sensor)
    return se3.inverse(prior.T_world_sensor), moved @ prior.covariance @ moved.mT


def _listed(features: Features) -> Elements:
    parts = features.planes, features.lines, features.vertices
    return Elements.join(*(part.elements for part in parts)).expand(1)


def _radii(planes: Planes) -> Tensor:
    """How far (m) the farthest corner of each plane is from its point."""
    sizes = [len(corners) for corners in planes.outline]
    if not sizes:
        return planes.area
    of = torch.repeat_interleave(torch.tensor(sizes)).to(planes.area.device)
    distance = (torch.cat(planes.outline) - planes.elements.point[of]).norm(dim=-1)
    return torch.zeros_like(planes.area).scatter_reduce(0, of, distance, "amax")


def _squared_distance(covariance: Tensor, error: Tensor) -> tuple[Tensor, Tensor]:
    """e^T S^-1 e and log det S by elimination: for many small matrices faster than LAPACK."""
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
