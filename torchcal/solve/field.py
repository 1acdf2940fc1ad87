"""A slowly varying error over an image, as part of the noise's covariance (W of eq. 8).

The error is a Gaussian field: cubic B-splines on a coarse grid with independent coefficients, whose
correlation is close to exp(-d^2 / (2 L^2)). Marginalising the coefficients is exact and keeps the
normal equations small: only a matrix of the size of the grid is factorised.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

SPACING = 1.5**0.5
"""Grid spacing in correlation lengths: cubic B-splines then correlate with length L."""
VARIANCE = (151.0 / 315.0) ** 2
"""Mean over a cell of the sum of squares of the two-dimensional cubic B-splines."""
TOLD = 1e-9
"""Share of the prior's precision below which the pixels tell nothing about a coefficient."""
BAND = 3
"""Cubic B-splines overlap with three neighbours on each side."""


@dataclass(frozen=True, kw_only=True, slots=True)
class SmoothField:
    """A Gaussian field over an image: Phi a with independent coefficients a."""

    rows: Float[Tensor, "h row"]
    """Splines along v; Phi is the product of both directions."""
    columns: Float[Tensor, "w column"]
    """Splines along u."""
    precision: float
    """Of every coefficient (1/m^2)."""

    @staticmethod
    def of(height: int, width: int, *, sigma: float, pixels: float, like: Tensor) -> "SmoothField":
        """The field with this standard deviation (m) and correlation length (pixels)."""
        return SmoothField(
            rows=_splines(height, SPACING * pixels, like),
            columns=_splines(width, SPACING * pixels, like),
            precision=VARIANCE / sigma**2,
        )

    def project(self, images: Float[Tensor, "*batch h w"]) -> Float[Tensor, "*batch coefficient"]:
        """Phi^T x for each image."""
        return (self.rows.mT @ images @ self.columns).flatten(-2)

    def expand(
        self, coefficients: Float[Tensor, "*batch coefficient"]
    ) -> Float[Tensor, "*batch h w"]:
        """Phi a, the field (m)."""
        grid = coefficients.unflatten(-1, (self.rows.shape[1], self.columns.shape[1]))
        return self.rows @ grid @ self.columns.mT

    def peaks(self) -> tuple[Int[Tensor, " row"], Int[Tensor, " column"]]:
        """The v and the u of the pixels where the splines are largest."""
        return self.rows.argmax(0), self.columns.argmax(0)

    def system(self, weight: Float[Tensor, "h w"]) -> "FieldSystem":
        """Phi^T W Phi + prior, factorised, for the coefficients that some pixel tells about.

        Args:
            weight: The diagonal of W (1/m^2).
        """
        matrix = _gram(self.rows, self.columns, weight)
        told = torch.nonzero(matrix.diagonal() > TOLD * self.precision)[:, 0]
        matrix = matrix[told[:, None], told]
        matrix.diagonal().add_(self.precision)
        return FieldSystem(
            told=told,
            factor=torch.linalg.cholesky_ex(matrix)[0],
        )


@dataclass(frozen=True, kw_only=True, slots=True)
class FieldSystem:
    """The factorised normal equations of a field's coefficients."""

    told: Int[Tensor, " told"]
    """Coefficients that the pixels tell about; the others stay at their prior, 0."""
    factor: Float[Tensor, "told told"]

    def solve(
        self, right: Float[Tensor, "*batch coefficient"]
    ) -> Float[Tensor, "*batch coefficient"]:
        """(Phi^T W Phi + prior)^-1 applied to each row; 0 for coefficients that are not told."""
        rows = right.reshape(-1, right.shape[-1])
        solved = torch.zeros_like(rows)
        solved[:, self.told] = torch.cholesky_solve(rows[:, self.told].mT, self.factor).mT
        return solved.view(right.shape)


def _splines(size: int, spacing: float, like: Tensor) -> Tensor:
    """Cubic B-splines at every pixel; knots reach one spacing beyond both ends."""
    count = int((size - 1) / spacing) + 4
    place = torch.arange(size, dtype=like.dtype, device=like.device) / spacing
    knot = torch.arange(count, dtype=like.dtype, device=like.device) - 1.0
    d = (place[:, None] - knot).abs()
    inner = 2.0 / 3.0 - d.square() + 0.5 * d**3
    outer = (2.0 - d).clamp(min=0.0) ** 3 / 6.0
    return torch.where(d < 1.0, inner, outer)


def _gram(rows: Tensor, columns: Tensor, weight: Tensor) -> Tensor:
    """Phi^T W Phi from products of neighbouring splines, one pair of offsets at a time."""
    height, width = rows.shape[1], columns.shape[1]
    gram = rows.new_zeros(height, width, height, width)
    for dy in range(min(BAND, height - 1) + 1):
        pair = rows[:, : height - dy] * rows[:, dy:]
        banded = pair.mT @ weight
        i = torch.arange(height - dy, device=rows.device)[:, None]
        for dx in range(-min(BAND, width - 1), min(BAND, width - 1) + 1):
            k = torch.arange(max(0, -dx), width - max(0, dx), device=rows.device)
            value = banded @ (columns[:, k] * columns[:, k + dx])
            gram[i, k, i + dy, k + dx] = value
            gram[i + dy, k + dx, i, k] = value
    return gram.view(height * width, height * width)
