"""A range image in blocks of pixels that its beam blurs together anyway: nothing is lost by it."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from numpy import ndarray
from torch import Tensor

from torchcal.match.image.windows import Image

FINE = 10
"""Blocks in the beam's side, at the least: their own width is below 1 % of the blur's."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Blocks:
    """Means over square blocks all of whose pixels were measured."""

    range: Float[ndarray, "h w"]
    """m; 1 where something was not measured."""
    valid: Bool[ndarray, "h w"]
    sigma: Float[ndarray, "h w"]
    """The standard deviation (m) of the mean's noise."""
    rays: Float[ndarray, "h w 3"]
    side: int
    """Pixels."""
    beam: float
    """Pixels: the side of the box that blurs as much as the beam and the block together."""

    @property
    def offset(self) -> float:
        """Pixels from the image's first pixel to the middle of the first block."""
        return 0.5 * (self.side - 1)

    def slopes(
        self, rows: Int[ndarray, " block"], columns: Int[ndarray, " block"]
    ) -> Float[ndarray, "block 2 3"]:
        """The derivatives of some blocks' rays to the right and down, for each pixel."""
        h, w = self.valid.shape
        right, down = np.clip(columns + 1, 1, w - 1), np.clip(rows + 1, 1, h - 1)
        du = self.rays[rows, right] - self.rays[rows, right - 1]
        dv = self.rays[down, columns] - self.rays[down - 1, columns]
        return np.stack([du, dv], 1) / self.side

    def of(self, label: Int[ndarray, "height width"]) -> Int[ndarray, "h w"]:
        """The label of each block all of whose pixels have the same; -1 for the others."""
        h, w = self.valid.shape
        parts = label[: h * self.side, : w * self.side].reshape(h, self.side, w, self.side)
        low, high = parts.min((1, 3)), parts.max((1, 3))
        return np.where(low == high, low, -1)


def in_blocks(image: Image) -> Blocks:
    """Blocks as large as the beam allows; those that the image's border cuts are left out."""
    beam = max(image.sensor.beam, 1)
    side = max(1, beam // FINE)
    valid = -torch.nn.functional.max_pool2d(-image.valid.to(image.range)[None], side)[0] > 0
    mean = _means(image.range[None], side)[0]
    variance = _means(image.sigma.square()[None], side)[0] / side**2
    return Blocks(
        range=torch.where(valid, mean, 1.0).numpy(),
        valid=valid.numpy(),
        sigma=variance.sqrt().numpy(),
        rays=np.ascontiguousarray(_means(image.rays.permute(2, 0, 1), side).permute(1, 2, 0)),
        side=side,
        beam=float((beam**2 + side**2 - 1) ** 0.5),
    )


def _means(layers: Float[Tensor, "layer h w"], side: int) -> Tensor:
    return torch.nn.functional.avg_pool2d(layers, side) if side > 1 else layers
