"""A storeroom that is not what its model says: recordings for the comparison and the update.

Five crates of 30 to 60 cm stand before machines in a closed room. One may be gone, one may have
been pushed by 10 cm, and something may have come. Images come from ``torchcal.demo.raycast``, so
that nothing is judged on its own renderer.
"""

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import trimesh
from jaxtyping import Float
from numpy import ndarray
from torch import Tensor

from torchcal.demo import cell, raycast
from torchcal.demo.machine_hall import looking, machine_hall
from torchcal.demo.range_trials import FIELD_OF_VIEW
from torchcal.geometry import se3
from torchcal.geometry.projection import Pinhole
from torchcal.model.job import Frame, Job, PosePrior
from torchcal.model.range_image import RangeImage
from torchcal.model.sensor import Drift, Noise, Sensor
from torchcal.model.world import World, WorldObject

ROOM = ("floor", "ceiling", "wall_back", "wall_front", "wall_left", "wall_right")
FURNITURE = ("door", "door_frame", "pipes", "machine_a", "machine_b", "workbench", "cabinet_b")
"""Objects of the machine hall that stand around the crates."""
PLACES = tuple((x, y) for y in (-0.4, 0.8) for x in (-1.2, 0.0, 1.2))
"""m; five of them have a crate, the sixth is free."""
SIDES = (0.3, 0.6)
"""m: the least and the greatest side of a crate."""
JITTER = 0.1
"""m"""
PUSH = 0.1
"""m"""
STAND = ((-1.6, -2.8, 1.3), (1.6, -1.7, 2.3))
"""Opposite corners (m) of the box in which the sensor is."""
AIM = ((-0.3, 0.0, 0.1), (0.3, 0.4, 0.3))
"""Opposite corners (m) of the box at which it looks."""
OFFSET = (0.1, math.radians(5.0))
"""How far (m, rad) the sensor is from where the job says, and the sigma of the job's prior."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Changes:
    """How the storeroom differs from its model."""

    removed: str | None
    moved: str | None
    T_world_moved: Float[ndarray, "4 4"] | None
    """Where ``moved`` really stands."""
    added: trimesh.Trimesh | None
    """World frame (m)."""


@dataclass(frozen=True, kw_only=True, slots=True)
class OperatorTrial:
    """A recording and what is true of it."""

    job: Job
    Ts_world_sensor: Float[Tensor, "frame 4 4"]
    """The true ones."""
    changes: Changes
    seen_of_added: Float[ndarray, "point 3"]
    """What the rays met of the added object (m, world frame)."""


def paper_sensor(side: int) -> Sensor:
    """The sensor of the paper's 4.2, and its beam, with ``side`` x ``side`` pixels."""
    return _camera(side, sigma=0.05, beam=2 * round((21 * side / 512 - 1) / 2) + 1)


def depth_camera(side: int) -> Sensor:
    """A sharp camera with 5 mm of noise and the field of view of the paper's."""
    return _camera(side, sigma=0.005, beam=1)


def draw_trial(
    sensor: Sensor, seed: int, number: int, *, frames: int, changes: tuple[str, ...]
) -> OperatorTrial:
    """Draws a storeroom, its changes and where the sensor really is, and records it.

    Args:
        sensor: What records.
        seed: Of the experiment.
        number: Of the trial, which depends on nothing else.
        frames: Images, each from a view of its own.
        changes: Some of ``removed``, ``moved`` and ``added``.
    """
    rng = np.random.default_rng([seed, number])
    world, free = _storeroom(rng)
    truth = _changed(world, free, rng, changes)
    poses = torch.stack([_view(rng) for _ in range(frames)])
    error = poses[0] @ se3.exp(_offset(rng)) @ se3.inverse(poses[0])
    meshes = _real_meshes(world, truth)
    recorded, seen = [], []
    for k, pose in enumerate(poses, start=1):
        view = raycast.view(meshes, pose.numpy())
        image = raycast.predict(view, sensor.projection, sensor.beam)
        ranges = torch.from_numpy(raycast.measure(image, sensor, rng))
        recorded.append(_frame(f"{k:04d}", ranges, error @ pose))
        if truth.added is not None:
            seen.append(_seen(view, sensor, len(truth.added.faces), pose))
    return OperatorTrial(
        job=_job(world, sensor, recorded),
        Ts_world_sensor=poses,
        changes=truth,
        seen_of_added=np.concatenate(seen) if seen else np.zeros((0, 3)),
    )


def box_overlap(one: Float[ndarray, "2 3"], other: Float[ndarray, "2 3"]) -> float:
    """Intersection over union of two boxes along the world's axes (low and high corners, m)."""
    low, high = np.maximum(one[0], other[0]), np.minimum(one[1], other[1])
    common = float(np.prod(np.clip(high - low, 0.0, None)))
    volumes = float(np.prod(one[1] - one[0]) + np.prod(other[1] - other[0]))
    return common / (volumes - common) if common > 0.0 else 0.0


