"""From a range image to its elements (3.1 (2))."""

from dataclasses import replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchcal.match.features import Features
from torchcal.match.image.blocks import Blocks, in_blocks
from torchcal.match.image.consensus import explained
from torchcal.match.image.creases import Found
from torchcal.match.image.growth import grow_regions
from torchcal.match.image.jumps import blurred_by
from torchcal.match.image.labels import Planar, label_pixels
from torchcal.match.image.lines import image_jumps, image_lines
from torchcal.match.image.planes import image_planes
from torchcal.match.image.vertices import image_vertices
from torchcal.match.image.windows import Image, fit_windows, prepared
from torchcal.model.sensor import Sensor

STRIDE = 4
"""Pixels from one window to the next."""


def image_features(
    range_image: Float[Tensor, "h w"], sensor: Sensor, mask: Bool[Tensor, "h w"] | None = None
) -> Features:
    """Planes, straight lines and vertexes of one range image, in the sensor's frame.

    Args:
        range_image: Depth or distance (m), as the projection has it; NaN, 0 or a value out of the
            sensor's limits where nothing was measured.
        sensor: Optics, beam and noise: the blur moves no border, and the noise says what is sure.
        mask: Pixels that may be used; None: all.

    Returns:
        The elements with the covariances that the noise gives them (eq. 8), on the image's device.
    """
    image = prepared(range_image, sensor, mask)
    blocks = in_blocks(image)
    jumping = image_jumps(image, blocks)
    planar = _planar(image, blocks, jumping)
    lines = image_lines(image, blocks, planar, jumping)
    found = Features(
        planes=image_planes(image, blocks, planar), lines=lines, vertices=image_vertices(lines)
    )
    return found.to(range_image.device)


def image_labels(
    range_image: Float[Tensor, "h w"], sensor: Sensor, mask: Bool[Tensor, "h w"] | None = None
) -> Int[Tensor, "h w"]:
    """The plane of ``image_features`` that explains each pixel, the largest of those; -1: none."""
    image = prepared(range_image, sensor, mask)
    blocks = in_blocks(image)
    planar = _planar(image, blocks, image_jumps(image, blocks))
    return torch.from_numpy(explained(image, planar)).to(range_image.device)


def _planar(image: Image, blocks: Blocks, jumping: list[Found]) -> Planar:
    """Planes are fitted to what jumps do not blur."""
    beam = image.sensor.beam
    blurred = torch.from_numpy(blurred_by(image, jumping)) & (beam > 1)
    clear = replace(image, valid=image.valid & ~blurred)
    side = 3 * STRIDE if beam > 2 * STRIDE else 2 * STRIDE
    windows = fit_windows(clear, side=side, stride=STRIDE)
    regions = grow_regions(windows)
    return label_pixels(image, blocks, clear.valid.numpy(), windows, regions)
