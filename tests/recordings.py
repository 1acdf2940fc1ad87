"""Recordings of a furnished room by the ray caster: jobs with a known truth, without files."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import scenes
import torch
import trimesh
from torch import Tensor

from torchcal.demo import raycast
from torchcal.geometry import se3
from torchcal.geometry.projection import Pinhole, Projection, Spherical
from torchcal.model.job import WORLD_LINK, Frame, Job, PosePrior
from torchcal.model.range_image import RangeImage
from torchcal.model.robot import Robot, load_robot
from torchcal.model.sensor import Drift, Noise, Sensor
from torchcal.model.world import World, WorldObject

CAMERA = Pinhole(width=64, height=48, fx=55.0, fy=54.0, cx=31.2, cy=23.9)
LIDAR = Spherical(width=64, height=48, azimuth=(-0.55, 0.55), elevation=(0.42, -0.42))
EYE = torch.eye(4, dtype=torch.float64)
NO_DRIFT = Drift(sigma=0.0, pixels=1.0)
POSITION_SIGMA, ROTATION_SIGMA = 0.1, 0.1
"""m, rad"""

_ARM = """\
<robot name="arm">
  <link name="foot"/>
  <link name="upper"><visual><origin xyz="0 0 0.15"/>
    <geometry><box size="0.16 0.20 0.3"/></geometry></visual></link>
  <link name="tool"><visual><origin xyz="0.15 0 0"/>
    <geometry><box size="0.36 0.12 0.10"/></geometry></visual></link>
  <joint name="turn" type="revolute"><parent link="foot"/><child link="upper"/>
    <axis xyz="0 0 1"/><limit lower="-3" upper="3" effort="1" velocity="1"/></joint>
  <joint name="nod" type="revolute"><parent link="upper"/><child link="tool"/>
    <origin xyz="0.05 0 0.32"/><axis xyz="0 1 0"/>
    <limit lower="-3" upper="3" effort="1" velocity="1"/></joint>
</robot>"""


def room() -> dict[str, trimesh.Trimesh]:
    """A closed room around the origin and three boxes in front of it, along z."""
    return {
        "room": scenes.box((5.0, 4.0, 7.0), (0.2, -0.1, 0.4), (0.05, 0.1, 0.02)),
        "crate": scenes.box((0.7, 0.9, 0.6), (-0.6, 0.3, 2.2), (0.4, 0.5, 0.1)),
        "beam": scenes.box((0.4, 0.4, 1.4), (0.7, -0.4, 2.6), (-0.3, 0.7, 0.6)),
        "shelf": scenes.box((0.9, 0.15, 0.5), (0.2, 0.8, 2.4), (0.1, -0.2, 0.05)),
    }


def world_of(meshes: dict[str, trimesh.Trimesh], *, complete: bool = False) -> World:
    """Objects whose frames are the world's."""
    objects = (
        WorldObject(name=name, mesh=mesh, T_world_object=EYE) for name, mesh in meshes.items()
    )
    return World(objects=tuple(objects), complete=complete)


def sensor(
    projection: Projection = CAMERA,
    *,
    sigma: float = 0.005,
    beam: int = 1,
    drift: Drift | None = NO_DRIFT,
) -> Sensor:
    noise = Noise(a=sigma, drift=drift)
    return Sensor(projection=projection, noise=noise, near=0.1, far=20.0, beam=beam)


def prior(position: float = POSITION_SIGMA, rotation: float = ROTATION_SIGMA) -> PosePrior:
    sigmas = [position] * 3 + [rotation] * 3
    return PosePrior(sigma=torch.tensor(sigmas, dtype=torch.float64))


def twist(*values: float) -> Tensor:
    """m, m, m, rad, rad, rad."""
    return torch.tensor(values, dtype=torch.float64)


def pose(*values: float) -> Tensor:
    return se3.exp(twist(*values))


