"""Everything the sensor may see, as one set of triangles on rigid bodies."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
import trimesh
from jaxtyping import Float, Int
from numpy.typing import NDArray
from torch import Tensor

from torchcal.errors import TorchcalError, choices
from torchcal.model.meshes import face_colours, weld
from torchcal.model.paint import Paint, joined, paint_of
from torchcal.model.robot import Robot
from torchcal.model.world import World


@dataclass(frozen=True, kw_only=True, slots=True)
class Body:
    """A rigid part of the scene: an object of the world or a link of the robot."""

    name: str
    """Objects by their name, links as ``robot/<link>``."""
    link: str | None
    """The robot's link; None for an object of the world."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Surface:
    """Triangles on rigid bodies; vertices are welded within each body."""

    vertices: Float[Tensor, "vertex 3"]
    """m, each in the frame of its body."""
    vertex_body: Int[Tensor, " vertex"]
    faces: Int[Tensor, "face 3"]
    face_colour: Float[Tensor, "face 3"]
    """RGB, 0 to 1: the mean of what ``Scene.paint`` says."""
    edges: Int[Tensor, "edge 2"]
    """Vertices of every edge."""
    edge_faces: Int[Tensor, "edge 2"]
    """The two faces of every edge; the second is -1 at the border of an open mesh."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Scene:
    """Bodies and their triangles."""

    bodies: tuple[Body, ...]
    surface: Surface
    paint: Paint
    """How the faces of the surface look."""

    def body_index(self, name: str) -> int:
        """The place of a body in ``bodies``.

        Raises:
            TorchcalError: If there is no such body.
        """
        names = [body.name for body in self.bodies]
        if name not in names:
            raise TorchcalError(f"found body {name!r}; expected {choices(names)}")
        return names.index(name)


@dataclass(frozen=True, kw_only=True, slots=True)
class _Welded:
    """One body's triangles."""

    vertices: NDArray[np.float64]
    faces: NDArray[np.int64]
    colours: NDArray[np.float64]
    paint: Paint


def build_scene(
    world: World | None, robot: Robot | None, *, dtype: torch.dtype, device: torch.device
) -> Scene:
    """The world's objects and then the robot's links that show something, as one surface.

    An edge of more than two faces has one row for each pair of faces, and one with -1 for a face
    that is left over: every face is in three rows.

    Raises:
        TorchcalError: If there is nothing to see, or a mesh has no faces, or faces of vertices that
            are not finite or not there.
    """
    bodies, meshes = bodies_of(world, robot), _meshes(world, robot)
    if not meshes:
        raise TorchcalError(
            "found a model without triangles; expected a world or a robot with some"
        )
    for body, mesh in zip(bodies, meshes, strict=True):
        _check_mesh(body.name, mesh)
    welded = [_welded(mesh) for mesh in meshes]
    starts = np.cumsum([0, *(len(part.vertices) for part in welded)])
    faces = np.concatenate([part.faces + at for part, at in zip(welded, starts, strict=False)])
    edges, edge_faces = edge_tables(faces)
    colours = np.concatenate([part.colours for part in welded])
    vertices = np.concatenate([part.vertices for part in welded])
    index = {"dtype": torch.int64, "device": device}
    surface = Surface(
        vertices=torch.as_tensor(vertices, dtype=dtype, device=device),
        vertex_body=torch.as_tensor(np.repeat(np.arange(len(bodies)), np.diff(starts)), **index),
        faces=torch.as_tensor(faces, **index),
        face_colour=torch.as_tensor(colours, dtype=dtype, device=device),
        edges=torch.as_tensor(edges, **index),
        edge_faces=torch.as_tensor(edge_faces, **index),
    )
    paint = joined([part.paint for part in welded]).to(device)
    return Scene(bodies=bodies, surface=surface, paint=paint)


def without_bodies(surface: Surface, bodies: Sequence[int]) -> Surface:
    """The surface without the faces of some bodies; all bodies keep their numbers."""
    owner = surface.vertex_body[surface.faces[:, 0]]
    kept = ~torch.isin(owner, torch.as_tensor(bodies, dtype=owner.dtype, device=owner.device))
    faces = surface.faces[kept]
    edges, edge_faces = edge_tables(faces.cpu().numpy())
    return replace(
        surface,
        faces=faces,
        face_colour=surface.face_colour[kept],
        edges=torch.as_tensor(edges, device=faces.device),
        edge_faces=torch.as_tensor(edge_faces, device=faces.device),
    )


