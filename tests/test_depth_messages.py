"""Depth images in every form in which ROS sends them."""

import io
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bags import Messages, write_bag
from PIL import Image

from torchcal.errors import JobError
from torchcal.model.recordings.depth_messages import depth_pixels
from torchcal.model.recordings.import_recording import Imported, import_recording
from torchcal.model.recordings.recorded import Selection
from torchcal.model.recordings.rvl import decode_rvl

MILLIMETRES = np.arange(480, 480 + 48, dtype=np.uint16).reshape(6, 8)
MILLIMETRES[2, 3:6] = 0
PLUMB = (-0.9, 0.05, 0.001, -0.002, 0.0)
MATRIX = (9.0, 0.0, 3.5, 0.0, 9.5, 2.5, 0.0, 0.0, 1.0)


def png(pixels: np.ndarray) -> bytes:
    file = io.BytesIO()
    Image.fromarray(pixels).save(file, "PNG")
    return file.getvalue()


def rvl(pixels: np.ndarray) -> bytes:
    """An encoder written after the paper, nibble by nibble."""
    nibbles: list[int] = []

    def put(number: int) -> None:
        while True:
            nibble, number = number & 7, number >> 3
            nibbles.append(nibble | (8 if number else 0))
            if not number:
                return

    flat, at, last = pixels.ravel().tolist(), 0, 0
    while at < len(flat):
        zeros = at
        while at < len(flat) and flat[at] == 0:
            at += 1
        put(at - zeros)
        end = at
        while end < len(flat) and flat[end] != 0:
            end += 1
        put(end - at)
        for value in flat[at:end]:
            delta, last = value - last, value
            put(2 * delta if delta >= 0 else -2 * delta - 1)
        at = end
    nibbles += [0] * (-len(nibbles) % 8)
    words = [nibbles[k : k + 8] for k in range(0, len(nibbles), 8)]
    packed = [sum(nibble << (28 - 4 * k) for k, nibble in enumerate(word)) for word in words]
    return struct.pack("<II", *pixels.shape[::-1]) + struct.pack(f"<{len(packed)}I", *packed)


def payload(body: bytes, a: float = 0.0, b: float = 0.0) -> bytes:
    return struct.pack("<iff", 0, a, b) + body


@pytest.fixture
def m() -> Messages:
    return Messages("sqlite3")


@pytest.mark.parametrize("big", [False, True])
def test_integers_are_read_in_either_byte_order(m: Messages, big: bool):
    message = m.image(m.header(0.0), MILLIMETRES, "16UC1", big)
    np.testing.assert_array_equal(depth_pixels(message), MILLIMETRES)


def test_rows_may_be_padded(m: Messages):
    padded = np.concatenate([MILLIMETRES, np.full((6, 3), 9, np.uint16)], 1)
    message = m.image(m.header(0.0), padded, "16UC1")
    message = type(message)(**{**vars(message), "width": 8})
    np.testing.assert_array_equal(depth_pixels(message), MILLIMETRES)


def test_floats_keep_their_bits(m: Messages):
    metres = np.linspace(0.3, 7.0, 48, dtype=np.float32).reshape(6, 8)
    metres[0, 0] = np.nan
    pixels = depth_pixels(m.image(m.header(0.0), metres, "32FC1"))
    assert pixels.dtype == np.float32
    np.testing.assert_array_equal(pixels, metres)


def test_png_and_rvl_are_lossless(m: Messages):
    for words, body in (("png", png(MILLIMETRES)), ("rvl", rvl(MILLIMETRES))):
        message = m.compressed(m.header(0.0), f"16UC1; compressedDepth {words}", payload(body))
        np.testing.assert_array_equal(depth_pixels(message), MILLIMETRES)


