"""The CAD model of the surroundings: named objects with poses, read from and written to files."""

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
import trimesh
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor
from trimesh.exchange.gltf import export_glb
from trimesh.visual import ColorVisuals, TextureVisuals
from trimesh.visual.material import PBRMaterial, SimpleMaterial

from torchcal.errors import JobError
from torchcal.model.meshes import (
    FARTHEST,
    face_colours,
    merged,
    reach,
    read_scene,
    transformed,
    triangles,
)
from torchcal.model.replaced_file import replace_file
from torchcal.model.tensor_mistakes import check_floats

_ONE_OBJECT_FORMATS = (".stl", ".ply", ".off")


@dataclass(frozen=True, kw_only=True, slots=True)
class WorldObject:
    """One named node of the world's file.

    Raises:
        TorchcalError: If its pose is no 4x4 matrix.
    """

    name: str
    mesh: trimesh.Trimesh
    """In the object's own frame, metres."""
    T_world_object: Float[Tensor, "4 4"]
    extras: Mapping[str, Any] = field(default_factory=dict)
    """What a GLTF says of the node beside its geometry: plain data."""

    def __post_init__(self):
        check_floats("WorldObject.T_world_object", self.T_world_object, 4, 4)


@dataclass(frozen=True, kw_only=True, slots=True)
class World:
    """Everything that stands around the robot."""

    objects: tuple[WorldObject, ...]
    complete: bool = False
    """What the file leaves empty is known to be empty."""


@dataclass(frozen=True, kw_only=True, slots=True)
class _Piece:
    """One mesh of the file and the object that it belongs to."""

    name: str
    mesh: trimesh.Trimesh
    T_file_mesh: NDArray[np.float64]
    T_file_object: NDArray[np.float64]
    """The object's node; any matrix, in units of the file."""
    extras: Mapping[str, Any]
    """The object's node's."""


def load_world(
    file: Path, *, unit: float, T_world_file: Float[Tensor, "4 4"], complete: bool
) -> World:
    """Reads any scene that trimesh reads; every named node with triangles is one object.

    A node's rotation and translation become ``T_world_object``, its scale and shear go into the
    mesh. No axis is turned. Faces without an area, with NaN, or that are there twice are dropped.
    A file that cannot name its objects is one object with the file's name. Objects are sorted by
    name.

    Args:
        file: GLB, GLTF, OBJ, PLY, STL and others.
        unit: Metres of one unit of the file.
        T_world_file: Where the file's frame stands in the world (m); gives dtype and device.
        complete: What the file leaves empty is known to be empty.

    Raises:
        JobError: If the file is missing or broken, has no triangles, or an object in it lies
            ``FARTHEST`` or nowhere.
    """
    named: dict[str, list[_Piece]] = {}
    for piece in _pieces(file):
        named.setdefault(piece.name, []).append(piece)
    if not named:
        raise JobError(
            file, "", "no triangles (points and lines do not count)", "a scene of meshes"
        )
    for name in sorted(named):
        _check_reach(file, name, named[name], unit)
    objects = tuple(_object(name, named[name], unit, T_world_file) for name in sorted(named))
    return World(objects=objects, complete=complete)


def write_world(world: World, file: Path, extras: Mapping[str, Any] | None = None) -> None:
    """Writes GLB that ``load_world`` reads (unit 1, no motion) with the same names and poses.

    Until all of it is written an earlier file stays as it was.

    Args:
        world: Without objects the scene is empty, and ``load_world`` says so.
        file: Its ending is ``.glb``.
        extras: Plain data about the whole scene; ``read_extras`` gives it back.

    Raises:
        ValueError: If the file's ending is another.
    """
    if file.suffix.lower() != ".glb":
        raise ValueError(f"found {file}; expected a name that ends in .glb")
    longer_than_any_name = "/" + "".join(item.name for item in world.objects)
    scene = trimesh.Scene(base_frame=longer_than_any_name, metadata=dict(extras or {}))
    for item in world.objects:
        scene.add_geometry(
            for_gltf(item.mesh),
            node_name=item.name,
            geom_name=item.name,
            transform=item.T_world_object.detach().cpu().double().numpy(),
            metadata=dict(item.extras),
        )
    replace_file(file, export_glb(scene))


def read_extras(file: Path) -> dict[str, Any]:
    """What ``write_world`` was told of the whole scene; empty where nothing is said."""
    scenes = _gltf(file).get("scenes", [])
    return scenes[0].get("extras", {}) if scenes else {}


