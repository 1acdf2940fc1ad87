"""The numerical experiment of 4.2: the pose of a sensor from one range image of a cell.

Images come from ``torchcal.demo.raycast``, so that no estimator is tested on its own renderer.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
import trimesh
from jaxtyping import Float
from numpy import ndarray
from torch import Tensor

from torchcal.demo import raycast
from torchcal.demo.machine_hall import machine_hall, random_view
from torchcal.geometry import se3
from torchcal.geometry.projection import Pinhole, Projection
from torchcal.model.sensor import Drift, Noise, Sensor
from torchcal.model.world import World

SIDE = 512
FIELD_OF_VIEW = math.radians(50.0)
SIGMA = 0.05
"""m"""
BEAM = 21
"""2 N + 1 with N = 10."""
STEP = 0.25
"""Pixels by which the image moves in a difference; the ray caster's samples are 1/16 apart."""
DISTANCE = 2.0
"""m: where a step of the position moves the image by so much."""


@dataclass(frozen=True, kw_only=True, slots=True)
class RangeTrial:
    """One image with its truth."""

    T_world_sensor: Float[Tensor, "4 4"]
    start: Float[Tensor, "4 4"] | None
    """T_world_sensor as the estimator is told it; None: it is told nothing."""
    range: Float[Tensor, "h w"]
    """What the sensor measured (m); NaN outside its limits."""


def range_sensor(side: int = SIDE) -> Sensor:
    """The sensor of 4.2, or one with the same field of view and fewer pixels."""
    focal, middle = side / 2 / math.tan(FIELD_OF_VIEW / 2), (side - 1) / 2
    return Sensor(
        projection=Pinhole(width=side, height=side, fx=focal, fy=focal, cx=middle, cy=middle),
        noise=Noise(a=SIGMA, drift=Drift(sigma=0.0, pixels=1.0)),
        near=0.3,
        far=20.0,
        beam=BEAM,
    )


def meshes_in_world(world: World) -> list[trimesh.Trimesh]:
    """Copies of all objects' meshes where they stand (m)."""
    return [item.mesh.copy().apply_transform(item.T_world_object.numpy()) for item in world.objects]


def draw_trial(
    seed: int,
    number: int,
    *,
    offset: tuple[float, float] | None,
    sensor: Sensor | None = None,
    world: World | None = None,
) -> RangeTrial:
    """Draws a pose in the machine hall, casts its image and moves the starting value off.

    A trial depends on nothing but seed and number, and its image not on the offset.

    Args:
        seed: Of the experiment.
        number: Of the trial.
        offset: How far off the starting value is, in metres in a random direction and in radians
            about a random axis; None for none.
        sensor: None: that of 4.2.
        world: None: the machine hall.
    """
    sensor, world = sensor or range_sensor(), world or machine_hall()
    poses, noise, _ = _generators(seed, number)
    T_world_sensor = random_view(poses)
    scene = raycast.view(meshes_in_world(world), T_world_sensor.numpy())
    predicted = raycast.predict(scene, sensor.projection, sensor.beam)
    measured = raycast.measure(predicted, sensor, noise)
    trial = RangeTrial(T_world_sensor=T_world_sensor, start=None, range=torch.from_numpy(measured))
    return with_start(trial, seed, number, offset)


def with_start(
    trial: RangeTrial, seed: int, number: int, offset: tuple[float, float] | None
) -> RangeTrial:
    """The same image with another starting value.

    Args:
        trial: Drawn from the same seed and number.
        seed: Of the experiment.
        number: Of the trial.
        offset: As for ``draw_trial``; a larger one is in the same direction about the same axis.
    """
    if offset is None:
        return replace(trial, start=None)
    motion = _motion(*offset, _generators(seed, number)[2])
    return replace(trial, start=trial.T_world_sensor @ motion)


