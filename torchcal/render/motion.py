"""How the bodies of a scene move with the unknown parameters."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchcal.model.scene import Surface


@dataclass(frozen=True, kw_only=True, slots=True)
class BodyMotion:
    """The motion of all bodies in a batch of views; bodies that move alike are one kind."""

    kinds: Float[Tensor, "view kind parameter 6"]
    """Twist (m, rad) in the sensor's frame per unit of each parameter."""
    body_kind: Int[Tensor, " body"]
    """Of the bodies of all views, one view after the other."""
    face_body: Int[Tensor, " face"]
    """Of the faces of all views."""

    @staticmethod
    def of(motion: Float[Tensor, "view body 6 parameter"], surface: Surface) -> "BodyMotion":
        """Finds the bodies that move alike in all views; ``surface`` holds those of all views."""
        views, bodies = motion.shape[:2]
        first, kind = _alike(motion.transpose(0, 1).flatten(1))
        return BodyMotion(
            kinds=motion[:, first].mT.contiguous(),
            body_kind=kind.expand(views, bodies).flatten(),
            face_body=surface.vertex_body[surface.faces[:, 0]],
        )

    def of_images(
        self, twist_derivative: Float[Tensor, "6 view h w"], face: Int[Tensor, "view h w"]
    ) -> Float[Tensor, "view parameter h w"]:
        """Chain rule from the twists of faces seen in pixels to the parameters."""
        views, height, width = face.shape
        twists = twist_derivative.transpose(0, 1).flatten(2)
        result = self.kinds[:, 0] @ twists
        if self.kinds.shape[1] > 1:
            kind = self.body_kind[self.face_body[face.clamp(min=0)]].view(views, 1, -1)
            for i in range(1, self.kinds.shape[1]):
                result = torch.where(kind == i, self.kinds[:, i] @ twists, result)
        return result.view(views, self.kinds.shape[2], height, width)

    def of_faces(
        self,
        twist_derivative: Float[Tensor, "row 6"],
        face: Int[Tensor, " row"],
        view: Int[Tensor, " row"],
    ) -> Float[Tensor, "row parameter"]:
        """Chain rule from the twists of faces to the parameters."""
        return self.of_bodies(twist_derivative, self.face_body[face.clamp(min=0)], view)

    def of_bodies(
        self,
        twist_derivative: Float[Tensor, "row 6"],
        body: Int[Tensor, " row"],
        view: Int[Tensor, " row"],
    ) -> Float[Tensor, "row parameter"]:
        """Chain rule from the twists of bodies to the parameters."""
        motion = self.kinds[view, self.body_kind[body]]
        return (motion * twist_derivative[:, None]).sum(-1)


def _alike(rows: Tensor) -> tuple[Tensor, Tensor]:
    """One row of each kind of equal rows; the kind of every row."""
    if rows.shape[1] == 0:  # torch.unique knows no rows of length 0
        kind = torch.zeros(len(rows), dtype=torch.int64, device=rows.device)
        return kind[:1], kind
    kinds, kind = torch.unique(rows, dim=0, return_inverse=True)
    order = torch.arange(len(rows), device=rows.device)
    first = order.new_zeros(len(kinds)).scatter_reduce(0, kind, order, "amin", include_self=False)
    return first, kind