def record(
    meshes: list[trimesh.Trimesh], T_world_sensor: Tensor, sensor: Sensor, seed: int = 0
) -> Tensor:
    """A noisy image of what really stands there (m); NaN where nothing was measured."""
    view = raycast.view(meshes, T_world_sensor.numpy())
    predicted = raycast.predict(view, sensor.projection, sensor.beam)
    return torch.from_numpy(raycast.measure(predicted, sensor, np.random.default_rng(seed)))


def frame_of(
    ranges: Tensor,
    *,
    name: str = "frame",
    usable: Tensor | None = None,
    joints: Tensor | None = None,
    T_world_sensor: Tensor | None = None,
) -> Frame:
    allowed = torch.ones(ranges.shape, dtype=torch.bool) if usable is None else usable
    image = RangeImage(name=name, file=f"{name}.npy", range=ranges, usable=allowed)
    return Frame(image=image, joints=joints, T_world_sensor=T_world_sensor)


def hand_held(
    sensor: Sensor,
    truths: list[Tensor],
    *,
    error: Tensor,
    base: PosePrior | None = None,
    real: dict[str, trimesh.Trimesh] | None = None,
    seed: int = 0,
) -> Job:
    """A job without a robot: T_k = T_1 exp(error) T_1^-1 T_k of the nominal poses is the truth.

    Args:
        sensor: What records and what the job says of it.
        truths: ``T_world_sensor`` of every frame.
        error: The twist that leads from the first nominal pose to the true one.
        base: The prior; by default the one of this module.
        real: What stands there; by default what the model says.
        seed: Of the noise.
    """
    nominal = truths[0] @ se3.exp(-error) @ se3.inverse(truths[0])
    there = list((real or room()).values())
    frames = tuple(
        frame_of(
            record(there, truth, sensor, 100 * seed + k),
            name=f"frame-{k}",
            T_world_sensor=nominal @ truth,
        )
        for k, truth in enumerate(truths)
    )
    return Job(
        file=Path("job.toml"),
        world=world_of(room()),
        robot=None,
        sensor=sensor,
        link=None,
        T_world_base=EYE,
        T_link_sensor=EYE,
        frames=frames,
        base=base or prior(),
        mount=None,
    )


def arm(folder: Path) -> Robot:
    """A robot of two joints; its tool is a bar along x."""
    file = folder / "arm.urdf"
    file.write_text(_ARM)
    return load_robot(file)


def links_in_world(
    robot: Robot, T_world_base: Tensor, joints: Tensor
) -> dict[str, trimesh.Trimesh]:
    """Where the robot's links stand, without code of ``torchcal.calibrate``."""
    Ts = T_world_base @ robot.forward_kinematics(joints)
    return {
        name: mesh.copy().apply_transform(Ts[robot.link_index(name)].numpy())
        for name, mesh in robot.link_meshes.items()
    }


def carried(
    robot: Robot,
    sensor: Sensor,
    T_world_base: Tensor,
    T_link_sensor: Tensor,
    postures: list[Tensor],
    *,
    seed: int = 0,
) -> Job:
    """A job whose sensor the arm's tool carries through the room; base and mount are the truth."""
    frames = []
    for k, joints in enumerate(postures):
        T_base_tool = robot.forward_kinematics(joints)[robot.link_index("tool")]
        there = {**room(), **links_in_world(robot, T_world_base, joints)}
        truth = T_world_base @ T_base_tool @ T_link_sensor
        ranges = record(list(there.values()), truth, sensor, 100 * seed + k)
        frames.append(frame_of(ranges, name=f"frame-{k}", joints=joints))
    return Job(
        file=Path("job.toml"),
        world=world_of(room()),
        robot=robot,
        sensor=sensor,
        link="tool",
        T_world_base=T_world_base,
        T_link_sensor=T_link_sensor,
        frames=tuple(frames),
        base=None,
        mount=None,
    )


def standing(job: Job, T_world_sensor: Tensor) -> Job:
    """The same robot and images for a sensor that stands still: for kinematics, not for fits."""
    return replace(job, link=WORLD_LINK, T_link_sensor=T_world_sensor)
