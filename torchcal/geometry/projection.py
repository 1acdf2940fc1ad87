"""How pixels look into the world: pinhole and spherical projections, any leading batch.

Pixel (u, v) is column and row; the centre of the first pixel is (0, 0). A ``ray`` is scaled so that
``range * ray`` is the point: the range of a pinhole is the depth along z, of a spherical sensor the
distance along the ray.
"""

import math
from dataclasses import dataclass, replace
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor


@runtime_checkable
class Projection(Protocol):
    """What the synthesis needs to know of a sensor's optics."""

    @property
    def width(self) -> int:
        """Columns of the image."""
        ...

    @property
    def height(self) -> int:
        """Rows of the image."""
        ...

    def rays(self, u: Tensor, v: Tensor) -> Tensor:
        """Rays ``(*batch, 3)`` of the pixel coordinates ``u`` and ``v``, each ``(*batch,)``."""
        ...

    def ray_derivatives(self, u: Tensor, v: Tensor) -> tuple[Tensor, Tensor]:
        """The derivatives of the rays to u and to v, each ``(*batch, 3)``."""
        ...

    def ray_curvatures(self, u: Tensor, v: Tensor) -> tuple[Tensor, Tensor] | None:
        """The second derivatives of the rays to u and to v; None: all are 0."""
        ...

    def pixels(self, points: Tensor) -> Tensor:
        """Pixel coordinates ``(*batch, 2)`` of points ``(*batch, 3)`` in the sensor's frame."""
        ...

    def ranges(self, points: Tensor) -> Tensor:
        """The range ``(*batch,)`` at which the sensor meets points ``(*batch, 3)``."""
        ...

    def resized(self, factor: int) -> "Projection":
        """The same optics with pixels that each cover ``factor`` x ``factor`` of these."""
        ...

    def divided(self, parts: int) -> "Projection":
        """The same optics with ``parts`` x ``parts`` pixels in the place of each; an odd number."""
        ...

    def widened(self, margin: int) -> "Projection":
        """The same optics with up to ``margin`` more pixels on each side."""
        ...

    def cropped(self, left: int, top: int, width: int, height: int) -> "Projection":
        """The part of the image whose first pixel is (``left``, ``top``)."""
        ...


