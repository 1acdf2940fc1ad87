"""The demo's robot cell: a CAD model of named objects, and what really stands there.

World frame: z up, the floor at 0, the robot's pedestal at the origin. Every object's own frame has
its origin where the object stands, at the middle of its footprint.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import trimesh
from jaxtyping import Float
from numpy import ndarray
from trimesh.visual.material import PBRMaterial
from trimesh.visual.texture import TextureVisuals

Triple = tuple[float, float, float]

PEDESTAL_HEIGHT = 0.75
"""m; the robot stands on it."""

WALL_HEIGHT = 2.8
REMOVED = "crate_c"
ADDED = "drum"

GREY, WHITE, STEEL, DARK = (128, 130, 132), (214, 214, 206), (150, 160, 170), (70, 76, 84)
WOOD, GREEN, BLUE, RED = (176, 132, 84), (92, 128, 92), (52, 92, 150), (176, 60, 48)
YELLOW, ORANGE = (214, 172, 40), (208, 116, 40)


@dataclass(frozen=True, kw_only=True, slots=True)
class CellObject:
    """One object of the cell."""

    name: str
    mesh: trimesh.Trimesh
    """In the object's own frame (m)."""
    T_world_object: Float[ndarray, "4 4"]

    def in_world(self) -> trimesh.Trimesh:
        """A copy of the mesh in the world frame (m)."""
        return self.mesh.copy().apply_transform(self.T_world_object)


def modelled_objects() -> tuple[CellObject, ...]:
    """What the CAD model says: everything but ``ADDED``."""
    return (
        *_room(),
        _object("pedestal", _pedestal(), at=(0.0, 0.0), colour=DARK),
        _object("workbench", _workbench(), at=(1.35, 2.95), colour=WOOD),
        _object("vise", _vise(), at=(0.95, 2.85), height=0.9, colour=BLUE),
        _object("cabinet", _cabinet(), at=(-2.9, 1.15), turn_deg=90.0, colour=GREEN),
        _object("machine", _machine(), at=(3.3, -0.35), turn_deg=90.0, colour=STEEL),
        _object("control_panel", _control_panel(), at=(2.4, 1.7), turn_deg=-55.0, colour=DARK),
        _object("conveyor", _conveyor(), at=(0.75, -2.55), colour=STEEL),
        _object("pipes", _pipes(), at=(4.05, 0.0), colour=YELLOW),
        _object("tank", _tank(), at=(-2.45, -0.45), colour=WHITE),
        _object("pillar", _pillar(), at=(-2.95, -1.75), colour=YELLOW),
        _object("crate_a", _crate(), at=(-1.55, -2.2), turn_deg=20.0, colour=ORANGE),
        _object("crate_b", _crate(), at=(-1.6, -2.25), height=0.42, turn_deg=48.0, colour=ORANGE),
        _object(REMOVED, _crate(), at=(-1.6, 1.3), turn_deg=-35.0, colour=ORANGE),
    )


def real_objects() -> tuple[CellObject, ...]:
    """What stands there: ``REMOVED`` is gone, ``ADDED`` has come."""
    kept = (each for each in modelled_objects() if each.name != REMOVED)
    return (*kept, _object(ADDED, _drum(), at=(1.7, -0.85), colour=RED))


def as_scene(objects: Iterable[CellObject]) -> trimesh.Scene:
    """A scene with one named node for each object, as CAD programs export it."""
    scene = trimesh.Scene()
    for each in objects:
        scene.add_geometry(
            each.mesh,
            node_name=each.name,
            geom_name=each.name,
            transform=each.T_world_object,
        )
    return scene


def _object(
    name: str,
    parts: list[trimesh.Trimesh],
    *,
    at: tuple[float, float],
    colour: tuple[int, int, int],
    height: float = 0.0,
    turn_deg: float = 0.0,
) -> CellObject:
    mesh = _joined(parts)
    material = PBRMaterial(
        name=name, baseColorFactor=[*colour, 255], metallicFactor=0.0, roughnessFactor=0.8
    )
    mesh.visual = TextureVisuals(material=material)
    cos, sin = math.cos(math.radians(turn_deg)), math.sin(math.radians(turn_deg))
    T_world_object = np.eye(4)
    T_world_object[:2, :2] = (cos, -sin), (sin, cos)
    T_world_object[:3, 3] = (*at, height)
    return CellObject(name=name, mesh=mesh, T_world_object=T_world_object)


