"""Rooms with boxes, drawn at random: some symmetric, some with too few planes to tell a pose."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
import trimesh
from jaxtyping import Float
from torch import Tensor

from torchcal.demo.cell import Triple
from torchcal.geometry import se3
from torchcal.model.world import World, WorldObject

WIDTH, LENGTH, HEIGHT = 6.0, 5.0, 2.8
"""m"""
SQUARE = 5.0
"""m: sides of a room that looks the same after a turn."""
THICK = 0.1
"""m: of floor, walls and ceiling."""
BOXES = 8
FREE = 1.1
"""m: no box stands nearer to the middle, where the sensor is."""
SMALLEST, LARGEST = 0.3, 0.9
"""m: sides of boxes."""
ASIDE = 0.6
"""m: how far from the middle the sensor may be."""
EYES = 1.2, 1.5
"""m: its height."""
NOD = 0.15, 0.3
"""rad: how far it looks down."""
WIDE = 60.0
"""m: sides of planes in a room of few: beyond the sensor's range on all sides."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Room:
    """A room of boxes and the motions after which it looks the same."""

    world: World
    symmetries: tuple[Float[Tensor, "4 4"], ...]
    """``T_world_world`` of each, the identity first."""


def drawn_room(rng: np.random.Generator, boxes: int = BOXES) -> Room:
    """Floor, four walls, a ceiling and boxes on the floor."""
    objects = (*_shell(WIDTH, LENGTH), *drawn_boxes(rng, boxes))
    return Room(world=World(objects=objects), symmetries=(_turn(1, 0),))


def symmetric_room(rng: np.random.Generator, folds: int) -> Room:
    """A square room of boxes that looks the same after each of so many turns about its middle."""
    turns = tuple(_turn(folds, k) for k in range(folds))
    once = drawn_boxes(rng, BOXES // folds)
    boxes = tuple(
        replace(item, name=f"{item.name}_{k}", T_world_object=turn @ item.T_world_object)
        for k, turn in enumerate(turns)
        for item in once
    )
    return Room(world=World(objects=(*_shell(SQUARE, SQUARE), *boxes)), symmetries=turns)


def corner(planes: int) -> Room:
    """Nothing but so many planes, of which no image shows an edge: floor, north and east wall."""
    slabs = (
        _slab("floor", (WIDE, WIDE, THICK), (0.0, 0.0, -THICK / 2)),
        _slab("wall_north", (WIDE, THICK, WIDE), (0.0, LENGTH / 2 + THICK / 2, 0.0)),
        _slab("wall_east", (THICK, WIDE, WIDE), (WIDTH / 2 + THICK / 2, 0.0, 0.0)),
    )
    return Room(world=World(objects=slabs[:planes]), symmetries=(_turn(1, 0),))


def drawn_boxes(rng: np.random.Generator, count: int, name: str = "box") -> tuple[WorldObject, ...]:
    """Boxes that stand on the floor around the middle, turned in any way; they may overlap."""
    boxes = []
    for k in range(count):
        size = rng.uniform(SMALLEST, LARGEST, 3)
        distance, angle = rng.uniform(FREE + LARGEST / 2, SQUARE / 2 - 0.4), rng.uniform(-1, 1)
        place = distance * np.array([np.cos(np.pi * angle), np.sin(np.pi * angle)])
        T = _turn(1, 0)
        turn = torch.tensor([0.0, 0.0, rng.uniform(-np.pi, np.pi)], dtype=torch.float64)
        T[:3, :3] = se3.from_xyz_rpy(torch.zeros_like(turn), turn)[:3, :3]
        T[:3, 3] = torch.tensor([*place, size[2] / 2], dtype=torch.float64)
        mesh = trimesh.creation.box(size)
        boxes.append(WorldObject(name=f"{name}_{k}", mesh=mesh, T_world_object=T))
    return tuple(boxes)


def drawn_view(rng: np.random.Generator, heading: float | None = None) -> Float[Tensor, "4 4"]:
    """``T_world_sensor`` of a camera near the middle that looks a little down.

    Args:
        rng: Draws it.
        heading: About where it looks (rad, from x to y); None: anywhere.
    """
    yaw = rng.uniform(-math.pi, math.pi) if heading is None else heading + rng.uniform(-0.2, 0.2)
    nod = rng.uniform(*NOD)
    xyz = torch.tensor([*rng.uniform(-ASIDE, ASIDE, 2), rng.uniform(*EYES)], dtype=torch.float64)
    # Rolled and pitched by a quarter turn, the optical axis is level and down is down.
    level = torch.tensor([-math.pi / 2 - nod, 0.0, yaw - math.pi / 2], dtype=torch.float64)
    return se3.from_xyz_rpy(xyz, level)


def _shell(width: float, length: float) -> tuple[WorldObject, ...]:
    """Floor at 0, walls and ceiling around the middle."""
    x, y, z = width / 2 + THICK / 2, length / 2 + THICK / 2, HEIGHT / 2
    return (
        _slab("floor", (width, length, THICK), (0.0, 0.0, -THICK / 2)),
        _slab("ceiling", (width, length, THICK), (0.0, 0.0, HEIGHT + THICK / 2)),
        _slab("wall_east", (THICK, length, HEIGHT), (x, 0.0, z)),
        _slab("wall_west", (THICK, length, HEIGHT), (-x, 0.0, z)),
        _slab("wall_north", (width, THICK, HEIGHT), (0.0, y, z)),
        _slab("wall_south", (width, THICK, HEIGHT), (0.0, -y, z)),
    )


def _slab(name: str, size: Triple, middle: Sequence[float]) -> WorldObject:
    T = _turn(1, 0)
    T[:3, 3] = torch.tensor(middle, dtype=torch.float64)
    return WorldObject(name=name, mesh=trimesh.creation.box(size), T_world_object=T)


def _turn(folds: int, k: int) -> Tensor:
    """A turn about z by k of so many parts of a whole one."""
    angle = torch.tensor([0.0, 0.0, 2.0 * math.pi * k / folds], dtype=torch.float64)
    return se3.from_xyz_rpy(torch.zeros_like(angle), angle)