def test_floats_come_back_from_their_quantised_inverse(m: Messages):
    # The sender's own numbers: quantisation 100, at most 10 m.
    a = 100.0 * (100.0 + 1.0)
    b = 1.0 - a / 10.0
    metres = np.linspace(1.0, 5.0, 48).reshape(6, 8)
    units = np.round(a / metres + b).astype(np.uint16)
    units[0, 0] = 0
    for words, body in (("png", png(units)), ("rvl", rvl(units))):
        message = m.compressed(
            m.header(0.0), f"32FC1; compressedDepth {words}", payload(body, a, b)
        )
        pixels = depth_pixels(message)
        assert np.isnan(pixels[0, 0])
        # Half a step of the inverse at 5 m.
        np.testing.assert_allclose(pixels.ravel()[1:], metres.ravel()[1:], atol=0.5 * 25.0 / a)


def test_an_inverse_of_zero_is_no_measurement(m: Messages):
    units = np.full((6, 8), 5, np.uint16)
    units[0, 0] = 9
    message = m.compressed(
        m.header(0.0), "32FC1; compressedDepth png", payload(png(units), 4.0, 5.0)
    )
    assert np.flatnonzero(np.isfinite(depth_pixels(message))).tolist() == [0]


def test_a_compressed_copy_of_16_bits_is_a_depth_image(m: Messages):
    message = m.compressed(m.header(0.0), "16UC1; png compressed ", png(MILLIMETRES))
    np.testing.assert_array_equal(depth_pixels(message), MILLIMETRES)


def test_random_images_survive_rvl():
    random = np.random.default_rng(0)
    pixels = random.integers(0, 65536, (37, 53)).astype(np.uint16)
    pixels[random.random((37, 53)) < 0.6] = 0
    np.testing.assert_array_equal(decode_rvl(rvl(pixels)), pixels)
    np.testing.assert_array_equal(decode_rvl(rvl(0 * pixels)), 0 * pixels)


@pytest.mark.parametrize("left", [8, 12, 20])
def test_a_broken_rvl_stream_is_a_value_error(left: int):
    with pytest.raises(ValueError, match="an RVL image that"):
        decode_rvl(rvl(MILLIMETRES)[:left])


def test_colours_are_no_depth(m: Messages):
    message = m.image(m.header(0.0), np.zeros((6, 24), np.uint8), "rgb8")
    with pytest.raises(ValueError, match="'rgb8'; expected 16UC1, mono16, 32FC1"):
        depth_pixels(message)


def imported(tmp_path: Path, m: Messages, image: Any, info: Any, **more: Any) -> Imported:
    topic = "/depth/image_raw"
    content = [(topic, 0.0, image), ("/depth/camera_info", 0.0, info)]
    source = write_bag(tmp_path, m, content)
    (tmp_path / "out").mkdir()
    return import_recording(source, tmp_path / "out", **more)


def pinhole(m: Messages, **more: Any) -> Any:
    return m.camera(m.header(0.0), (8, 6), MATRIX, **more)


def image_of(made: Imported) -> np.ndarray:
    """The one image that was written, in the file's own units."""
    (file,) = (made.job.parent / "depth").iterdir()
    return np.load(file) if file.suffix == ".npy" else np.asarray(Image.open(file))


def test_floats_that_can_hardly_be_metres_are_told(tmp_path: Path, m: Messages):
    image = m.image(m.header(0.0), MILLIMETRES.astype(np.float32), "32FC1")
    made = imported(tmp_path, m, image, pinhole(m))
    assert any(
        note.startswith("WARNING: a median depth of 50") and "--depth-unit 0.001" in note
        for note in made.notes
    )


def test_the_unit_of_floats_can_be_given(tmp_path: Path, m: Messages):
    image = m.image(m.header(0.0), MILLIMETRES.astype(np.float32), "32FC1")
    made = imported(tmp_path, m, image, pinhole(m), selection=Selection(depth_unit=0.001))
    assert not any("WARNING" in note for note in made.notes)
    np.testing.assert_allclose(image_of(made), MILLIMETRES * 0.001, rtol=1e-6)