def _generators(
    seed: int, number: int
) -> tuple[torch.Generator, np.random.Generator, torch.Generator]:
    """For the pose, the noise and the starting value."""
    pose, noise, start = np.random.SeedSequence([seed, number]).spawn(3)
    made = [
        torch.Generator().manual_seed(int(each.generate_state(1, np.uint64)[0] >> np.uint64(1)))
        for each in (pose, start)
    ]
    return made[0], np.random.default_rng(noise), made[1]


def errors(
    T_world_sensor: Float[Tensor, "*batch 4 4"], truth: Float[Tensor, "*batch 4 4"]
) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch"]]:
    """Lengths of the errors of position (m) and rotation (rad)."""
    position = (T_world_sensor - truth)[..., :3, 3].norm(dim=-1)
    turn = truth[..., :3, :3].mT @ T_world_sensor[..., :3, :3]
    return position, se3.rotation_log(turn).norm(dim=-1)


def cramer_rao(
    T_world_sensor: Float[Tensor, "4 4"],
    *,
    sensor: Sensor | None = None,
    world: World | None = None,
    step: float = STEP,
) -> Float[Tensor, "6 6"]:
    """The least covariance of an unbiased estimate of the pose from one image.

    Of a twist (m, rad) on the right of the pose, by central differences of images by ray casting;
    infinite where the image does not tell the pose.

    Args:
        T_world_sensor: The true pose.
        sensor: None: that of 4.2.
        world: None: the machine hall.
        step: Pixels by which the differences move the image.
    """
    sensor, world = sensor or range_sensor(), world or machine_hall()
    meshes = meshes_in_world(world)

    def image(twist: Tensor) -> Float[ndarray, "h w"]:
        pose = (T_world_sensor @ se3.exp(twist)).numpy()
        return raycast.predict(raycast.view(meshes, pose), sensor.projection, sensor.beam)

    turn = step * _pixel_angle(sensor.projection)
    A, middle = _differences(image, [DISTANCE * turn] * 3 + [turn] * 3)
    weight = torch.from_numpy(sensor.noise.sigma(torch.from_numpy(middle)).numpy()) ** -2
    information = (A.mT * weight) @ A
    return _inverse(information)


def _pixel_angle(projection: Projection) -> float:
    """How far apart (rad) the rays of two neighbours in the middle are."""
    u, v = (
        torch.tensor((size - 1) / 2, dtype=torch.float64)
        for size in (projection.width, projection.height)
    )
    along_u, _ = projection.ray_derivatives(u, v)
    return float(along_u.norm() / projection.rays(u, v).norm())


def _differences(
    image: Callable[[Tensor], Float[ndarray, "h w"]], steps: Sequence[float]
) -> tuple[Tensor, Float[ndarray, " pixel"]]:
    """A of eq. 13 in the pixels that have a range on both sides of every step, and their ranges."""
    columns, means = [], []
    for twist in torch.diag(torch.tensor(steps, dtype=torch.float64)):
        ahead, behind = image(twist), image(-twist)
        columns.append((ahead - behind) / (2.0 * float(twist.sum())))
        means.append(0.5 * (ahead + behind))
    A = np.stack(columns, -1).reshape(-1, len(steps))
    met = np.isfinite(A).all(1)
    return torch.from_numpy(A[met]), np.mean(means, 0).ravel()[met]


def _inverse(information: Tensor) -> Tensor:
    root, failed = torch.linalg.cholesky_ex(information)
    if failed:
        return torch.full_like(information, torch.inf)
    return torch.cholesky_inverse(root)


def _motion(distance: float, angle: float, draws: torch.Generator) -> Tensor:
    """A move and a turn of given sizes in random directions."""
    directions = torch.randn(2, 3, dtype=torch.float64, generator=draws)
    move, axis = torch.nn.functional.normalize(directions, dim=-1)
    turned = se3.exp(torch.cat([torch.zeros_like(move), angle * axis]))
    return se3.from_rotation_translation(turned[:3, :3], distance * move)
