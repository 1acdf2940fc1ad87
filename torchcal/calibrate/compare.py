"""Measured against predicted, pixel by pixel (section 2.3 and 2.4, eq. 1, 4 and 5)."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchcal.calibrate.parameters import Parameters
from torchcal.calibrate.range_fit import FILLED
from torchcal.calibrate.result import FrameComparison, PixelClass
from torchcal.geometry import gaussian, robust
from torchcal.geometry.projection import pixel_grid
from torchcal.model.job import Frame, Job
from torchcal.model.scene import Scene
from torchcal.model.sensor import Sensor
from torchcal.render.facets import Facets
from torchcal.render.synthesis import Synthesis, place_vertices, synthesise


@dataclass(frozen=True, kw_only=True, slots=True)
class Belief:
    """Where everything is believed to be and how sure that is."""

    state: Float[Tensor, "2 4 4"]
    covariance: Float[Tensor, "parameter parameter"]
    """P of eq. 3."""
    drift_sigma: float
    """The slowly varying range error (m)."""
    drift_pixels: float
    """Its correlation length (pixels); 0 without one."""
    sigma_scale: float = 1.0
    """How much larger the residuals are than the sensor's sigma says."""


def compare(
    job: Job, scene: Scene, parameters: Parameters, belief: Belief
) -> tuple[FrameComparison, ...]:
    """Compares every frame with the prediction by eq. 5."""
    dtype = torch.float32
    poses = parameters.bodies_in_sensor(belief.state).to(dtype)
    motions = parameters.motion(belief.state).to(dtype)
    return tuple(
        _compare_frame(job, scene, frame, poses[k], motions[k], belief)
        for k, frame in enumerate(job.frames)
    )


def residual_scale(comparisons: tuple[FrameComparison, ...]) -> float:
    """Robust standard deviation of measured minus predicted in units of sigma', at least 1."""
    d = [difference(c)[c.usable & c.measured.isfinite()] for c in comparisons]
    v = torch.cat(d)
    return max(1.0, robust.robust_scale(v[v.isfinite()]))


def difference(comparison: FrameComparison) -> Float[Tensor, "h w"]:
    """(measured - predicted) / sigma'; NaN where one of them is missing."""
    return (comparison.measured - comparison.predicted) / comparison.sigma


def _compare_frame(
    job: Job, scene: Scene, frame: Frame, poses: Tensor, motion: Tensor, belief: Belief
) -> FrameComparison:
    synthesis = synthesise(scene.surface, poses, job.sensor, motion)
    assert synthesis.jacobian is not None, "a motion was given"
    modelled = (synthesis.coverage > FILLED) & synthesis.range.isfinite()
    predicted = torch.where(modelled, synthesis.range, torch.nan)
    noise = job.sensor.noise.sigma(predicted) * belief.sigma_scale
    noise = torch.hypot(noise, torch.full_like(noise, belief.drift_sigma))
    P = belief.covariance.to(synthesis.jacobian)
    sigma = gaussian.predicted_sigma(synthesis.jacobian, P, noise)
    measured = frame.image.range.to(predicted)
    label = classify(measured, predicted, sigma, frame.image.usable, job.alpha)
    colour, normal, body = _appearance(scene, poses, synthesis, job.sensor)
    return FrameComparison(
        name=frame.image.name,
        measured=measured,
        predicted=predicted,
        sigma=sigma,
        label=label,
        body=body,
        colour=colour,
        normal=normal,
        usable=frame.image.usable,
    )


def classify(
    measured: Float[Tensor, "h w"],
    predicted: Float[Tensor, "h w"],
    sigma: Float[Tensor, "h w"],
    usable: Tensor,
    alpha: float,
) -> Int[Tensor, "h w"]:
    """One ``PixelClass`` per pixel by eq. 5: |measured - predicted| > alpha sigma'."""
    is_measured, is_modelled = measured.isfinite(), predicted.isfinite()
    d = (measured - predicted) / sigma
    label = torch.full_like(measured, PixelClass.NOT_COMPARED, dtype=torch.int64)
    label = label.masked_fill(is_measured & is_modelled, PixelClass.AGREES)
    label = label.masked_fill(d < -alpha, PixelClass.NEARER)
    label = label.masked_fill(d > alpha, PixelClass.FARTHER)
    label = label.masked_fill(~is_measured & is_modelled, PixelClass.MISSING)
    label = label.masked_fill(is_measured & ~is_modelled, PixelClass.UNMODELLED)
    return label.masked_fill(~usable, PixelClass.NOT_COMPARED)


def _appearance(
    scene: Scene, poses: Tensor, synthesis: Synthesis, sensor: Sensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Colour, normal towards the sensor, and body of what every pixel's centre shows."""
    surface, face = scene.surface, synthesis.face
    met, index = (face >= 0)[..., None], face.clamp(min=0)
    facets = Facets.of(place_vertices(surface, poses), surface.faces)
    normal = torch.nn.functional.normalize(facets.normal[index], dim=-1)
    rays = sensor.projection.rays(
        *pixel_grid(sensor.projection, dtype=normal.dtype, device=normal.device)
    )
    normal = torch.where((normal * rays).sum(-1, keepdim=True) > 0, -normal, normal)
    colour = surface.face_colour[index].to(normal)
    body = surface.vertex_body[surface.faces[index, 0]]
    return (
        torch.where(met, colour, 0.0),
        torch.where(met, normal, 0.0),
        torch.where(face >= 0, body, -1),
    )
