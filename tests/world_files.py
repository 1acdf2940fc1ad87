"""Small worlds in files, and what a world looks like in world coordinates."""

from pathlib import Path

import numpy as np
import torch
import trimesh
from trimesh.exchange.gltf import export_glb
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial

from torchcal.geometry import se3
from torchcal.model.world import World, load_world


def identity() -> torch.Tensor:
    return torch.eye(4, dtype=torch.float64)


def load(file: Path, unit: float = 1.0, T_world_file: torch.Tensor | None = None) -> World:
    pose = identity() if T_world_file is None else T_world_file
    return load_world(file, unit=unit, T_world_file=pose, complete=False)


def pose_of(*xi: float) -> torch.Tensor:
    return se3.exp(torch.tensor(xi, dtype=torch.float64))


def saved(scene: trimesh.Scene, folder: Path, name: str = "scene.glb") -> Path:
    (folder / name).write_bytes(export_glb(scene))
    return folder / name


def coloured_box(colour: tuple[int, int, int], size: float = 1.0) -> trimesh.Trimesh:
    box = trimesh.creation.box((size, 2 * size, 3 * size))
    box.visual = TextureVisuals(material=PBRMaterial(baseColorFactor=[*colour, 255]))
    return box


def world_vertices(world: World, index: int) -> np.ndarray:
    item = world.objects[index]
    corners = torch.tensor(np.asarray(item.mesh.vertices[item.mesh.faces]).reshape(-1, 3))
    return se3.transform(item.T_world_object, corners).numpy()