@dataclass(frozen=True, kw_only=True, slots=True)
class Pinhole:
    """x right, y down, z forward; the range is the depth along z (m)."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float

    def rays(
        self, u: Float[Tensor, "*batch"], v: Float[Tensor, "*batch"]
    ) -> Float[Tensor, "*batch 3"]:
        """Rays ((u - cx)/fx, (v - cy)/fy, 1)."""
        x, y = (u - self.cx) / self.fx, (v - self.cy) / self.fy
        return torch.stack([x, y, torch.ones_like(x)], -1)

    def ray_derivatives(
        self, u: Float[Tensor, "*batch"], v: Float[Tensor, "*batch"]
    ) -> tuple[Float[Tensor, "*batch 3"], Float[Tensor, "*batch 3"]]:
        """The derivatives of the rays to u and to v."""
        along = torch.eye(3, dtype=u.dtype, device=u.device)
        return (
            (along[0] / self.fx).expand(*u.shape, 3),
            (along[1] / self.fy).expand(*v.shape, 3),
        )

    def ray_curvatures(self, u: Float[Tensor, "*batch"], v: Float[Tensor, "*batch"]) -> None:
        """None: the rays are straight in u and v."""

    def pixels(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 2"]:
        """Pixel coordinates (u, v) of points in front of the sensor; meaningless for z <= 0."""
        x, y, z = points.unbind(-1)
        return torch.stack([self.fx * x / z + self.cx, self.fy * y / z + self.cy], -1)

    def ranges(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
        """The depth along z (m)."""
        return points[..., 2]

    def resized(self, factor: int) -> "Pinhole":
        """The same optics with pixels that each cover ``factor`` x ``factor`` of these."""
        shift = (factor - 1) / 2
        return Pinhole(
            width=self.width // factor,
            height=self.height // factor,
            fx=self.fx / factor,
            fy=self.fy / factor,
            cx=(self.cx - shift) / factor,
            cy=(self.cy - shift) / factor,
        )

    def divided(self, parts: int) -> "Pinhole":
        """The same optics with ``parts`` x ``parts`` pixels in the place of each."""
        shift = (parts - 1) / 2
        return Pinhole(
            width=self.width * parts,
            height=self.height * parts,
            fx=self.fx * parts,
            fy=self.fy * parts,
            cx=self.cx * parts + shift,
            cy=self.cy * parts + shift,
        )

    def widened(self, margin: int) -> "Pinhole":
        """The same optics with ``margin`` more pixels on each side."""
        return replace(
            self,
            width=self.width + 2 * margin,
            height=self.height + 2 * margin,
            cx=self.cx + margin,
            cy=self.cy + margin,
        )

    def cropped(self, left: int, top: int, width: int, height: int) -> "Pinhole":
        """The part of the image whose first pixel is (``left``, ``top``)."""
        cx, cy = self.cx - left, self.cy - top
        return replace(self, width=width, height=height, cx=cx, cy=cy)


@dataclass(frozen=True, kw_only=True, slots=True)
class Spherical:
    """Equal steps of azimuth and elevation; the range is the distance along the ray (m)."""

    width: int
    height: int
    azimuth: tuple[float, float]
    """Azimuth (rad) of the centres of the first and of the last column."""
    elevation: tuple[float, float]
    """Elevation (rad) of the centres of the first and of the last row."""

    @property
    def azimuth_step(self) -> float:
        """Azimuth (rad) from one column to the next; a single one is as wide as a row is high."""
        if self.width == 1 and self.height > 1:
            return abs(self.elevation_step)
        return (self.azimuth[1] - self.azimuth[0]) / max(self.width - 1, 1)

    @property
    def elevation_step(self) -> float:
        """Elevation (rad) from one row to the next; a single row is as high as a column is wide."""
        if self.height == 1 and self.width > 1:
            return -abs(self.azimuth_step)
        return (self.elevation[1] - self.elevation[0]) / max(self.height - 1, 1)

    def rays(
        self, u: Float[Tensor, "*batch"], v: Float[Tensor, "*batch"]
    ) -> Float[Tensor, "*batch 3"]:
        """Unit rays (sin az cos el, -sin el, cos az cos el)."""
        az = self.azimuth[0] + u * self.azimuth_step
        el = self.elevation[0] + v * self.elevation_step
        return torch.stack([az.sin() * el.cos(), -el.sin(), az.cos() * el.cos()], -1)

    def ray_derivatives(
        self, u: Float[Tensor, "*batch"], v: Float[Tensor, "*batch"]
    ) -> tuple[Float[Tensor, "*batch 3"], Float[Tensor, "*batch 3"]]:
        """The derivatives of the rays to u and to v."""
        az = self.azimuth[0] + u * self.azimuth_step
        el = self.elevation[0] + v * self.elevation_step
        to_az = torch.stack([az.cos() * el.cos(), torch.zeros_like(az), -az.sin() * el.cos()], -1)
        to_el = torch.stack([-az.sin() * el.sin(), -el.cos(), -az.cos() * el.sin()], -1)
        return to_az * self.azimuth_step, to_el * self.elevation_step

    def ray_curvatures(
        self, u: Float[Tensor, "*batch"], v: Float[Tensor, "*batch"]
    ) -> tuple[Float[Tensor, "*batch 3"], Float[Tensor, "*batch 3"]]:
        """The second derivatives of the rays to u and to v."""
        az = self.azimuth[0] + u * self.azimuth_step
        el = self.elevation[0] + v * self.elevation_step
        to_az = torch.stack([-az.sin() * el.cos(), torch.zeros_like(az), -az.cos() * el.cos()], -1)
        return to_az * self.azimuth_step**2, -self.rays(u, v) * self.elevation_step**2

    def pixels(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 2"]:
        """Pixel coordinates (u, v); the azimuth is taken within pi of the middle of the image."""
        x, y, z = points.unbind(-1)
        middle = 0.5 * (self.azimuth[0] + self.azimuth[1])
        az = torch.remainder(torch.atan2(x, z) - middle + math.pi, 2 * math.pi) - math.pi + middle
        el = torch.atan2(-y, torch.hypot(x, z))
        u = (az - self.azimuth[0]) / (self.azimuth_step or 1.0)
        v = (el - self.elevation[0]) / (self.elevation_step or 1.0)
        return torch.stack([u, v], -1)

    def ranges(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
        """The distance from the sensor (m)."""
        return points.norm(dim=-1)

    def resized(self, factor: int) -> "Spherical":
        """The same optics with pixels that each cover ``factor`` x ``factor`` of these."""
        width, height = self.width // factor, self.height // factor
        shift = (factor - 1) / 2
        az0 = self.azimuth[0] + shift * self.azimuth_step
        el0 = self.elevation[0] + shift * self.elevation_step
        return Spherical(
            width=width,
            height=height,
            azimuth=(az0, az0 + (width - 1) * factor * self.azimuth_step),
            elevation=(el0, el0 + (height - 1) * factor * self.elevation_step),
        )

    def divided(self, parts: int) -> "Spherical":
        """The same optics with ``parts`` x ``parts`` pixels in the place of each."""
        across, up = (
            (parts - 1) / (2 * parts) * step for step in (self.azimuth_step, self.elevation_step)
        )
        return Spherical(
            width=self.width * parts,
            height=self.height * parts,
            azimuth=(self.azimuth[0] - across, self.azimuth[1] + across),
            elevation=(self.elevation[0] - up, self.elevation[1] + up),
        )

    def widened(self, margin: int) -> "Spherical":
        """The same with up to ``margin`` more pixels on each side, at most the whole sphere."""
        turn = (2 * math.pi / abs(self.azimuth_step) - self.width) / 2
        poles = (math.pi / 2 - max(map(abs, self.elevation))) / abs(self.elevation_step)
        sides = max(0, min(margin, int(turn)))
        ends = max(0, min(margin, int(poles)))
        across, up = sides * self.azimuth_step, ends * self.elevation_step
        return Spherical(
            width=self.width + 2 * sides,
            height=self.height + 2 * ends,
            azimuth=(self.azimuth[0] - across, self.azimuth[1] + across),
            elevation=(self.elevation[0] - up, self.elevation[1] + up),
        )

    def cropped(self, left: int, top: int, width: int, height: int) -> "Spherical":
        """The part of the image whose first pixel is (``left``, ``top``)."""
        az, el = self.azimuth_step, self.elevation_step
        az0, el0 = self.azimuth[0] + left * az, self.elevation[0] + top * el
        return Spherical(
            width=width,
            height=height,
            azimuth=(az0, az0 + (width - 1) * az),
            elevation=(el0, el0 + (height - 1) * el),
        )


def pixel_grid(
    projection: Projection, *, dtype: torch.dtype, device: torch.device
) -> tuple[Float[Tensor, "h w"], Float[Tensor, "h w"]]:
    """Pixel coordinates (u, v) of all pixel centres."""
    v = torch.arange(projection.height, dtype=dtype, device=device)
    u = torch.arange(projection.width, dtype=dtype, device=device)
    grid_v, grid_u = torch.meshgrid(v, u, indexing="ij")
    return grid_u, grid_v