def _joined(parts: list[trimesh.Trimesh]) -> trimesh.Trimesh:
    counts = np.cumsum([0, *(len(part.vertices) for part in parts[:-1])])
    return trimesh.Trimesh(
        vertices=np.concatenate([part.vertices for part in parts]),
        faces=np.concatenate([p.faces + first for p, first in zip(parts, counts, strict=True)]),
        process=False,
    )


def _box(size: Triple, foot: Triple) -> trimesh.Trimesh:
    """A box that stands with the middle of its footprint on a point."""
    box = trimesh.creation.box(size)
    return box.apply_translation((foot[0], foot[1], foot[2] + size[2] / 2))


def _tube(radius: float, start: Triple, end: Triple) -> trimesh.Trimesh:
    return trimesh.creation.cylinder(radius, segment=np.array([start, end]), sections=32)


def _room() -> tuple[CellObject, ...]:
    """Floor, three plain walls, and one with a closed door in its frame."""
    east_west, north_south = (0.2, 7.2, WALL_HEIGHT), (7.4, 0.2, WALL_HEIGHT)
    return (
        _object("floor", [_box((7.8, 7.2, 0.1), (0.0, 0.0, -0.1))], at=(0.5, 0.0), colour=GREY),
        _object("wall_east", [_box(east_west, (0.0, 0.0, 0.0))], at=(4.3, 0.0), colour=WHITE),
        _object("wall_west", [_box(east_west, (0.0, 0.0, 0.0))], at=(-3.3, 0.0), colour=WHITE),
        _object("wall_south", [_box(north_south, (0.0, 0.0, 0.0))], at=(0.5, -3.5), colour=WHITE),
        _object("wall_north", _wall_with_opening(), at=(0.5, 3.5), colour=WHITE),
        _object("door_frame", _door_frame(), at=(-1.2, 3.4), colour=DARK),
        _object("door", _door(), at=(-1.2, 3.5), colour=GREEN),
    )


def _wall_with_opening() -> list[trimesh.Trimesh]:
    """From x = -3.7 to 3.7, open from -2.2 to -1.2 up to 2.1 m."""
    return [
        _box((1.5, 0.2, WALL_HEIGHT), (-2.95, 0.0, 0.0)),
        _box((4.9, 0.2, WALL_HEIGHT), (1.25, 0.0, 0.0)),
        _box((1.0, 0.2, WALL_HEIGHT - 2.1), (-1.7, 0.0, 2.1)),
    ]


def _door_frame() -> list[trimesh.Trimesh]:
    return [
        _box((0.1, 0.12, 2.2), (-0.5, 0.0, 0.0)),
        _box((0.1, 0.12, 2.2), (0.5, 0.0, 0.0)),
        _box((0.9, 0.12, 0.1), (0.0, 0.0, 2.1)),
    ]


def _door() -> list[trimesh.Trimesh]:
    return [_box((1.0, 0.05, 2.1), (0.0, 0.0, 0.0)), _box((0.14, 0.1, 0.04), (0.32, -0.06, 1.0))]


def _pedestal() -> list[trimesh.Trimesh]:
    return [
        _box((0.5, 0.5, 0.04), (0.0, 0.0, 0.0)),
        _box((0.26, 0.26, PEDESTAL_HEIGHT - 0.08), (0.0, 0.0, 0.04)),
        _box((0.34, 0.34, 0.04), (0.0, 0.0, PEDESTAL_HEIGHT - 0.04)),
    ]


def _workbench() -> list[trimesh.Trimesh]:
    legs = [_box((0.08, 0.08, 0.84), (x, y, 0.0)) for x in (-0.9, 0.9) for y in (-0.3, 0.3)]
    return [
        *legs,
        _box((2.0, 0.75, 0.06), (0.0, 0.0, 0.84)),
        _box((1.7, 0.5, 0.04), (0.0, 0.05, 0.3)),
        _box((2.0, 0.05, 0.6), (0.0, 0.35, 0.9)),
        _box((0.5, 0.25, 0.2), (0.5, 0.18, 0.9)),
        _box((0.3, 0.2, 0.3), (0.2, 0.1, 0.34)),
    ]


def _vise() -> list[trimesh.Trimesh]:
    return [
        _box((0.16, 0.3, 0.06), (0.0, 0.0, 0.0)),
        _box((0.18, 0.06, 0.14), (0.0, -0.1, 0.06)),
        _box((0.18, 0.06, 0.14), (0.0, 0.06, 0.06)),
    ]


