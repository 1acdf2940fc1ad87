"""The scene of the paper's 4.2: an indoor cell full of machinery, and sensors that look at it.

World frame: z up, the floor at 0, the room closed on all sides. The machinery stands at y > 0
before the back wall; the aisle before it is free, and the sensors are there.
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from torchcal.demo import cell
from torchcal.geometry import se3
from torchcal.model.world import World, WorldObject

PLACES = (
    ("floor", "floor", (0.0, -0.4, 0.0), 0.0),
    ("ceiling", "floor", (0.0, -0.4, 2.9), 0.0),
    ("wall_back", "wall_north", (0.0, 3.1, 0.0), 180.0),
    ("wall_front", "wall_south", (0.0, -3.9, 0.0), 0.0),
    ("wall_left", "wall_west", (-3.8, -0.4, 0.0), 0.0),
    ("wall_right", "wall_east", (3.8, -0.4, 0.0), 0.0),
    ("door_frame", "door_frame", (1.7, 3.0, 0.0), 0.0),
    ("door", "door", (1.7, 3.1, 0.0), 0.0),
    ("pipes", "pipes", (0.0, 2.75, 0.0), 90.0),
    ("machine_a", "machine", (-2.3, 1.9, 0.0), 172.0),
    ("machine_b", "machine", (0.2, 2.0, 0.0), 184.0),
    ("workbench", "workbench", (2.6, 1.6, 0.0), -25.0),
    ("conveyor", "conveyor", (-0.6, 0.5, 0.0), 4.0),
    ("cabinet_a", "cabinet", (3.25, 0.2, 0.0), -75.0),
    ("cabinet_b", "cabinet", (-3.3, 0.1, 0.0), 80.0),
    ("control_panel_a", "control_panel", (-1.3, 1.1, 0.0), -20.0),
    ("control_panel_b", "control_panel", (1.3, 1.0, 0.0), 25.0),
    ("tank", "tank", (2.1, 0.3, 0.0), 0.0),
    ("pillar", "pillar", (0.95, 0.2, 0.0), 0.0),
    ("crate_a", "crate_a", (-2.3, 0.3, 0.0), 20.0),
    ("crate_b", "crate_b", (-2.3, 0.3, 0.42), 48.0),
)
"""Name, the object of the demo's cell that it is like, where it stands (m) and its turn (deg)."""

STAND = ((-1.2, -2.6, 1.3), (1.2, -1.6, 2.3))
"""Opposite corners (m) of the box in which sensors are."""
AIM = ((-1.2, 0.4, 0.7), (1.2, 1.4, 1.2))
"""Opposite corners (m) of the box, amid the machinery, at which they look."""
ROLL = math.radians(20.0)
"""The largest roll about the optical axis (rad)."""


def machine_hall() -> World:
    """The cell of named objects: machines, benches, pipes and a door frame in a closed room."""
    meshes = {item.name: item.mesh for item in cell.modelled_objects()}
    objects = tuple(
        WorldObject(name=name, mesh=meshes[kind], T_world_object=_standing(xyz, turn_deg))
        for name, kind, xyz, turn_deg in PLACES
    )
    return World(objects=objects, complete=True)


def random_view(rng: torch.Generator) -> Float[Tensor, "4 4"]:
    """A sensor's pose T_world_sensor in the free aisle that sees the machinery from 2 to 6 m.

    The sensor's frame is that of a pinhole: x right, y down, z forward.
    """
    position, target = (_within(box, rng) for box in (STAND, AIM))
    roll = ROLL * (2.0 * torch.rand((), generator=rng, dtype=torch.float64) - 1.0)
    return looking(position, target, roll)


def looking(
    position: Float[Tensor, "3"], target: Float[Tensor, "3"], roll: Float[Tensor, ""]
) -> Float[Tensor, "4 4"]:
    """T_world_sensor of a sensor (m) that looks at a target (m), neither above nor below it.

    Args:
        position: Where the sensor is.
        target: The point that its middle pixel sees.
        roll: Turn (rad) about the optical axis; 0: the picture stands upright.
    """
    forward = torch.nn.functional.normalize(target - position, dim=0)
    up = forward.new_tensor((0.0, 0.0, 1.0))
    right = torch.nn.functional.normalize(torch.linalg.cross(forward, up), dim=0)
    down = torch.linalg.cross(forward, right)
    upright = torch.eye(4, dtype=forward.dtype, device=forward.device)
    upright[:3] = torch.stack([right, down, forward, position], 1)
    about_axis = torch.zeros(6, dtype=forward.dtype, device=forward.device)
    about_axis[5] = roll
    return upright @ se3.exp(about_axis)


def _standing(xyz: cell.Triple, turn_deg: float) -> Tensor:
    turn = torch.tensor([0.0, 0.0, math.radians(turn_deg)], dtype=torch.float64)
    return se3.from_xyz_rpy(torch.tensor(xyz, dtype=torch.float64), turn)


def _within(corners: tuple[cell.Triple, cell.Triple], rng: torch.Generator) -> Tensor:
    low, high = torch.tensor(corners, dtype=torch.float64)
    return low + (high - low) * torch.rand(3, generator=rng, dtype=torch.float64)