def for_gltf(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """GLTF knows colours of vertices only: faces of different colours must not share any."""
    if not _has_face_colours(mesh):
        return _with_plain_texture(mesh.copy())
    corners = mesh.vertices[mesh.faces].reshape(-1, 3)
    faces = np.arange(len(corners)).reshape(-1, 3)
    colours = np.repeat(face_colours(mesh), 3, axis=0)
    return trimesh.Trimesh(corners, faces, vertex_colors=colours, process=False)


def _has_face_colours(mesh: trimesh.Trimesh) -> bool:
    """Whether trimesh's export would lose colours: a material's vertex colours go missing too."""
    if isinstance(mesh.visual, ColorVisuals):
        return mesh.visual.kind == "face"
    return isinstance(mesh.visual, TextureVisuals) and "color" in mesh.visual.vertex_attributes


def _with_plain_texture(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """GLTF multiplies a texture by the diffuse colour, which an OBJ gives for its absence."""
    visual = mesh.visual
    if isinstance(visual, TextureVisuals) and isinstance(visual.material, SimpleMaterial):
        image = visual.material.image
        if image is not None:
            visual.material = PBRMaterial(name=visual.material.name, baseColorTexture=image)
    return mesh


def _pieces(file: Path) -> Iterator[_Piece]:
    scene = read_scene(file)
    names = _object_names(file, scene)
    for node in scene.graph.nodes_geometry:
        T_file_mesh, geometry = scene.graph[node]
        mesh = triangles(scene.geometry[geometry])
        if mesh is not None and _keeps_areas(T_file_mesh):
            owner = _owner(scene, node)
            yield _Piece(
                name=names[node],
                mesh=mesh,
                T_file_mesh=T_file_mesh,
                T_file_object=scene.graph[owner][0],
                extras=_node_extras(scene, owner),
            )


def _keeps_areas(T: NDArray[np.float64]) -> bool:
    """Whether something is left of a mesh under a matrix: a scale of 0 hides a node."""
    return not np.isfinite(T).all() or bool(np.linalg.matrix_rank(T[:3, :3]) >= 2)


def _owner(scene: trimesh.Scene, node: str) -> str:
    """The named node of a mesh: a GLTF mesh of several materials is split into children of it."""
    geometry = scene.geometry[scene.graph[node][1]]
    parent = scene.graph.transforms.parents.get(node)
    return parent if parent and geometry.metadata.get("from_gltf_primitive") else node


def _node_extras(scene: trimesh.Scene, node: str) -> Mapping[str, Any]:
    """What the file says of a node."""
    tree = scene.graph.transforms
    return tree.edge_data.get((tree.parents.get(node), node), {}).get("metadata") or {}


def _object_names(file: Path, scene: trimesh.Scene) -> dict[str, str]:
    """The object of every node with geometry."""
    nodes = list(scene.graph.nodes_geometry)
    if file.suffix.lower() in _ONE_OBJECT_FORMATS:
        return dict.fromkeys(nodes, file.stem)
    if file.suffix.lower() == ".obj":
        objects = _obj_objects(file)
        return {node: _obj_object(scene, node, objects) or file.stem for node in nodes}
    renamed = _renamed_nodes(file)
    return {node: renamed.get(_owner(scene, node), _owner(scene, node)) for node in nodes}


def _renamed_nodes(file: Path) -> dict[str, str]:
    """Names of a GLTF's nodes that trimesh changes: its own root is ``world``."""
    if file.suffix.lower() not in (".glb", ".gltf"):
        return {}
    names = {node.get("name") for node in _gltf(file).get("nodes", [])}
    return {"world_1": "world"} if "world" in names and "world_1" not in names else {}


def _gltf(file: Path) -> dict[str, Any]:
    """The JSON of a GLB or GLTF."""
    data = file.read_bytes()
    if data.startswith(b"glTF"):
        data = data[20 : 20 + int.from_bytes(data[12:16], "little")]
    return json.loads(data)


def _obj_objects(file: Path) -> set[str]:
    lines = file.read_text(encoding="utf-8", errors="replace").splitlines()
    return {line[2:].strip() for line in lines if line.startswith("o ")}


def _obj_object(scene: trimesh.Scene, node: str, objects: set[str]) -> str | None:
    """The ``o`` of a part of an OBJ: its parts of several materials are named object_material."""
    if node in objects:
        return node
    material = getattr(scene.geometry[scene.graph[node][1]].visual, "material", None)
    name = node.removesuffix(f"_{getattr(material, 'name', '')}")
    return name if name in objects else None


def _check_reach(file: Path, name: str, pieces: list[_Piece], unit: float) -> None:
    for piece in pieces:
        farthest = unit * reach(piece.mesh, piece.T_file_mesh)
        if not farthest <= FARTHEST or not np.isfinite(piece.T_file_object).all():
            found = f"the object {name} with a coordinate of {farthest:g} m"
            expected = f"finite numbers of at most {FARTHEST:g} m; is world.unit = {unit:g} right?"
            raise JobError(file, "", found, expected)


def _object(
    name: str, pieces: list[_Piece], unit: float, T_world_file: Float[Tensor, "4 4"]
) -> WorldObject:
    """One object of its pieces, in the frame of its node."""
    R = _rotation(pieces[0].T_file_object[:3, :3])
    T_file_object = np.eye(4)
    T_file_object[:3, :3], T_file_object[:3, 3] = R, pieces[0].T_file_object[:3, 3]
    T_object_file = np.linalg.inv(T_file_object)
    scale = np.diag([unit, unit, unit, 1.0])
    meshes = [
        transformed(piece.mesh, _tidy(scale @ T_object_file @ piece.T_file_mesh))
        for piece in pieces
    ]
    T_file_object[:3, 3] *= unit
    pose = torch.as_tensor(T_file_object, dtype=T_world_file.dtype, device=T_world_file.device)
    return WorldObject(
        name=name,
        mesh=merged(meshes),
        T_world_object=T_world_file @ pose,
        extras=pieces[0].extras,
    )


def _tidy(T: NDArray[np.float64]) -> NDArray[np.float64]:
    """Without the rounding of a node that does not scale: its mesh stays bit for bit."""
    return np.eye(4) if np.allclose(T, np.eye(4), rtol=0.0, atol=1e-12) else T


def _rotation(A: NDArray[np.float64]) -> NDArray[np.float64]:
    """The rotation nearest to a matrix: the first factor of its polar decomposition."""
    U, _, Vt = np.linalg.svd(A)
    return U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