def _cabinet() -> list[trimesh.Trimesh]:
    """Its doors face -y."""
    return [
        _box((1.2, 0.5, 1.9), (0.0, 0.05, 0.08)),
        _box((1.1, 0.4, 0.08), (0.0, 0.05, 0.0)),
        _box((0.56, 0.03, 1.76), (-0.295, -0.215, 0.15)),
        _box((0.56, 0.03, 1.76), (0.295, -0.215, 0.15)),
        _box((0.04, 0.05, 0.2), (-0.06, -0.255, 0.95)),
        _box((0.04, 0.05, 0.2), (0.06, -0.255, 0.95)),
    ]


def _machine() -> list[trimesh.Trimesh]:
    """A machining centre; its spindle faces +y, seen from the robot after the turn."""
    return [
        _box((2.0, 1.1, 0.45), (0.0, 0.0, 0.0)),
        _box((0.7, 0.5, 1.45), (0.0, -0.3, 0.45)),
        _box((0.5, 0.75, 0.5), (0.0, 0.05, 1.25)),
        _tube(0.1, (0.0, 0.3, 1.25), (0.0, 0.3, 1.0)),
        _box((1.2, 0.45, 0.16), (0.1, 0.28, 0.45)),
        _box((0.3, 0.25, 0.18), (-0.2, 0.3, 0.61)),
        _box((0.4, 0.5, 1.2), (-0.8, -0.25, 0.45)),
        _box((0.35, 0.35, 0.8), (0.75, -0.3, 0.45)),
    ]


def _control_panel() -> list[trimesh.Trimesh]:
    return [
        _box((0.4, 0.3, 0.05), (0.0, 0.0, 0.0)),
        _box((0.1, 0.1, 0.95), (0.0, 0.0, 0.05)),
        _box((0.5, 0.18, 0.45), (0.0, 0.0, 1.0)),
    ]


def _conveyor() -> list[trimesh.Trimesh]:
    legs = [_box((0.1, 0.08, 0.6), (x, y, 0.0)) for x in (-1.1, 0.0, 1.1) for y in (-0.3, 0.3)]
    rails = [_box((2.6, 0.06, 0.16), (0.0, y, 0.6)) for y in (-0.33, 0.33)]
    belt = _box((2.6, 0.6, 0.06), (0.0, 0.0, 0.66))
    return [*legs, *rails, belt, _box((0.45, 0.35, 0.3), (0.5, 0.0, 0.72))]


def _pipes() -> list[trimesh.Trimesh]:
    """A header along the east wall and risers down to the floor."""
    return [
        _tube(0.09, (0.0, -2.6, 2.35), (0.0, 2.6, 2.35)),
        _tube(0.09, (0.0, -2.6, 0.0), (0.0, -2.6, 2.35)),
        _tube(0.06, (0.0, 1.3, 0.0), (0.0, 1.3, 2.35)),
        _tube(0.06, (0.0, 1.6, 0.0), (0.0, 1.6, 2.35)),
        _box((0.2, 0.6, 0.12), (-0.02, 1.45, 1.2)),
    ]


def _tank() -> list[trimesh.Trimesh]:
    legs = [_box((0.07, 0.07, 0.35), (x, y, 0.0)) for x in (-0.22, 0.22) for y in (-0.22, 0.22)]
    return [
        *legs,
        _tube(0.38, (0.0, 0.0, 0.35), (0.0, 0.0, 1.5)),
        _tube(0.12, (0.0, 0.0, 1.5), (0.0, 0.0, 1.7)),
    ]


def _pillar() -> list[trimesh.Trimesh]:
    return [
        _box((0.35, 0.35, 0.05), (0.0, 0.0, 0.0)),
        _box((0.18, 0.18, WALL_HEIGHT - 0.05), (0.0, 0.0, 0.05)),
    ]


def _crate() -> list[trimesh.Trimesh]:
    return [
        _box((0.56, 0.36, 0.34), (0.0, 0.0, 0.04)),
        _box((0.6, 0.4, 0.04), (0.0, 0.0, 0.0)),
        _box((0.6, 0.4, 0.04), (0.0, 0.0, 0.38)),
    ]


def _drum() -> list[trimesh.Trimesh]:
    return [
        _tube(0.2, (0.0, 0.0, 0.0), (0.0, 0.0, 0.5)),
        _tube(0.215, (0.0, 0.0, 0.15), (0.0, 0.0, 0.18)),
        _tube(0.215, (0.0, 0.0, 0.32), (0.0, 0.0, 0.35)),
    ]
