"""What pixels show of the model: textures in their places, averaged; normals to the sensor."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image
from trimesh.visual import ColorVisuals, TextureVisuals
from trimesh.visual.material import PBRMaterial
from world_files import identity, load, saved

from torchcal.geometry.projection import Pinhole
from torchcal.model.meshes import merged, transformed
from torchcal.model.scene import build_scene
from torchcal.model.sensor import Noise, Sensor
from torchcal.model.world import World, WorldObject
from torchcal.render.appearance import Appearance, appearance
from torchcal.render.synthesis import synthesise

CAMERA = Pinhole(width=40, height=20, fx=40.0, fy=40.0, cx=19.5, cy=9.5)
"""At 1 m a pixel is 25 mm wide."""
ATOL_SINGLE = 1e-4  # single precision, a few texels from the corners that say where it is


def quadrants() -> Image.Image:
    """Red and green above, blue and white below: 8 x 8 texels."""
    image = np.zeros((8, 8, 3), np.uint8)
    image[:4, :4], image[:4, 4:], image[4:, :4], image[4:, 4:] = (
        (255, 0, 0),
        (0, 255, 0),
        (0, 0, 255),
        (255, 255, 255),
    )
    return Image.fromarray(image)


def sheet(
    z: float = 1.0, image: Image.Image | None = None, repeat: float = 1.0, **material: Any
) -> trimesh.Trimesh:
    """1 m x 0.5 m across the axis, as wide and high as the camera sees at 1 m, upright."""
    corners = np.array([(-0.5, -0.25, z), (0.5, -0.25, z), (0.5, 0.25, z), (-0.5, 0.25, z)])
    uv = repeat * np.array([(0.0, 1.0), (1.0, 1.0), (1.0, 0.0), (0.0, 0.0)])
    texture = PBRMaterial(baseColorTexture=image or quadrants(), **material)
    visual = TextureVisuals(uv=uv, material=texture)
    return trimesh.Trimesh(corners, np.array([(0, 1, 2), (0, 2, 3)]), visual=visual, process=False)


def seen(world: World | trimesh.Trimesh, dtype: torch.dtype = torch.float64) -> Appearance:
    """What the camera at the origin sees."""
    if isinstance(world, trimesh.Trimesh):
        item = WorldObject(name="sheet", mesh=world, T_world_object=identity())
        world = World(objects=(item,))
    scene = build_scene(world, None, dtype=dtype, device=torch.device("cpu"))
    sensor = Sensor(projection=CAMERA, noise=Noise(a=0.01), near=0.1, far=99.0, beam=1)
    poses = torch.stack([item.T_world_object for item in world.objects]).to(dtype)
    return appearance(scene, poses, sensor, synthesise(scene.surface, poses, sensor).face)


def assert_quadrants(colour: torch.Tensor) -> None:
    """Away from the borders of the quadrants, where texels are interpolated."""
    corners = ((3, 3, (1, 0, 0)), (3, 36, (0, 1, 0)), (16, 3, (0, 0, 1)), (16, 36, (1, 1, 1)))
    for row, column, expected in corners:
        shown = colour[row, column].double()
        torch.testing.assert_close(
            shown, torch.tensor(expected).double(), atol=ATOL_SINGLE, rtol=0.0
        )


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_texture_is_shown_upright_and_not_as_one_colour_a_face(dtype: torch.dtype):
    shown = seen(sheet(), dtype)
    assert shown.colour.dtype == dtype
    assert_quadrants(shown.colour)


def test_a_pixel_between_two_texels_shows_their_mean():
    pair = Image.fromarray(np.array([[[0, 0, 0], [200, 100, 50]]], np.uint8))
    colour = seen(sheet(image=pair)).colour
    # Pixel 19 ends where the image has its middle: 0.5 / 20 of a texel before it.
    share = torch.tensor(0.5 - 0.5 / 20).double()
    expected = share * torch.tensor([200.0, 100.0, 50.0]).double() / 255.0
    torch.testing.assert_close(colour[:, 19], expected.expand(20, 3), atol=ATOL_SINGLE, rtol=0.0)


def test_a_texture_far_finer_than_pixels_shows_its_mean():
    chequers = 255 * (np.indices((512, 512)).sum(0) % 2)
    image = Image.fromarray(np.repeat(chequers[..., None], 3, axis=2).astype(np.uint8))
    colour = seen(sheet(image=image, repeat=3.0)).colour
    torch.testing.assert_close(colour, torch.full_like(colour, 0.5), atol=0.01, rtol=0.0)


def test_an_image_repeats_outside_its_borders():
    colour = seen(sheet(repeat=2.0)).colour
    torch.testing.assert_close(colour[:, :20], colour[:, 20:], atol=0.02, rtol=0.0)
    torch.testing.assert_close(colour[5:10, 12], colour[15:20, 12], atol=0.02, rtol=0.0)
    assert float(colour[3, 3, 0]) > 0.9


def test_colours_of_vertices_blend_over_a_face():
    mesh = sheet()
    rgba = np.array([(0, 0, 0, 255), (255, 0, 0, 255), (255, 0, 0, 255), (0, 0, 0, 255)])
    mesh.visual = ColorVisuals(mesh, vertex_colors=rgba)
    red = seen(mesh).colour[..., 0]
    ramp = (torch.arange(40).double() + 0.5) / 40
    torch.testing.assert_close(red, ramp.expand(20, 40), atol=1e-6, rtol=0.0)


def test_the_base_colour_and_the_colours_of_vertices_dim_a_texture(tmp_path: Path):
    grey = Image.new("RGB", (4, 4), (200, 200, 200))
    mesh = sheet(image=grey, baseColorFactor=[255, 128, 0, 255])
    assert isinstance(mesh.visual, TextureVisuals)
    mesh.visual.vertex_attributes["color"] = np.full((4, 4), (51, 255, 255, 255), np.uint8)
    shown = seen(load(saved(trimesh.Scene({"sheet": mesh}), tmp_path)))
    expected = torch.tensor([0.2, 128 / 255, 0.0]).double() * 200 / 255
    torch.testing.assert_close(shown.colour[10, 20].double(), expected, atol=ATOL_SINGLE, rtol=0.0)


def test_an_object_of_several_materials_keeps_all_its_textures():
    behind = sheet(2.0, Image.new("RGB", (2, 2), (10, 20, 30)))
    behind.apply_scale([4.0, 4.0, 1.0])
    plain = trimesh.creation.box((1, 1, 1)).apply_translation((0, 0, 9))
    small = transformed(sheet(), np.diag([0.5, 1.0, 1.0, 1.0]))
    colour = seen(merged([plain, behind, small])).colour
    assert_quadrants(colour[:, 10:30].repeat_interleave(2, 1))
    dark = torch.tensor([10.0, 20.0, 30.0]).double() / 255.0
    torch.testing.assert_close(colour[:, 5], dark.expand(20, 3), atol=ATOL_SINGLE, rtol=0.0)


@pytest.mark.parametrize("parts", [1, 2])
def test_a_mirrored_object_shows_its_image_mirrored(parts: int):
    mesh = merged([sheet(), sheet(9.0)][:parts])
    colour = seen(transformed(mesh, np.diag([-1.0, 1.0, 1.0, 1.0]))).colour
    assert_quadrants(colour.flip(1))


def test_an_image_of_many_objects_is_held_once():
    objects = tuple(
        WorldObject(name=str(z), mesh=sheet(z), T_world_object=identity()) for z in (1.0, 2.0, 3.0)
    )
    scene = build_scene(
        World(objects=objects), None, dtype=torch.float32, device=torch.device("cpu")
    )
    assert len(scene.paint.images) == 1
    assert scene.paint.image.tolist() == [0] * 6


def test_nothing_is_shown_where_the_model_is_empty():
    shown = seen(transformed(sheet(), np.diag([0.5, 1.0, 1.0, 1.0])))
    assert (shown.body[:, :9] == -1).all()
    assert (shown.body[:, 11:29] == 0).all()
    assert not shown.colour[:, :9].any()
    assert not shown.normal[:, :9].any()
    towards = torch.tensor([0.0, 0.0, -1.0]).double()
    torch.testing.assert_close(shown.normal[10, 20], towards)
