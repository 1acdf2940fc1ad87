import math

import pytest
import torch
from torch.testing import assert_close

from torchcal.geometry.projection import Pinhole, Spherical
from torchcal.model.job_schema import SensorTable
from torchcal.model.read_sensor import read_sensor, with_preset
from torchcal.model.sensor import PRESETS, Noise, Sensor


def sensor(tmp_path, **keys) -> Sensor:
    table = SensorTable.model_validate(with_preset(keys))
    return read_sensor(tmp_path / "job.toml", table)


def test_noise_is_a_parabola_of_the_range():
    noise = Noise(a=0.1, b=0.2, c=0.3)
    ranges = torch.tensor([[0.0, 1.0, 2.0]], dtype=torch.float64)
    assert_close(noise.sigma(ranges), torch.tensor([[0.1, 0.6, 1.7]], dtype=torch.float64))


@pytest.mark.parametrize(
    ("name", "pixels", "field_deg", "step_deg", "sigma", "limits"),
    [
        ("ultrasonic-array", 41, 60.0, 1.5, 0.01, (0.1, 2.0)),
        ("laser-scanner", 267, 8.0, 8 / 266, 0.1, (3.0, 30.0)),
    ],
)
def test_presets_are_the_sensors_of_the_paper(
    tmp_path, name, pixels, field_deg, step_deg, sigma, limits
):
    found = sensor(tmp_path, preset=name)
    optics = found.projection
    assert isinstance(optics, Spherical)
    assert (optics.width, optics.height) == (pixels, pixels)
    for first, last in (optics.azimuth, optics.elevation):
        assert_close(math.degrees(abs(last - first)), field_deg)
        assert_close(first, -last)
    assert_close(math.degrees(optics.azimuth_step), step_deg)
    assert found.noise == Noise(a=sigma)
    assert (found.near, found.far) == limits
    assert found.beam == 1


@pytest.mark.parametrize("name", PRESETS)
def test_presets_stand_upright_as_a_pinhole_does(tmp_path, name):
    optics = sensor(tmp_path, preset=name).projection
    corner = optics.rays(torch.zeros((), dtype=torch.float64), torch.zeros((), dtype=torch.float64))
    assert corner[0] < 0  # left
    assert corner[1] < 0  # up
    assert corner[2] > 0  # ahead


def test_keys_beside_a_preset_win(tmp_path):
    keys = {"sigma": 0.02, "rows": 21, "range": [0.2, 1.0], "beam": 3, "drift": 0}
    found = sensor(tmp_path, preset="ultrasonic-array", **keys)
    assert found.noise.a == 0.02
    assert found.noise.drift is not None
    assert found.noise.drift.sigma == 0
    assert (found.projection.width, found.projection.height) == (41, 21)
    assert (found.near, found.far, found.beam) == (0.2, 1.0, 3)


def test_a_preset_does_not_mind_its_own_model(tmp_path):
    plain = sensor(tmp_path, preset="laser-scanner")
    assert sensor(tmp_path, preset="laser-scanner", model="spherical") == plain


def test_whole_numbers_become_floats(tmp_path):
    optics = {"width": 8, "height": 6, "fx": 9, "fy": 9, "cx": 4, "cy": 3}
    found = sensor(tmp_path, model="pinhole", range=[0, 4], sigma=1, **optics)
    assert found.projection == Pinhole(width=8, height=6, fx=9.0, fy=9.0, cx=4.0, cy=3.0)
    assert isinstance(found.far, float)
    assert isinstance(found.noise.a, float)


def test_one_row_is_a_planar_scanner(tmp_path):
    optics = {"columns": 181, "rows": 1, "azimuth_deg": [-90, 90], "elevation_deg": [0, 0]}
    found = sensor(tmp_path, model="spherical", range=[0.1, 10], sigma=0.01, **optics)
    assert isinstance(found.projection, Spherical)
    assert_close(found.projection.azimuth_step, math.radians(1.0))
    assert_close(found.projection.elevation_step, -math.radians(1.0))
