"""The objects of the model as a person's decisions leave them, and how each is painted."""

from dataclasses import dataclass

import numpy as np
import torch
import trimesh
from jaxtyping import Float
from torch import Tensor
from trimesh.visual import TextureVisuals

from torchcal.calibrate.decisions import Decision, Transaction
from torchcal.calibrate.result import AddedObject, Change, PixelClass
from torchcal.display.colours import CLASS_COLOURS, as_bytes
from torchcal.model.meshes import face_colours, painted
from torchcal.model.world import WorldObject, for_gltf

RGB = tuple[int, int, int]


def _paint(member: PixelClass) -> RGB:
    red, green, blue = as_bytes(CLASS_COLOURS[member]).tolist()
    return red, green, blue


GONE = _paint(PixelClass.FARTHER)
"""Seen through, like the pixels that say so."""
NEW = _paint(PixelClass.UNMODELLED)
"""Measured and not in the model."""
GHOST = 0.45
"""Opacity of what a proposal takes away."""
DRAFT = 0.75
"""Opacity of what a proposal adds."""


@dataclass(frozen=True, kw_only=True, slots=True)
class ShownObject:
    """One mesh of the view."""

    name: str
    mesh: trimesh.Trimesh
    T_world_object: Float[Tensor, "4 4"]
    paint: RGB | None = None
    """None: the mesh's own colours."""
    opacity: float = 1.0


def for_browser(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """The mesh with colours that a browser shows as the hybrid image does.

    Colours of the model are those of a screen (sRGB), colours in GLTF are shares of light.
    """
    visual = mesh.visual
    if isinstance(visual, TextureVisuals) and visual.uv is not None:
        return mesh
    screen = face_colours(mesh) / 255.0
    light = np.where(screen <= 0.04045, screen / 12.92, ((screen + 0.055) / 1.055) ** 2.4)
    light[:, 3] = screen[:, 3]
    return for_gltf(painted(mesh, np.round(255.0 * light).astype(np.uint8)))


def shown_objects(transaction: Transaction) -> tuple[ShownObject, ...]:
    """What is accepted stands there, what is rejected does not, what is proposed shines through."""
    changes = {proposal.name: proposal.change for proposal in transaction.update.proposals}
    old = () if transaction.world is None else transaction.world.objects
    shown: list[ShownObject] = []
    for item in old:
        shown += _old(item, changes.get(item.name), transaction)
    for item in transaction.update.added:
        shown += _new(item, transaction.decisions[item.name])
    return tuple(shown)


def _old(item: WorldObject, change: Change | None, transaction: Transaction) -> list[ShownObject]:
    """An object of the job's model: where it was, where it is, or both."""
    there = ShownObject(name=item.name, mesh=item.mesh, T_world_object=item.T_world_object)
    decision = transaction.decisions.get(item.name)
    if change is None or decision == Decision.REJECTED:
        return [there]
    ghost = ShownObject(
        name=item.name,
        mesh=item.mesh,
        T_world_object=item.T_world_object,
        paint=GONE,
        opacity=GHOST,
    )
    # What is adjusted hardly moves: a ghost in the same place would only flicker.
    left = [] if decision == Decision.ACCEPTED or change == Change.ADJUST else [ghost]
    T = transaction.update.verdicts[item.name].T_world_object
    if change == Change.REMOVE or T is None:
        return left
    return [*left, ShownObject(name=item.name, mesh=item.mesh, T_world_object=T)]


def _new(item: AddedObject, decision: Decision) -> list[ShownObject]:
    """A new object: a draft until it is accepted."""
    if decision == Decision.REJECTED:
        return []
    eye = torch.eye(4, dtype=torch.float64)
    opacity = 1.0 if decision == Decision.ACCEPTED else DRAFT
    return [
        ShownObject(name=item.name, mesh=item.mesh, T_world_object=eye, paint=NEW, opacity=opacity)
    ]
