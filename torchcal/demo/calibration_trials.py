"""Recordings with known truth for everything that may be unknown: drawn, ray-cast, estimated.

The truth is drawn from the job's own prior, the images come from ``torchcal.demo.raycast``, so that
no estimator is tested on its own renderer.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import torch
import trimesh
from jaxtyping import Float
from torch import Tensor

from torchcal.calibrate.foresight import expected_covariance
from torchcal.calibrate.observability import LEFT
from torchcal.calibrate.observation import observe
from torchcal.calibrate.parameters import Parameters
from torchcal.calibrate.pipeline import build_job_scene
from torchcal.calibrate.result import Calibration
from torchcal.demo import raycast
from torchcal.geometry import gaussian
from torchcal.model.job import Job
from torchcal.model.sensor import Sensor


@dataclass(frozen=True, kw_only=True, slots=True)
class Trial:
    """A recording and what is true of it."""

    job: Job
    state: Float[Tensor, "slot 4 4"]
    """The true one."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Outcome:
    """One trial's estimate against its truth, in the order of ``Parameters.names``."""

    status: str
    error: Float[Tensor, " parameter"]
    """m, rad"""
    covariance: Float[Tensor, "parameter parameter"]
    """What the estimate claims."""
    least: Float[Tensor, "parameter parameter"]
    """The Cramer-Rao value of the same recording, with the prior."""
    told: Float[Tensor, "parameter direction"]
    """Directions of which the images left at most half of the prior's sigma."""

    @property
    def distance(self) -> float:
        """Squared Mahalanobis distance of the error in what the images told."""
        error, P = self.told.mT @ self.error, self.told.mT @ self.covariance @ self.told
        return float(error @ torch.linalg.solve(P, error))


def draw_trial(
    job: Job, seed: int, number: int, *, known: Mapping[str, float] | None = None
) -> Trial:
    """Draws a truth from the prior of a job and records it.

    Args:
        job: Its frames have joints or poses; their images are replaced.
        seed: Of the experiment.
        number: Of the trial, which depends on nothing else.
        known: True values (m, rad) that are not drawn, by names of ``Parameters.names``.
    """
    rng = np.random.default_rng([seed, number])
    scene = build_job_scene(job)
    parameters = Parameters.of(job, scene)
    step = torch.from_numpy(rng.standard_normal(len(parameters.names))) * parameters.prior_sigma
    for name, value in (known or {}).items():
        step[parameters.names.index(name)] = value
    state = parameters.retract(parameters.nominal, step)
    meshes = _meshes(job)
    offset, scale = parameters.range_error(state).tolist()
    frames = []
    for frame, Ts_sensor_body in zip(job.frames, parameters.bodies_in_sensor(state), strict=True):
        image = offset + (1.0 + scale) * _predicted(meshes, Ts_sensor_body, job.sensor)
        measured = torch.from_numpy(raycast.measure(image, job.sensor, rng))
        frames.append(replace(frame, image=replace(frame.image, range=measured)))
    return Trial(job=replace(job, frames=tuple(frames)), state=state)


def outcome(trial: Trial, calibration: Calibration) -> Outcome:
    """Compares what a calibration of the trial's job found with the truth."""
    job, estimate = trial.job, calibration.estimate
    scene = build_job_scene(job)
    parameters = Parameters.of(job, scene)
    return Outcome(
        status=estimate.status.value,
        error=parameters.difference(estimate.state, trial.state),
        covariance=estimate.covariance,
        least=expected_covariance(observe(job), scene, parameters, trial.state),
        told=_told(estimate.covariance, parameters.prior_sigma),
    )


def _told(P: Tensor, prior_sigma: Tensor) -> Tensor:
    ratio, direction = gaussian.left_over(P, prior_sigma)
    return direction[:, ratio <= LEFT] / prior_sigma[:, None]


def _meshes(job: Job) -> list[trimesh.Trimesh]:
    """Of all bodies, in the order of the scene."""
    objects = [] if job.world is None else [item.mesh for item in job.world.objects]
    links = {} if job.robot is None else job.robot.link_meshes
    names = () if job.robot is None else job.robot.link_names
    return [*objects, *(links[name] for name in names if name in links)]


def _predicted(
    meshes: list[trimesh.Trimesh], Ts_sensor_body: Tensor, sensor: Sensor
) -> Float[np.ndarray, "h w"]:
    placed = [
        mesh.copy().apply_transform(T.numpy())
        for mesh, T in zip(meshes, Ts_sensor_body, strict=True)
    ]
    view = raycast.view(placed, np.eye(4), near=sensor.near, far=sensor.far)
    return raycast.predict(view, sensor.projection, sensor.beam)