def _camera(side: int, *, sigma: float, beam: int) -> Sensor:
    focal, middle = side / 2 / math.tan(FIELD_OF_VIEW / 2), (side - 1) / 2
    return Sensor(
        projection=Pinhole(width=side, height=side, fx=focal, fy=focal, cx=middle, cy=middle),
        noise=Noise(a=sigma, drift=Drift(sigma=0.0, pixels=1.0)),
        near=0.3,
        far=20.0,
        beam=beam,
    )


def _storeroom(rng: np.random.Generator) -> tuple[World, tuple[float, float]]:
    """What the model says, and the place without a crate."""
    around = [item for item in machine_hall().objects if item.name in (*ROOM, *FURNITURE)]
    places = [PLACES[i] for i in rng.permutation(len(PLACES))]
    crates = [
        WorldObject(
            name=f"crate_{k}",
            mesh=_box(rng),
            T_world_object=torch.from_numpy(_standing(place, rng)),
        )
        for k, place in enumerate(places[1:], start=1)
    ]
    return World(objects=(*around, *crates), complete=True), places[0]


def _box(rng: np.random.Generator) -> trimesh.Trimesh:
    size = rng.uniform(*SIDES, 3)
    return trimesh.creation.box(size).apply_translation((0.0, 0.0, size[2] / 2))


def _standing(place: tuple[float, float], rng: np.random.Generator) -> Float[ndarray, "4 4"]:
    angle = rng.uniform(0.0, math.pi)
    T = np.eye(4)
    T[:2, :2] = [[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]]
    T[:2, 3] = place + rng.uniform(-JITTER, JITTER, 2)
    return T


def _changed(
    world: World,
    free: tuple[float, float],
    rng: np.random.Generator,
    changes: tuple[str, ...],
) -> Changes:
    poses = {item.name: item.T_world_object.numpy() for item in world.objects}
    crates = [name for name in poses if name.startswith("crate_")]
    gone, pushed = rng.permutation(crates)[:2].tolist()
    direction = rng.uniform(0.0, 2.0 * math.pi)
    T_world_moved = poses[pushed].copy()
    T_world_moved[:2, 3] += PUSH * np.array([math.cos(direction), math.sin(direction)])
    drum = next(each for each in cell.real_objects() if each.name == cell.ADDED)
    new = drum.mesh.copy() if rng.random() < 0.5 else _box(rng)
    new.apply_transform(_standing(free, rng))
    return Changes(
        removed=gone if "removed" in changes else None,
        moved=pushed if "moved" in changes else None,
        T_world_moved=T_world_moved if "moved" in changes else None,
        added=new if "added" in changes else None,
    )


def _real_meshes(world: World, truth: Changes) -> list[trimesh.Trimesh]:
    """What stands there (m, world frame); what was added comes first."""
    meshes = [] if truth.added is None else [truth.added]
    for item in world.objects:
        if item.name == truth.removed:
            continue
        T = item.T_world_object.numpy()
        if item.name == truth.moved and truth.T_world_moved is not None:
            T = truth.T_world_moved
        meshes.append(item.mesh.copy().apply_transform(T))
    return meshes


def _view(rng: np.random.Generator) -> Tensor:
    position, target = (torch.from_numpy(rng.uniform(*corners)) for corners in (STAND, AIM))
    return looking(position, target, torch.zeros((), dtype=torch.float64))


def _offset(rng: np.random.Generator) -> Float[Tensor, " 6"]:
    """A move and a turn of the sizes of ``OFFSET`` in random directions."""
    directions = rng.standard_normal((2, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return torch.from_numpy((directions * np.array(OFFSET)[:, None]).ravel())


def _seen(
    view: raycast.View, sensor: Sensor, faces: int, T_world_sensor: Tensor
) -> Float[ndarray, "point 3"]:
    """Where the middles of pixels meet the first ``faces`` triangles (m, world frame)."""
    v, u = torch.meshgrid(
        torch.arange(sensor.projection.height, dtype=torch.float64),
        torch.arange(sensor.projection.width, dtype=torch.float64),
        indexing="ij",
    )
    rays = sensor.projection.rays(u, v)
    ranges, face = raycast.cast(view, rays.numpy())
    met = (face >= 0) & (face < faces)
    points = (torch.from_numpy(ranges)[..., None] * rays)[torch.from_numpy(met)]
    return se3.transform(T_world_sensor, points).numpy()


def _frame(name: str, ranges: Tensor, T_world_sensor: Tensor) -> Frame:
    usable = torch.ones(ranges.shape, dtype=torch.bool)
    image = RangeImage(name=name, file=f"{name}.npy", range=ranges, usable=usable)
    return Frame(image=image, joints=None, T_world_sensor=T_world_sensor)


def _job(world: World, sensor: Sensor, frames: list[Frame]) -> Job:
    eye = torch.eye(4, dtype=torch.float64)
    sigma = torch.tensor([OFFSET[0]] * 3 + [OFFSET[1]] * 3, dtype=torch.float64)
    return Job(
        file=Path("job.toml"),
        world=world,
        robot=None,
        sensor=sensor,
        link=None,
        T_world_base=eye,
        T_link_sensor=eye,
        frames=tuple(frames),
        base=PosePrior(sigma=sigma),
        mount=None,
    )
