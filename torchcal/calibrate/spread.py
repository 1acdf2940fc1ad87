"""What eq. 4 says where P is wide: a tangent does not know what is behind an edge.

H of eq. 4 is right while the uncertain parameters move the image by less than the beam. Where they
move it farther, the model is predicted for states drawn from P, and what the measured range may
differ by is taken from them: near an edge it is the step to the other surface.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn import functional

from torchcal.calibrate.observation import Observation, coarser, coarser_sensor
from torchcal.geometry import se3
from torchcal.geometry.projection import pixel_grid
from torchcal.model.scene import Surface
from torchcal.model.sensor import Sensor
from torchcal.render.synthesis import synthesise

WIDE = 0.5
"""Of the beam: an image that moves by less is predicted well enough by its derivative."""
PAIRS = 16
"""States that are drawn, each with its mirror image."""
SIDE = 128
"""Pixels along the shorter side of the images in which drawn states are predicted: their edges are
pixels apart."""
STEP = 2.0
"""Of sigma' by the tangent."""
EVERY = 8
"""Of the pixels' rows and columns, one in so many tells how far the image moves."""


def drawn_steps(
    covariance: Float[Tensor, "parameter parameter"],
) -> Float[Tensor, "draw parameter"]:
    """Steps of the parameters that are spread as P says, always the same ones."""
    even = torch.quasirandom.SobolEngine(len(covariance), scramble=True, seed=0).draw(PAIRS)
    steps = torch.special.ndtri(even.double().clamp(1e-3, 1.0 - 1e-3)).to(covariance)
    value, vector = torch.linalg.eigh(covariance)
    steps = steps @ (vector * value.clamp(min=0.0).sqrt()).mT
    return torch.cat([steps, -steps])


def moves_far(
    ranges: Float[Tensor, "h w"],
    body: Int[Tensor, "h w"],
    motion: Float[Tensor, "body 6 active"],
    covariance: Float[Tensor, "active active"],
    sensor: Sensor,
) -> bool:
    """Whether P moves a predicted image (m) by much of the beam, in the median of its pixels.

    Args:
        ranges: As predicted; NaN where the model is empty.
        body: What is seen there.
        motion: As for ``synthesise``.
        covariance: P of the parameters that move something.
        sensor: Its optics and beam.
    """
    part = (slice(EVERY // 2, None, EVERY),) * 2
    grid = pixel_grid(sensor.projection, dtype=ranges.dtype, device=ranges.device)
    rays, ahead = (sensor.projection.rays(u, grid[1])[part] for u in (grid[0], grid[0] + 1.0))
    seen = ranges[part].isfinite() & (body[part] >= 0)
    p = (ranges[part][..., None] * rays)[seen]
    twist = motion[body[part][seen]]
    moved = twist[:, :3] - se3.hat(p) @ twist[:, 3:]
    spread = moved @ covariance.to(moved) @ moved.mT
    along = functional.normalize(p, dim=-1)
    total = spread.diagonal(dim1=-2, dim2=-1).sum(-1)
    across = total - (along[:, None] @ spread @ along[..., None])[:, 0, 0]
    width = ((ahead - rays)[seen] * ranges[part][seen][:, None]).norm(dim=-1)
    pixels = (0.5 * across.clamp(min=0.0)).sqrt() / width
    return bool(len(pixels) and pixels.median() > WIDE * max(sensor.beam, 1))


@dataclass(frozen=True, kw_only=True, slots=True)
class Drawn:
    """One frame as it would be predicted for states drawn from P, at a low resolution."""

    sensor: Sensor
    """At full resolution."""
    factor: int
    """Pixels of the image for one of these."""
    range: Float[Tensor, "draw h w"]
    """m; NaN where the model is empty."""

    @staticmethod
    def of(surface: Surface, poses: Float[Tensor, "draw body 4 4"], sensor: Sensor) -> "Drawn":
        """Predicts the frame for the bodies' poses in its sensor."""
        factor = max(1, min(sensor.projection.width, sensor.projection.height) // SIDE)
        images = synthesise(surface, poses.float(), coarser_sensor(sensor, factor))
        return Drawn(sensor=sensor, factor=factor, range=images.range)

    def beyond_tangent(
        self,
        ranges: Float[Tensor, "h w"],
        jacobian: Float[Tensor, "h w active"],
        steps: Float[Tensor, "draw active"],
        sigma: Float[Tensor, "h w"],
    ) -> Float[Tensor, "h w"]:
        """Root mean square of what the tangent of a predicted image does not foresee (m).

        Less than ``STEP`` of ``sigma``, the bend of a face, is no step to another one.
        """
        middle = coarser(_as_measured(ranges, self.sensor), self.factor)
        slopes = functional.avg_pool2d(jacobian.movedim(-1, 0)[None], self.factor)[0]
        foreseen = middle.range + torch.einsum("dp,phw->dhw", steps.to(slopes), slopes)
        known = self.range.isfinite() & middle.measured
        beyond = torch.where(known, self.range - foreseen, 0.0)
        forgiven = STEP * functional.avg_pool2d(sigma.nan_to_num(0.0)[None, None], self.factor)[0]
        square = torch.where(beyond.abs() > forgiven, beyond, 0.0).square().sum(0)
        mean = square / known.sum(0).clamp(min=1)
        fine = functional.interpolate(mean[None, None], ranges.shape, mode="bilinear")
        return fine[0, 0].sqrt()


def _as_measured(ranges: Tensor, sensor: Sensor) -> Observation:
    met = ranges.isfinite()
    return Observation(
        sensor=sensor,
        range=torch.where(met, ranges, 0.0)[None],
        measured=met[None],
        sigma=torch.ones_like(ranges)[None],
    )
