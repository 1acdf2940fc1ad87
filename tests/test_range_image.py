import numpy as np
import pytest
import torch
from PIL import Image
from torch.testing import assert_close

from torchcal.errors import JobError
from torchcal.geometry.projection import Pinhole
from torchcal.model.range_image import read_mask, read_range
from torchcal.model.sensor import Noise, Sensor

NAN = float("nan")
SENSOR = Sensor(
    projection=Pinhole(width=4, height=2, fx=4.0, fy=4.0, cx=1.5, cy=0.5),
    noise=Noise(a=0.01),
    near=0.5,
    far=2.0,
    beam=1,
    depth_unit=0.001,
)

WHOLE = np.array([[0, 499, 500, 1234], [1500, 2000, 2001, 65535]])
METRES = [[NAN, NAN, 0.5, 1.234], [1.5, 2.0, NAN, NAN]]


def expect_metres(found, atol=1e-12):  # one rounding of a product
    expected = torch.tensor(METRES, dtype=torch.float64)
    assert_close(found, expected, equal_nan=True, rtol=0, atol=atol)


@pytest.mark.parametrize("ending", ["png", "PNG", "tif", "tiff"])
def test_sixteen_bit_pictures_are_scaled_and_cut_to_the_range(tmp_path, ending):
    file = tmp_path / f"depth.{ending}"
    Image.fromarray(WHOLE.astype(np.uint16)).save(file)
    expect_metres(read_range(file, SENSOR))


@pytest.mark.parametrize("dtype", ["u2", ">u2", "i4", "u4", "i8"])
def test_integer_arrays_are_scaled(tmp_path, dtype):
    np.save(tmp_path / "depth.npy", WHOLE.astype(dtype))
    expect_metres(read_range(tmp_path / "depth.npy", SENSOR))


@pytest.mark.parametrize("dtype", ["f4", "f8", ">f8"])
def test_float_arrays_are_metres(tmp_path, dtype):
    np.save(tmp_path / "depth.npy", (WHOLE * 0.001).astype(dtype))
    expect_metres(read_range(tmp_path / "depth.npy", SENSOR), atol=1e-6)  # float32 holds 7 digits


@pytest.mark.parametrize("compression", [None, "tiff_deflate", "tiff_lzw"])
def test_float_pictures_are_metres(tmp_path, compression):
    picture = Image.fromarray((WHOLE * 0.001).astype(np.float32))
    picture.save(tmp_path / "depth.tiff", compression=compression)
    expect_metres(read_range(tmp_path / "depth.tiff", SENSOR), atol=1e-6)


def test_invalid_values_are_no_measurement(tmp_path):
    values = np.array([[NAN, np.inf, -np.inf, 0.0], [-1.0, 1.0, 2.0000001, 0.4999999]])
    np.save(tmp_path / "depth.npy", values)
    measured = read_range(tmp_path / "depth.npy", SENSOR).isfinite()
    assert measured.tolist() == [[False] * 4, [False, True, False, False]]


def test_column_and_row_are_those_of_the_file(tmp_path):
    values = np.ones((2, 4))
    values[1, 3] = 1.75
    np.save(tmp_path / "depth.npy", values)
    assert read_range(tmp_path / "depth.npy", SENSOR)[1, 3] == 1.75


MASK = np.array([[0, 1, 128, 255], [0, 0, 0, 2]])


@pytest.mark.parametrize("dtype", ["u1", "u2"])
def test_mask_pictures_mark_what_is_not_zero(tmp_path, dtype):
    Image.fromarray(MASK.astype(dtype)).save(tmp_path / "mask.png")
    assert_close(read_mask(tmp_path / "mask.png", SENSOR), torch.from_numpy(MASK != 0))


@pytest.mark.parametrize("dtype", ["?", "u1", "i8", "f4"])
def test_mask_arrays_mark_what_is_not_zero(tmp_path, dtype):
    np.save(tmp_path / "mask.npy", MASK.astype(dtype))
    assert_close(read_mask(tmp_path / "mask.npy", SENSOR), torch.from_numpy(MASK != 0))


def test_black_and_white_picture_is_a_mask(tmp_path):
    Image.fromarray(MASK != 0).save(tmp_path / "mask.png")
    assert_close(read_mask(tmp_path / "mask.png", SENSOR), torch.from_numpy(MASK != 0))


def test_nan_in_a_mask_is_not_usable(tmp_path):
    np.save(tmp_path / "mask.npy", np.where(MASK != 0, 1.0, NAN))
    assert_close(read_mask(tmp_path / "mask.npy", SENSOR), torch.from_numpy(MASK != 0))


def test_floats_in_millimetres_are_refused_with_their_median(tmp_path):
    np.save(tmp_path / "depth.npy", np.full((2, 4), 1234.0))
    with pytest.raises(JobError, match=r"median of 1234 m, .* which floats always are"):
        read_range(tmp_path / "depth.npy", SENSOR)


def test_black_and_white_picture_is_no_range_image(tmp_path):
    Image.fromarray(MASK != 0).save(tmp_path / "depth.png")
    with pytest.raises(JobError, match="found an array of bool; expected one channel"):
        read_range(tmp_path / "depth.png", SENSOR)


def test_several_pages_are_refused(tmp_path):
    page = Image.fromarray(WHOLE.astype(np.uint16))
    page.save(tmp_path / "depth.tiff", save_all=True, append_images=[page])
    with pytest.raises(JobError, match=r"more than one image.*a readable tiff file with one image"):
        read_range(tmp_path / "depth.tiff", SENSOR)


def test_pickled_array_is_refused(tmp_path):
    np.save(tmp_path / "depth.npy", np.array([[{}]]), allow_pickle=True)
    with pytest.raises(JobError, match="cannot be read"):
        read_range(tmp_path / "depth.npy", SENSOR)


def test_missing_image_is_a_job_error(tmp_path):
    with pytest.raises(JobError, match=r"depth.npy: found a file that cannot be read"):
        read_range(tmp_path / "depth.npy", SENSOR)


def test_transposed_image_is_refused_with_both_sizes(tmp_path):
    np.save(tmp_path / "depth.npy", np.ones((4, 2)))
    with pytest.raises(JobError, match=r"found 2x4 pixels \(width x height\); expected 4x2"):
        read_range(tmp_path / "depth.npy", SENSOR)
