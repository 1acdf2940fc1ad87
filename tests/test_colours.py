"""The palette: told apart by every eye, also by those that lack one kind of cone."""

from itertools import combinations

import numpy as np
import pytest

from torchcal.calibrate.result import PixelClass
from torchcal.display import colours, legend
from torchcal.display.figures import SHOWN_AS
from torchcal.display.hybrid import MEASURED_CLASSES

EYES = {
    "normal": np.eye(3),
    "protanopia": [
        (0.152286, 1.052583, -0.204868),
        (0.114503, 0.786281, 0.099216),
        (-0.003882, -0.048116, 1.051998),
    ],
    "deuteranopia": [
        (0.367322, 0.860646, -0.227968),
        (0.280085, 0.672501, 0.047413),
        (-0.011820, 0.042940, 0.968881),
    ],
    "tritanopia": [
        (1.255528, -0.076749, -0.178779),
        (-0.078411, 0.930809, 0.147602),
        (0.004733, 0.691367, 0.303900),
    ],
}
"""On linear RGB (Machado, Oliveira and Fernandes 2009, severity 1)."""

TO_CONES = np.array(
    [
        (0.4122214708, 0.5363325363, 0.0514459929),
        (0.2119034982, 0.6806995451, 0.1073969566),
        (0.0883024619, 0.2817188376, 0.6299787005),
    ]
)
TO_OKLAB = np.array(
    [
        (0.2104542553, 0.7936177850, -0.0040720468),
        (1.9779984951, -2.4285922050, 0.4505937099),
        (0.0259040371, 0.7827717662, -0.8086757660),
    ]
)
"""Oklab (Ottosson 2020): equal distances look alike; two hundredths are just noticeable."""

APART = 0.15
"""Seven just noticeable differences: plain for small patches, too."""


def oklab(rgb: np.ndarray, eye: str) -> np.ndarray:
    """Where a colour (RGB, 0 to 255) lies for a kind of eye."""
    share = rgb / 255.0
    linear = np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)
    seen = np.clip(np.array(EYES[eye]) @ linear, 0.0, 1.0)
    return TO_OKLAB @ np.cbrt(TO_CONES @ seen)


def difference(one: np.ndarray, other: np.ndarray, eye: str) -> float:
    return float(np.linalg.norm(oklab(one, eye) - oklab(other, eye)))


def test_black_and_white_are_one_apart_and_red_and_green_closer_without_a_cone():
    """The checker itself, against what is known of Oklab and of colour-blindness."""
    black, white = np.zeros(3), np.full(3, 255.0)
    assert difference(black, white, "normal") == pytest.approx(1.0, abs=1e-3)
    red, green = np.array([200.0, 60.0, 60.0]), np.array([90.0, 120.0, 40.0])
    assert difference(red, green, "deuteranopia") < 0.5 * difference(red, green, "normal")


@pytest.mark.parametrize("eye", EYES)
def test_no_two_classes_look_alike(eye: str):
    palette = {member: colours.as_bytes(colours.CLASS_COLOURS[member]) for member in PixelClass}
    closest = min(
        (difference(palette[one], palette[other], eye), one.name, other.name)
        for one, other in combinations(palette, 2)
    )
    assert closest[0] > APART, closest


@pytest.mark.parametrize("eye", EYES)
def test_nearer_and_farther_are_told_apart_on_the_scale_of_differences(eye: str):
    ends = colours.difference_image(np.array([[-9.0, 0.0, 9.0]]), 9.0)[0]
    assert min(difference(a, b, eye) for a, b in combinations(ends, 2)) > APART


def test_classes_differ_by_hatching_where_colours_are_not_seen():
    swatches = {member: legend.hybrid_swatch(member).mean(-1) for member in PixelClass}
    for one, other in combinations(swatches, 2):
        inner = np.abs(swatches[one] - swatches[other])[8:-8, 8:-8]
        assert (inner > 30.0).mean() > 0.1, (one.name, other.name)


def test_nothing_measured_is_never_in_a_colour_of_the_range_scale():
    table = colours.RANGE_MAP(np.arange(256), bytes=True)[:, :3].astype(float)
    grey = colours.as_bytes(colours.NEUTRAL).astype(float)
    assert min(difference(each, grey, "normal") for each in table) > 0.05


def test_measured_classes_are_those_that_show_the_measurement():
    shown = [member for member, words in SHOWN_AS.items() if "measurement" in words]
    assert sorted(shown) == sorted(MEASURED_CLASSES)
    assert set(SHOWN_AS) == set(PixelClass)
