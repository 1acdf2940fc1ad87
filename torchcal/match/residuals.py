"""Whitened residuals of pairs of elements and their analytic derivatives (eq. 7, 13 and 15)."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchcal.geometry import se3
from torchcal.geometry.alignment import orthonormal_axes
from torchcal.match.elements import Elements, Kind
from torchcal.match.pairs import Pairs

OPPOSITE = 1e-9
"""1 + cosine under which two directions are opposite: their angle has no derivative there."""
ACROSS = 1e-6
"""Cosine under which a predicted line or plane never meets the normal space of the measured one."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Whitening:
    """Axes and inverse roots of the noise's covariance of measured elements.

    Components are along the rows of ``axes``: two across the direction and one along it, then the
    turns of the direction towards the first two. Those that a kind of element does not have (along
    a line, in a plane, turns of a point) have zero rows. The axes of points are those of the frame.
    """

    axes: Float[Tensor, "batch element 3 3"]
    root: Float[Tensor, "batch element component component"]
    """L^-1 of the covariance L L^T: W of eq. 8 is its square."""
    present: Bool[Tensor, "batch element component"]

    @staticmethod
    def of(measured: Elements) -> "Whitening":
        """The whitening of measured elements; NaN where a covariance is not definite."""
        is_point = (measured.kind == Kind.POINT)[..., None]
        eye = torch.eye(3).to(measured.point)
        axes = torch.where(is_point[..., None], eye, orthonormal_axes(measured.direction))
        present = _present(measured)
        count = present.shape[-1]
        project = torch.zeros(*axes.shape[:-2], count, 6, dtype=axes.dtype, device=axes.device)
        project[..., :3, :3] = axes
        project[..., 3:, 3:] = axes[..., : count - 3, :]
        project = torch.where(present[..., None], project, 0.0)
        covariance = project @ measured.covariance @ project.mT
        absent = torch.diag_embed((~present).to(axes))
        root, failed = torch.linalg.cholesky_ex(covariance + absent)
        eye = torch.eye(count, dtype=axes.dtype, device=axes.device).expand_as(root)
        inverse = torch.linalg.solve_triangular(root, eye, upper=False)
        inverse = torch.where(present[..., None], inverse, 0.0)
        inverse = torch.where((failed == 0)[..., None, None], inverse, torch.nan)
        return Whitening(axes=axes, root=inverse, present=present)


@dataclass(frozen=True, kw_only=True, slots=True)
class PairResiduals:
    """The measurement equation (7) of a batch of lists of pairs."""

    kind: Int[Tensor, "batch pair"]
    directed: bool
    """Whether any pair is of lines or planes."""
    p: Float[Tensor, "batch pair 3"]
    """Points of the model's elements (m) and, below, their directions."""
    d: Float[Tensor, "batch pair 3"]
    q: Float[Tensor, "batch pair 3"]
    """Points of the measured elements (m)."""
    axes: Float[Tensor, "batch pair 3 3"]
    root: Float[Tensor, "batch pair component component"]
    present: Bool[Tensor, "batch pair component"]
    """False for components that a kind does not have and for padding."""

    @staticmethod
    def of(
        model: Elements,
        measured: Elements,
        whitening: Whitening,
        batch: Int[Tensor, " problem"],
        pairs: Pairs,
    ) -> "PairResiduals":
        """Residuals of one list of pairs for each problem.

        Args:
            model: Elements of each member of the batch.
            measured: Elements of each member of the batch.
            whitening: Of ``measured``.
            batch: The member of the batch that each problem belongs to.
            pairs: A list for each problem.
        """
        rows = batch[:, None]
        own, others = (rows, pairs.model), (rows, pairs.measured)
        return PairResiduals(
            kind=model.kind[own],
            directed=whitening.present.shape[-1] > 3,
            p=model.point[own],
            d=model.direction[own],
            q=measured.point[others],
            axes=whitening.axes[others],
            root=whitening.root[others],
            present=whitening.present[others] & pairs.valid[..., None],
        )

    def linearise(
        self, T: Float[Tensor, "active 4 4"], problem: Int[Tensor, " active"]
    ) -> tuple[Float[Tensor, "active pair component"], Float[Tensor, "active pair component 6"]]:
        """Residuals v (eq. 15) and the derivative A of the prediction (eq. 13) to a twist of ``T``.

        Both are whitened; the pose changes as ``T @ exp(twist)``.

        Args:
            T: Poses of some of the problems.
            problem: Which ones.
        """
        R, p, root = T[:, :3, :3], self.p[problem], self.root[problem]
        offset = se3.transform(T, p) - self.q[problem]
        if not self.directed:
            v = -_times(root, offset)
            rows = _turned(root, R)
            return v, torch.cat([rows, _cross(p, rows)], -1)
        d = self.d[problem]
        error, moved, turned = _directed_rows(
            self.kind[problem], self.axes[problem], offset, d @ R.mT
        )
        rows, turns = _turned(root @ moved, R), _turned(root @ turned, R)
        return -_times(root, error), torch.cat([rows, _cross(p, rows) + _cross(d, turns)], -1)

    def residual(
        self, T: Float[Tensor, "active 4 4"], problem: Int[Tensor, " active"]
    ) -> Float[Tensor, "active pair component"]:
        """Residuals v (eq. 15) alone."""
        return self.linearise(T, problem)[0]


