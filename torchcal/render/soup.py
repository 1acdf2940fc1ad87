"""All views of a batch as one set of triangles, so that a batch costs no loop over its views.

Face ``f`` of view ``k`` is face ``k * faces + f``; vertices, edges and bodies are counted alike.
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchcal.model.scene import Surface
from torchcal.model.sensor import Sensor


@dataclass(frozen=True, kw_only=True, slots=True)
class Views:
    """What one sensor sees from a batch of poses."""

    sensor: Sensor
    count: int
    """Views in the batch."""
    vertices: Float[Tensor, "vertex 3"]
    """m, each in the sensor's frame of its view."""
    surface: Surface
    """The triangles of all views."""

    @property
    def own_faces(self) -> Int[Tensor, "face 3"]:
        """The triangles of the first view, of its own vertices."""
        return self.surface.faces[: len(self.surface.faces) // self.count]

    def exact(self) -> "Views":
        """In double precision."""
        return replace(self, vertices=self.vertices.double())

    def still(self) -> "Views":
        """Without what automatic differentiation traces."""
        return replace(self, vertices=self.vertices.detach())


def soup_of_views(surface: Surface, views: int, bodies: int) -> Surface:
    """The triangles of as many copies of a surface as there are views, each with its bodies."""
    if views == 1:
        return surface
    vertices, faces = len(surface.vertices), len(surface.faces)
    return replace(
        surface,
        vertices=surface.vertices.repeat(views, 1),
        vertex_body=_counted(surface.vertex_body, views, bodies),
        faces=_counted(surface.faces, views, vertices),
        face_colour=surface.face_colour.repeat(views, 1),
        edges=_counted(surface.edges, views, vertices),
        edge_faces=_counted(surface.edge_faces, views, faces),
    )


def in_soup(face: Int[Tensor, "view h w"], faces: int) -> Int[Tensor, "view h w"]:
    """The faces of the soup for those of each view's own surface; -1 stays -1."""
    if len(face) == 1:
        return face
    start = faces * torch.arange(len(face), device=face.device)
    return torch.where(face < 0, face, face + start[:, None, None])


def _counted(index: Tensor, views: int, size: int) -> Tensor:
    """Indices that go on where those of the view before end; -1 stays -1."""
    start = size * torch.arange(views, device=index.device).view(-1, *[1] * index.ndim)
    return torch.where(index < 0, index, index + start).flatten(0, 1)
