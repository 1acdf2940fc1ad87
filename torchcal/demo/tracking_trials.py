"""A depth camera that wanders through the machine hall: recordings for trackers, with their truth.

Images come from ``torchcal.demo.raycast``, so that no estimator is tested on its own renderer.
"""

import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch
import trimesh
from jaxtyping import Float
from numpy import ndarray
from torch import Tensor

from torchcal.demo import raycast
from torchcal.demo.machine_hall import machine_hall, random_view
from torchcal.demo.range_trials import meshes_in_world
from torchcal.geometry import se3
from torchcal.geometry.projection import Pinhole
from torchcal.model.job import Frame, Job, PosePrior
from torchcal.model.range_image import RangeImage
from torchcal.model.sensor import Drift, Noise, Sensor

SIGMA = 0.005
"""m"""
FOCAL = 525.0 / 640.0
"""Focal length over the width of the image: a field of view of 63 degrees."""
SHIFT, TURN = 0.02, math.radians(2.0)
"""How far (m) and how much (rad) the camera moves from frame to frame."""


def depth_camera(width: int = 640) -> Sensor:
    """A sharp depth camera with 5 mm of independent noise, images of 4 to 3."""
    height = 3 * width // 4
    return Sensor(
        projection=Pinhole(
            width=width,
            height=height,
            fx=FOCAL * width,
            fy=FOCAL * width,
            cx=(width - 1) / 2,
            cy=(height - 1) / 2,
        ),
        noise=Noise(a=SIGMA, drift=Drift(sigma=0.0, pixels=1.0)),
        near=0.3,
        far=20.0,
        beam=1,
    )


def wandering(
    count: int, rng: torch.Generator, *, shift: float = SHIFT, turn: float = TURN
) -> Float[Tensor, "frame 4 4"]:
    """Poses ``T_world_sensor``, each ``shift`` (m) and ``turn`` (rad) from the one before.

    The camera moves straight towards one random view after the other, and turns towards others.
    """
    pose, place, aim = (random_view(rng) for _ in range(3))
    poses = [pose]
    while len(poses) < count:
        while (place[:3, 3] - pose[:3, 3]).norm() < shift:
            place = random_view(rng)
        while _turn_to(pose, aim).norm() < turn:
            aim = random_view(rng)
        way = place[:3, 3] - pose[:3, 3]
        about = _turn_to(pose, aim)
        rotation = se3.exp(torch.cat([torch.zeros_like(way), turn * about / about.norm()]))
        pose = pose @ rotation
        pose[:3, 3] += shift * way / way.norm()
        poses.append(pose)
    return torch.stack(poses)


def _turn_to(pose: Tensor, aim: Tensor) -> Float[Tensor, "3"]:
    """The rotation vector (rad) from one orientation to another."""
    return se3.log(se3.inverse(pose) @ aim)[3:]


def cast(
    meshes: list[trimesh.Trimesh], T_world_sensor: Float[Tensor, "4 4"], sensor: Sensor
) -> Float[ndarray, "h w"]:
    """What the camera would measure without noise (m)."""
    scene = raycast.view(meshes, T_world_sensor.numpy())
    return raycast.predict(scene, sensor.projection, sensor.beam)


def recorded(
    name: str,
    image: Float[ndarray, "h w"],
    sensor: Sensor,
    rng: np.random.Generator,
    *,
    T_world_sensor: Float[Tensor, "4 4"] | None = None,
) -> Frame:
    """A frame with the sensor's noise.

    Args:
        name: Of the image.
        image: From ``cast``.
        sensor: What records.
        rng: Of the noise.
        T_world_sensor: Where odometry says that the camera is; None without odometry.
    """
    ranges = torch.from_numpy(raycast.measure(image, sensor, rng))
    usable = torch.ones(ranges.shape, dtype=torch.bool)
    measured = RangeImage(name=name, file=f"{name}.npy", range=ranges, usable=usable)
    return Frame(image=measured, joints=None, T_world_sensor=T_world_sensor)


def recording(
    poses: Float[Tensor, "view 4 4"],
    count: int,
    sensor: Sensor,
    rng: np.random.Generator,
    *,
    error: Float[Tensor, "4 4"] | None = None,
    bump: Float[Tensor, "4 4"] | None = None,
) -> Iterator[tuple[Frame, Float[Tensor, "4 4"]]]:
    """Frames one by one, each with the camera's true pose; views are cast once and come again.

    Args:
        poses: Where the camera goes, back and forth.
        count: Of the frames.
        sensor: What records.
        rng: Of the noise.
        error: Of odometry, on the left of the true poses; None: there is no odometry.
        bump: The camera's pose after half of the frames, in the one that it should have.
    """
    meshes = meshes_in_world(machine_hall())
    images: dict[tuple[int, bool], ndarray] = {}
    for k in range(count):
        view, bumped = _back_and_forth(k, len(poses)), bump is not None and 2 * k >= count
        truth = poses[view] @ bump if bump is not None and bumped else poses[view]
        if (view, bumped) not in images:
            images[view, bumped] = cast(meshes, truth, sensor)
        known = None if error is None else error @ poses[view]
        image = images[view, bumped]
        yield recorded(f"{k + 1:04d}", image, sensor, rng, T_world_sensor=known), truth


def _back_and_forth(k: int, count: int) -> int:
    """0, 1 .. count - 1, count - 2 .. 1, 0, 1 .."""
    if count == 1:
        return 0
    place = k % (2 * count - 2)
    return min(place, 2 * count - 2 - place)


def camera_job(sensor: Sensor, T_world_sensor: Float[Tensor, "4 4"], prior: PosePrior) -> Job:
    """The job of a camera in the machine hall that is believed to be at a pose; no frames yet."""
    eye = torch.eye(4, dtype=torch.float64)
    return Job(
        file=Path("job.toml"),
        world=machine_hall(),
        robot=None,
        sensor=sensor,
        link=None,
        T_world_base=T_world_sensor,
        T_link_sensor=eye,
        frames=(),
        base=prior,
        mount=None,
    )