def _present(measured: Elements) -> Tensor:
    """Which components each element has; three where all are points, else five."""
    table = torch.tensor(
        [[1, 1, 1, 0, 0], [1, 1, 0, 1, 1], [0, 0, 1, 1, 1]], device=measured.kind.device
    ).bool()
    present = table[measured.kind]
    return present if measured.directed else present[..., :3]


def _cross(point: Tensor, rows: Tensor) -> Tensor:
    """The cross products of points with each of several rows."""
    return torch.linalg.cross(point[..., None, :].expand_as(rows), rows)


def _times(matrix: Tensor, vector: Tensor) -> Tensor:
    """Products of many small matrices with a vector each."""
    return (matrix @ vector[..., None])[..., 0]


def _turned(rows: Tensor, R: Tensor) -> Tensor:
    """``rows @ R`` for all pairs of a problem in one product."""
    return (rows.flatten(1, 2) @ R).view(rows.shape)


def _directed_rows(
    kind: Tensor, axes: Tensor, offset: Tensor, e: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Errors of all five components, with their derivatives to the point and to the direction.

    A predicted line or plane is compared where it meets the normal space of the measured one at
    that one's point, so that it does not matter which of its points the model names.
    """
    across, n = axes[..., :2, :], axes[..., 2, :]
    is_point, is_line = (kind == Kind.POINT)[..., None], (kind == Kind.LINE)[..., None]
    cosine = (n * e).sum(-1, keepdim=True)
    flat = torch.where(is_point | (cosine.abs() < ACROSS), 1.0, cosine)
    # Line: to the plane across the measured line. Plane: along the measured normal.
    shift = -(n * offset).sum(-1, keepdim=True) / flat
    height = (e * offset).sum(-1, keepdim=True) / flat
    at_line = offset + torch.where(is_line, shift, 0.0) * e
    error = torch.cat([(across @ at_line[..., None])[..., 0], (n * offset).sum(-1)[..., None]], -1)
    error = torch.where(is_point | is_line, error, height)
    slide = across - (across @ e[..., None]) * (n / flat)[..., None, :]
    rows_point, rows_line = axes, torch.cat([slide, n[..., None, :]], -2)
    rows_plane = (e / flat)[..., None, :].expand_as(axes)
    foot = ((offset - height * n) / flat)[..., None, :].expand_as(axes)
    select = is_line[..., None]
    rows = torch.where(is_point[..., None], rows_point, torch.where(select, rows_line, rows_plane))
    turns = torch.where(select, shift[..., None] * rows_line, foot)
    turns = torch.where(is_point[..., None], 0.0, turns)
    turn, turn_rows = _turns(is_line, across, n, e, cosine)
    return (
        torch.cat([error, turn], -1),
        torch.cat([rows, torch.zeros_like(turn_rows)], -2),
        torch.cat([turns, turn_rows], -2),
    )


def _turns(
    is_line: Tensor, across: Tensor, n: Tensor, e: Tensor, cosine: Tensor
) -> tuple[Tensor, Tensor]:
    """The direction's error: as long as the chord to it, so it grows up to opposite directions."""
    sense = torch.where(is_line & (cosine < 0), -1.0, 1.0)
    e, cosine = sense * e, sense * cosine
    half = (1.0 + cosine).clamp(min=OPPOSITE)
    stretch = (2.0 / half).sqrt()
    sideways = (across @ e[..., None])[..., 0]
    rows = stretch[..., None] * (across - 0.5 * (sideways / half)[..., None] * n[..., None, :])
    return stretch * sideways, sense[..., None] * rows
