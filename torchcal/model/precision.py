"""Jobs in double precision: the digits that estimates need, whatever their tensors have."""

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from torchcal.model.job import Frame, Job, PosePrior
from torchcal.model.world import World


def job_in_double(job: Job) -> Job:
    """The same job with all its poses, ranges, joints and sigmas in double precision."""
    return replace(
        job,
        world=None if job.world is None else _world(job.world),
        T_world_base=job.T_world_base.double(),
        T_link_sensor=job.T_link_sensor.double(),
        frames=tuple(frame_in_double(frame) for frame in job.frames),
        base=_prior(job.base),
        mount=_prior(job.mount),
        objects={name: PosePrior(sigma=each.sigma.double()) for name, each in job.objects.items()},
        frame_poses=_prior(job.frame_poses),
    )


def frame_in_double(frame: Frame) -> Frame:
    """The same frame with its ranges, joints and pose in double precision."""
    return replace(
        frame,
        image=replace(frame.image, range=frame.image.range.double()),
        joints=_double(frame.joints),
        T_world_sensor=_double(frame.T_world_sensor),
    )


def _world(world: World) -> World:
    objects = (replace(o, T_world_object=o.T_world_object.double()) for o in world.objects)
    return replace(world, objects=tuple(objects))


def _prior(prior: PosePrior | None) -> PosePrior | None:
    return None if prior is None else PosePrior(sigma=prior.sigma.double())


def _double(values: Float[Tensor, "*shape"] | None) -> Float[Tensor, "*shape"] | None:
    return None if values is None else values.to(torch.float64)