def body_poses(
    scene: Scene,
    world: World | None,
    robot: Robot | None,
    T_world_base: Float[Tensor, "*#batch 4 4"],
    joints: Float[Tensor, "*#batch joint"] | None,
) -> Float[Tensor, "*batch body 4 4"]:
    """Ts_world_body: where every body of the scene stands.

    Args:
        scene: Made of the same ``world`` and ``robot`` by ``build_scene``.
        world: The objects stand where it says.
        robot: Its links stand where base and joints put them.
        T_world_base: Without a robot it only gives batch, dtype and device.
        joints: Values (rad, m) in the order of ``Robot.joint_names``; None without a robot.

    Raises:
        ValueError: If there is a robot and no joints.
    """
    batch, parts = T_world_base.shape[:-2], []
    if robot is not None:
        if joints is None:
            raise ValueError(f"found no joints; expected values of {', '.join(robot.joint_names)}")
        batch = torch.broadcast_shapes(batch, joints.shape[:-1])
        links = [robot.link_index(body.link) for body in scene.bodies if body.link is not None]
        T_base_links = robot.forward_kinematics(joints)[..., links, :, :]
        parts.append((T_world_base[..., None, :, :] @ T_base_links).expand(*batch, -1, 4, 4))
    if world is not None:
        fixed = torch.stack([item.T_world_object for item in world.objects]).to(T_world_base)
        parts.insert(0, fixed.expand(*batch, -1, 4, 4))
    return torch.cat(parts, -3)


def bodies_of(world: World | None, robot: Robot | None) -> tuple[Body, ...]:
    """The world's objects and then the robot's links that show something: ``Scene.bodies``."""
    objects = () if world is None else world.objects
    return (
        *(Body(name=item.name, link=None) for item in objects),
        *(Body(name=f"robot/{link}", link=link) for link in _shown_links(robot)),
    )


def _meshes(world: World | None, robot: Robot | None) -> list[trimesh.Trimesh]:
    """What each of ``bodies_of`` looks like."""
    meshes = {} if robot is None else robot.link_meshes
    objects = () if world is None else world.objects
    return [item.mesh for item in objects] + [meshes[link] for link in _shown_links(robot)]


def _shown_links(robot: Robot | None) -> list[str]:
    return [] if robot is None else [name for name in robot.link_names if name in robot.link_meshes]


def _check_mesh(name: str, mesh: trimesh.Trimesh) -> None:
    faces, count = np.asarray(mesh.faces), len(mesh.vertices)
    if not len(faces):
        raise TorchcalError(f"{name}: found a mesh with no faces; expected triangles")
    if faces.min() < 0 or faces.max() >= count:
        wrong = faces.min() if faces.min() < 0 else faces.max()
        raise TorchcalError(f"{name}: found a face of vertex {wrong}; expected 0 to {count - 1}")
    if not np.isfinite(mesh.vertices).all():
        raise TorchcalError(f"{name}: found vertices that are not finite; expected metres")


def _welded(mesh: trimesh.Trimesh) -> _Welded:
    """Vertices by position: a soup of triangles gets the edges that its faces share."""
    ids = weld(np.asarray(mesh.vertices))
    _, first = np.unique(ids, return_index=True)
    faces = ids[mesh.faces]
    whole = (faces != np.roll(faces, 1, axis=1)).all(1)
    return _Welded(
        vertices=mesh.vertices[first],
        faces=faces[whole],
        colours=face_colours(mesh)[whole, :3] / 255.0,
        paint=paint_of(mesh).of(torch.as_tensor(whole)),
    )


def edge_tables(
    faces: NDArray[np.int64],
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """The edges of triangles: their vertices, and the two faces (or one and -1) of each."""
    sides = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    key = sides[:, 0] * (faces.max(initial=0) + 1) + sides[:, 1]
    order = np.argsort(key, kind="stable")
    key, sides, owner = key[order], sides[order], order // 3
    starts = np.flatnonzero(np.r_[True, key[1:] != key[:-1]])
    place = np.arange(len(key)) - np.repeat(starts, np.diff(np.r_[starts, len(key)]))
    first = np.flatnonzero(place % 2 == 0)
    after = np.minimum(first + 1, len(key) - 1)
    paired = (after > first) & (key[after] == key[first])
    second = np.where(paired, owner[after], -1)
    return sides[first], np.stack([owner[first], second], axis=1)
