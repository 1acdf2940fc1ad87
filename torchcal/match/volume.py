"""Where a cloud of points lies on a surface, for all positions at once: correlation of voxels."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

CELLS = 52
"""Voxels along the longest side of the model."""
LEAST_CELLS = 24
"""Along the shorter sides: what lies beside the model is not to fold onto it at once."""
BLUR = 0.8
"""Voxels: standard deviation by which the surface is smeared."""
SAMPLES = 4
"""Points of the surface on the area of a voxel's side, drawn at random."""
CROSSED = 0.5
"""What a ray loses that the surface blocks, for each that it gains by ending on the surface."""
ALONG = (0.25, 0.4, 0.55, 0.7, 0.85)
"""Share of the range at which a ray must be free."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Volume:
    """Voxels that a surface passes through, ready for correlations."""

    origin: Float[Tensor, "3"]
    """m: the corner of the first voxel."""
    side: float
    """m: of a voxel."""
    spectrum: Float[Tensor, "_ _ _ 2"]
    """Of the occupancy, by ``torch.fft.rfftn``; as real numbers."""
    blur: Float[Tensor, "_ _ _"]
    """Transfer function that smears the surface."""
    size: tuple[int, int, int]

    @staticmethod
    def of(triangles: Float[Tensor, "face 3 3"], generator: torch.Generator) -> "Volume":
        """Voxels about triangles (m).

        Args:
            triangles: Corners.
            generator: Draws the points of the surface; on the CPU.
        """
        low, high = triangles.flatten(0, 1).amin(0), triangles.flatten(0, 1).amax(0)
        side = float((high - low).max()) / CELLS
        needed = ((high - low) / side).ceil().long() + 4
        x, y, z = (_smooth(max(n, LEAST_CELLS)) for n in needed.tolist())
        points = _sampled(triangles, side, generator)
        origin = low - 2.0 * side
        size = (x, y, z)
        occupied = _counted(points - origin, side, size).clamp(max=1.0)
        return Volume(
            origin=origin,
            side=side,
            spectrum=torch.view_as_real(torch.fft.rfftn(occupied)),
            blur=_gaussian(size, like=occupied),
            size=size,
        )

    def scores(self, offsets: Float[Tensor, "point 3"]) -> Float[Tensor, "x y z"]:
        """How well the points fit for each position of the origin of their rays.

        Args:
            offsets: Points (m) from the origin of their rays, in the model's axes.

        Returns:
            About the share of points on the surface, less the rays that it blocks; at the corners
            of the voxels, counted from ``origin`` and repeating with the size of the volume.
        """
        ends = torch.fft.rfftn(_counted(offsets, self.side, self.size))
        before = torch.cat([share * offsets for share in ALONG])
        rays = torch.fft.rfftn(_counted(before, self.side, self.size)) / len(ALONG)
        kernel = (self.blur * ends - CROSSED * rays).conj()
        spectrum = torch.view_as_complex(self.spectrum) * kernel
        return torch.fft.irfftn(spectrum, s=self.size) / max(len(offsets), 1)

    def places(
        self, index: Float[Tensor, "place 3"], offsets: Float[Tensor, "point 3"]
    ) -> Float[Tensor, "place 3"]:
        """Positions (m) of scores: of those that repeat, the one whose points are at the model.

        Args:
            index: Of the voxels.
            offsets: As in ``scores``.
        """
        length = self.side * torch.tensor(self.size).to(offsets)
        middle = self.origin + 0.5 * length - offsets.mean(0)
        raw = self.origin + self.side * index
        return raw + length * ((middle - raw) / length).round()


def peaks(
    scores: Float[Tensor, "x y z"], count: int
) -> tuple[Float[Tensor, " peak"], Float[Tensor, "peak 3"]]:
    """The highest voxels that no neighbour exceeds, and their indices."""
    highest = scores
    for axis in range(3):  # one after the other: far fewer comparisons than of all neighbours
        sides = highest.roll(1, axis), highest.roll(-1, axis)
        highest = torch.maximum(highest, torch.maximum(*sides))
    alone = torch.where(scores >= highest, scores, -torch.inf).flatten()
    best = alone.topk(min(count, alone.numel()))
    _, y, z = scores.shape
    index = torch.stack([best.indices // (y * z), best.indices // z % y, best.indices % z], -1)
    return best.values, index.to(scores)


def _counted(points: Tensor, side: float, size: tuple[int, int, int]) -> Tensor:
    """Points in each voxel; those beyond the volume come in on the other side."""
    cell = (points / side).floor().long()
    x, y, z = (cell[:, i] % size[i] for i in range(3))
    flat = (x * size[1] + y) * size[2] + z
    return flat.bincount(minlength=math.prod(size)).view(size).to(torch.float32)


def _sampled(triangles: Tensor, side: float, generator: torch.Generator) -> Tensor:
    """Points drawn from the surface, and all corners."""
    one, two = triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    area = 0.5 * torch.linalg.cross(one, two).norm(dim=-1)
    count = (SAMPLES * area / side**2).ceil().long().cpu()
    of = torch.repeat_interleave(count)
    shares = torch.rand(len(of), 2, generator=generator).to(triangles)
    shares = torch.where(shares.sum(1, keepdim=True) > 1.0, 1.0 - shares, shares)
    drawn = triangles[of, 0] + shares[:, :1] * one[of] + shares[:, 1:] * two[of]
    return torch.cat([drawn, triangles.flatten(0, 1)])


def _gaussian(size: tuple[int, int, int], *, like: Tensor) -> Tensor:
    x, y = (torch.fft.fftfreq(n).to(like) for n in size[:2])
    z = torch.fft.rfftfreq(size[2]).to(like)
    squared = x[:, None, None] ** 2 + y[:, None] ** 2 + z**2
    smeared = torch.exp(-2.0 * (math.pi * BLUR) ** 2 * squared)
    # A smeared sheet is as high as its width is small: 1 again where it was.
    return smeared * BLUR * math.sqrt(2.0 * math.pi)


def _smooth(n: int) -> int:
    """The next number without prime factors above 5, for which transforms are fast."""
    while True:
        rest = n
        for factor in (2, 3, 5):
            while rest % factor == 0:
                rest //= factor
        if rest == 1:
            return n
        n += 1
