"""What triangles look like: colours at their corners and images laid over them."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
import trimesh
from jaxtyping import Bool, Float, Int, UInt8
from numpy.typing import NDArray
from PIL.Image import Image
from torch import Tensor
from trimesh.visual import ColorVisuals, TextureVisuals
from trimesh.visual.color import to_rgba
from trimesh.visual.material import Material, PBRMaterial, SimpleMaterial

NEUTRAL_GREY = (178, 178, 178, 255)
"""RGBA of a surface that says nothing of its colour."""

KEPT = "paint"
"""Where a mesh of several textured parts keeps its look: trimesh holds one image for a mesh."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Paint:
    """The look of triangles: a colour at each corner, times an image where a face has one."""

    colour: Float[Tensor, "face 3 3"]
    """RGB (0 to 1) of every corner."""
    uv: Float[Tensor, "face 3 2"]
    """Where the corners lie on the image: to the right and up, in its sizes; it repeats."""
    image: Int[Tensor, " face"]
    """Index into ``images``; -1 for a face without."""
    images: tuple[UInt8[Tensor, "_ _ 3"], ...]

    def of(self, faces: Bool[Tensor, " face"]) -> "Paint":
        """The look of some of the faces."""
        return replace(self, colour=self.colour[faces], uv=self.uv[faces], image=self.image[faces])

    def turned(self) -> "Paint":
        """The same look when every face lists its corners the other way round."""
        return replace(self, colour=self.colour.flip(1), uv=self.uv.flip(1))

    def to(self, device: torch.device) -> "Paint":
        """The same on a device; single precision is more than colours need."""
        return Paint(
            colour=self.colour.to(device),
            uv=self.uv.to(device),
            image=self.image.to(device),
            images=tuple(each.to(device) for each in self.images),
        )


def joined(paints: Sequence[Paint]) -> Paint:
    """The look of all faces together; an image that several use is held once."""
    place: dict[tuple, int] = {}
    images: list[Tensor] = []
    index = []
    for paint in paints:
        here = [-1]
        for image in paint.images:
            key = (image.shape, hash(image.numpy().tobytes()))
            if key not in place:
                place[key] = len(images)
                images.append(image)
            here.append(place[key])
        index.append(torch.tensor(here)[paint.image + 1])
    return Paint(
        colour=torch.cat([paint.colour for paint in paints]),
        uv=torch.cat([paint.uv for paint in paints]),
        image=torch.cat(index),
        images=tuple(images),
    )


def paint_of(mesh: trimesh.Trimesh) -> Paint:
    """The look of a mesh, be it of one material or merged of several."""
    visual, faces = mesh.visual, np.asarray(mesh.faces)
    if KEPT in mesh.metadata:
        return mesh.metadata[KEPT]
    if isinstance(visual, TextureVisuals):
        return _textured(visual, faces)
    if not isinstance(visual, ColorVisuals) or visual.kind is None:
        return _plain(np.broadcast_to(np.array(NEUTRAL_GREY), (len(faces), 3, 4)))
    if visual.kind == "vertex":
        return _plain(np.asarray(visual.vertex_colors)[faces])
    return _plain(np.repeat(np.asarray(visual.face_colors)[:, None], 3, axis=1))


def base_colour(material: Material) -> NDArray[np.float64]:
    """RGBA (to 255) before the texture; an OBJ's diffuse colour counts only without a texture."""
    white = np.full(4, 255.0)
    if isinstance(material, PBRMaterial):
        factor = material.baseColorFactor
        return white if factor is None else np.asarray(factor, dtype=np.float64)
    has_image = material_image(material) is not None
    return white if has_image else np.asarray(material.main_color, np.float64)


def material_image(material: Material) -> Image | None:
    """The image that gives a material its colours, if there is one."""
    if isinstance(material, PBRMaterial):
        return material.baseColorTexture
    return material.image if isinstance(material, SimpleMaterial) else None


def _plain(rgba: NDArray) -> Paint:
    """Colours (to 255) of corners, no image."""
    colour = torch.tensor(rgba[..., :3] / 255.0, dtype=torch.float32)
    uv, image = colour.new_zeros(len(colour), 3, 2), torch.full((len(colour),), -1)
    return Paint(colour=colour, uv=uv, image=image, images=())


def _textured(visual: TextureVisuals, faces: NDArray[np.int64]) -> Paint:
    rgba = np.broadcast_to(base_colour(visual.material), (len(faces), 3, 4))
    vertex = visual.vertex_attributes.get("color")
    if vertex is not None and len(vertex) > faces.max():
        rgba = rgba * (to_rgba(vertex)[faces] / 255.0)
    paint = _plain(rgba)
    image, uv = material_image(visual.material), visual.uv
    if image is None or uv is None or len(uv) <= faces.max():
        return paint
    at = torch.tensor(np.nan_to_num(np.asarray(uv)[faces]), dtype=torch.float32)
    pixels = torch.tensor(np.array(image.convert("RGB")))
    return replace(paint, uv=at, image=torch.zeros(len(faces), dtype=torch.int64), images=(pixels,))
