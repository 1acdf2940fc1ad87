"""``initial = "anywhere"``: the nominal pose of a job from one of its own images (3.5)."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from torchcal.calibrate.observation import observe
from torchcal.calibrate.one_view import OneView, free_sensor
from torchcal.calibrate.site import Site, extent
from torchcal.calibrate.whereabouts import judged, poses_anywhere
from torchcal.errors import TorchcalError
from torchcal.geometry import se3
from torchcal.match.image.features import image_features
from torchcal.model.job import WORLD_LINK, Job, PosePrior
from torchcal.model.scene import Surface, body_poses, build_scene
from torchcal.render.synthesis import place_vertices

USABLE = 0.05
"""Share of the pixels that must be measured in a frame before it is used for the search."""
LEAST_SIDE = 16
"""Pixels along the shorter side of an image that can be searched for planes."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Located:
    """A job that was told nothing of its base, or of its sensor, and now is."""

    job: Job
    """With the best pose as the nominal one, and a prior as wide as the site."""
    Ts_world_base: Float[Tensor, "start 4 4"]
    """Starts for the estimate, the best first; without a robot, of the first frame's sensor."""


def locate(job: Job, generator: torch.Generator) -> Located:
    """Finds the base, or without a robot the sensor, all over the world in all orientations.

    The search uses the first usable frame; the others share the start. What stands still is the
    world; for a sensor that watches the robot it is the robot, in its own base. Where nothing is
    found the sensor is taken to be in the middle, for the fits to find it wrong.

    Args:
        job: Its nominal pose of base or sensor and the prior of that are ignored.
        generator: Draws points of the surface; on the CPU.

    Raises:
        TorchcalError: If the images are too small to find any place in.
    """
    check_searchable(job)
    k = _usable_frame(job)
    site = _site(job, k, generator)
    found = _poses(job, k, site)
    bases = _bases(job, k, found)
    return Located(
        job=_told(job, bases[0], site.extent),
        Ts_world_base=bases,
    )


def check_searchable(job: Job) -> None:
    """Raises a TorchcalError if the job's images are too small to find any place in."""
    width, height = job.sensor.projection.width, job.sensor.projection.height
    if min(width, height) < LEAST_SIDE:
        raise TorchcalError(
            f'{job.file}: found search.initial = "anywhere" with images of {width} x {height} '
            f"pixels; expected at least {LEAST_SIDE} x {LEAST_SIDE}"
        )


def without_prior(job: Job) -> Job:
    """The job with what it believes of base or sensor before any image: with "anywhere", nothing.

    Its nominal pose stays; the prior is as wide as the site.
    """
    if job.initial != "anywhere":
        return job
    surface, poses = _standing(job, 0)
    corners = place_vertices(surface, poses.to(surface.vertices))
    sigma = extent(corners.amin(0), corners.amax(0))
    return replace(job, base=PosePrior(sigma=sigma.to(job.T_world_base)))


def _usable_frame(job: Job) -> int:
    """The first frame in which enough was measured, or the one in which most was."""
    shares = observe(job).measured.flatten(1).double().mean(1)
    enough = (shares >= USABLE).nonzero()[:, 0]
    return int(enough[0]) if len(enough) else int(shares.argmax())


def _site(job: Job, k: int, generator: torch.Generator) -> Site:
    return Site.of(*_standing(job, k), generator)


def _standing(job: Job, k: int) -> tuple[Surface, Float[Tensor, "body 4 4"]]:
    """What stands still, and where its bodies are in the site, in a frame."""
    watching = job.link == WORLD_LINK
    world, robot = (None, job.robot) if watching else (job.world, None)
    device, origin = job.T_world_base.device, torch.eye(4).to(job.T_world_base)
    scene = build_scene(world, robot, dtype=torch.float64, device=device)
    joints = job.frames[k].joints if watching else None
    return scene.surface, body_poses(scene, world, robot, origin, joints)


def _poses(job: Job, k: int, site: Site) -> Float[Tensor, "pose 4 4"]:
    """Poses of the sensor in the site that explain the frame, the best first."""
    image = job.frames[k].image
    view = OneView.of(image.range, job.sensor, image.usable)
    nowhere = site.middle
    measured = image_features(image.range.double(), job.sensor, image.usable)
    poses = poses_anywhere(site, view, measured.planes)
    if len(poses) == 0:
        return nowhere.T_world_sensor[None]
    found = judged(site, view, free_sensor(nowhere, site.Ts_world_body), poses)
    return found.close


def _bases(job: Job, k: int, Ts_site_sensor: Tensor) -> Float[Tensor, "pose 4 4"]:
    """``T_world_base``, or without a robot the pose of the first frame."""
    if job.link == WORLD_LINK:
        return job.T_link_sensor @ se3.inverse(Ts_site_sensor)
    return Ts_site_sensor @ se3.inverse(_carried(job, k) @ job.T_link_sensor)


def _carried(job: Job, k: int) -> Float[Tensor, "4 4"]:
    """Pose of the carrier of a frame's sensor in the base, or in the first frame's sensor."""
    frame = job.frames[k]
    if job.robot is None or frame.joints is None or job.link is None:
        first, own = job.frames[0].T_world_sensor, frame.T_world_sensor
        assert first is not None, "frames without joints have poses"
        assert own is not None, "frames without joints have poses"
        return se3.inverse(first) @ own
    links = job.robot.forward_kinematics(frame.joints)
    return links[job.robot.link_index(job.link)]


def _told(job: Job, base: Tensor, sigma: Tensor) -> Job:
    """The job with a nominal base, or poses of all frames, and a prior that says nothing."""
    told = replace(job, base=PosePrior(sigma=sigma.to(base)))
    if job.robot is not None:
        return replace(told, T_world_base=base)
    frames = (
        replace(frame, T_world_sensor=base @ _carried(job, k)) for k, frame in enumerate(job.frames)
    )
    return replace(told, frames=tuple(frames))
