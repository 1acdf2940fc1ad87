"""Small scenes in front of a sensor, as the surface that is rendered and as the oracle's view."""

import numpy as np
import torch
import trimesh
from torch import Tensor

from torchcal.demo import raycast
from torchcal.geometry.projection import Pinhole, Projection, Spherical
from torchcal.model.scene import Surface, edge_tables
from torchcal.model.sensor import Noise, Sensor

CAMERA = Pinhole(width=40, height=32, fx=38.0, fy=36.0, cx=19.3, cy=15.8)
LIDAR = Spherical(width=40, height=32, azimuth=(-0.6, 0.6), elevation=(0.45, -0.45))


def surface_of(*bodies: trimesh.Trimesh, dtype: torch.dtype = torch.float64) -> Surface:
    """Each mesh is one body; its edges are found by its own indices."""
    starts = np.cumsum([0, *(len(body.vertices) for body in bodies)])
    vertices = np.concatenate([body.vertices for body in bodies])
    faces = np.concatenate([body.faces + at for body, at in zip(bodies, starts, strict=False)])
    edges, edge_faces = edge_tables(faces.astype(np.int64))
    return Surface(
        vertices=torch.as_tensor(vertices, dtype=dtype),
        vertex_body=torch.repeat_interleave(torch.as_tensor(np.diff(starts))),
        faces=torch.as_tensor(faces.astype(np.int64)),
        face_colour=torch.zeros(len(faces), 3, dtype=dtype),
        edges=torch.as_tensor(edges),
        edge_faces=torch.as_tensor(edge_faces),
    )


def at_rest(surface: Surface) -> Tensor:
    """Poses of bodies whose frames are the sensor's."""
    bodies = int(surface.vertex_body.max()) + 1
    return torch.eye(4, dtype=surface.vertices.dtype).expand(bodies, 4, 4).contiguous()


def sensor_of(projection: Projection, beam: int = 1, near: float = 0.0, far: float = 1e3) -> Sensor:
    return Sensor(projection=projection, noise=Noise(a=0.01), near=near, far=far, beam=beam)


def oracle_of(*bodies: trimesh.Trimesh) -> raycast.View:
    """The same scene for the ray caster."""
    return raycast.view(bodies, np.eye(4))


def sheet(*corners: tuple[float, float, float]) -> trimesh.Trimesh:
    """A flat quadrangle."""
    return trimesh.Trimesh(vertices=corners, faces=[[0, 1, 2], [0, 2, 3]], process=False)


def wall(z: float, side: float = 50.0) -> trimesh.Trimesh:
    """A square across the optical axis."""
    return sheet((-side, -side, z), (side, -side, z), (side, side, z), (-side, side, z))


def turned(
    mesh: trimesh.Trimesh, xyz: tuple[float, ...], rpy: tuple[float, ...]
) -> trimesh.Trimesh:
    """A copy that is turned and then moved."""
    roll, pitch, yaw = rpy
    T = trimesh.transformations.euler_matrix(roll, pitch, yaw)
    T[:3, 3] = xyz
    return mesh.copy().apply_transform(T)


def box(
    size: tuple[float, ...], xyz: tuple[float, ...], rpy: tuple[float, ...] = (0.0, 0.0, 0.0)
) -> trimesh.Trimesh:
    return turned(trimesh.creation.box(size), xyz, rpy)


def ball(radius: float, xyz: tuple[float, ...], subdivisions: int = 3) -> trimesh.Trimesh:
    mesh = trimesh.creation.icosphere(subdivisions=subdivisions, radius=radius)
    return mesh.apply_translation(xyz)


def cell() -> tuple[trimesh.Trimesh, ...]:
    """Two boxes and a ball in a closed room around the sensor."""
    return (
        box((8.0, 6.0, 10.0), (0.3, -0.2, 0.5), (0.05, 0.1, 0.02)),
        box((0.7, 0.9, 0.6), (-0.6, 0.2, 2.6), (0.4, 0.5, 0.1)),
        box((0.5, 0.4, 1.4), (0.9, -0.4, 3.1), (-0.3, 0.7, 0.6)),
        ball(0.35, (0.35, 0.6, 2.2)),
    )