def test_the_unit_of_integers_can_be_given(tmp_path: Path, m: Messages):
    image = m.image(m.header(0.0), MILLIMETRES, "16UC1")
    made = imported(tmp_path, m, image, pinhole(m), selection=Selection(depth_unit=0.0001))
    np.testing.assert_array_equal(image_of(made), MILLIMETRES)
    assert "depth_unit = 0.0001" in made.job.read_text()


def test_an_image_of_another_size_than_its_camera_is_a_mistake(tmp_path: Path, m: Messages):
    image = m.image(m.header(0.0), MILLIMETRES.T.copy(), "16UC1")
    with pytest.raises(JobError, match=r"images of 6x8 pixels; expected 8x6, as /depth/camera_inf"):
        imported(tmp_path, m, image, pinhole(m))


def test_a_broken_image_names_its_topic(tmp_path: Path, m: Messages):
    broken = m.compressed(
        m.header(0.0), "16UC1; compressedDepth png", payload(png(MILLIMETRES)[:40])
    )
    with pytest.raises(JobError, match=r"/depth/image_raw: found a message that cannot be used"):
        imported(tmp_path, m, broken, pinhole(m))


def test_a_camera_that_was_never_calibrated_is_a_mistake(tmp_path: Path, m: Messages):
    info = m.camera(m.header(0.0), (8, 6), [0.0] * 9)
    image = m.image(m.header(0.0), MILLIMETRES, "16UC1")
    with pytest.raises(JobError, match=r"camera_info: .*fx = 0; expected a focal length above 0"):
        imported(tmp_path, m, image, info)


def test_a_lens_is_taken_out_of_raw_images_and_told(tmp_path: Path, m: Messages):
    image = m.image(m.header(0.0), MILLIMETRES, "16UC1")
    made = imported(tmp_path, m, image, pinhole(m, lens=PLUMB))
    assert any(
        "is not rectified: its lens (plumb_bob) was taken out" in each for each in made.notes
    )
    assert not np.array_equal(image_of(made), MILLIMETRES)


def test_every_imported_pixel_was_measured(tmp_path: Path, m: Messages):
    image = m.image(m.header(0.0), MILLIMETRES, "16UC1")
    made = imported(tmp_path, m, image, pinhole(m, lens=PLUMB))
    assert set(image_of(made).ravel().tolist()) <= {0, *MILLIMETRES.ravel().tolist()}


def test_a_rectified_topic_has_the_pinhole_p_and_no_lens(tmp_path: Path, m: Messages):
    topic = "/depth/image_rect"
    info = pinhole(m, lens=PLUMB, rectified=(8.0, 8.5, 3.0, 2.0))
    image = m.image(m.header(0.0), MILLIMETRES, "16UC1")
    source = write_bag(tmp_path, m, [(topic, 0.0, image), ("/depth/camera_info", 0.0, info)])
    (tmp_path / "out").mkdir()
    made = import_recording(source, tmp_path / "out")
    np.testing.assert_array_equal(image_of(made), MILLIMETRES)
    assert "fx = 8.0\nfy = 8.5\ncx = 3.0\ncy = 2.0\n" in made.job.read_text()


def test_blank_images_are_left_out_and_told(tmp_path: Path, m: Messages):
    topic = "/depth/image_raw"
    images = [m.image(m.header(k), MILLIMETRES * (k != 1), "16UC1") for k in range(3)]
    content = [(topic, float(k), image) for k, image in enumerate(images)]
    source = write_bag(tmp_path, m, [*content, ("/depth/camera_info", 0.0, pinhole(m))])
    (tmp_path / "out").mkdir()
    made = import_recording(source, tmp_path / "out")
    assert made.frames == 2
    assert "WARNING: 1 images hold no measurement and were left out" in made.notes


def test_what_a_saturated_camera_sends_is_no_measurement(tmp_path: Path, m: Messages):
    pixels = MILLIMETRES.copy()
    pixels[0] = 65535
    made = imported(tmp_path, m, m.image(m.header(0.0), pixels, "16UC1"), pinhole(m))
    assert "range = [0.48, 0.6]" in made.job.read_text()
