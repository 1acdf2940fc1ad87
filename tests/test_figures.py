"""Figures that can be drawn of anything: any size, any name, with nothing to show."""

import dataclasses

import numpy as np
import pytest
import torch
from display_scene import HEIGHT, WIDTH, comparison
from matplotlib.figure import Figure

from torchcal.calibrate.result import FrameComparison, PixelClass
from torchcal.display import canvas, figures


def test_counts_add_up_to_the_image():
    counts = figures.class_counts(comparison())
    assert sum(counts.values()) == HEIGHT * WIDTH
    assert counts[PixelClass.NEARER] == 12 * 14


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_figures_of_both_dtypes_are_drawn_with_more_than_one_colour(dtype):
    frame = comparison(dtype=dtype)
    for figure in (figures.hybrid_figure(frame), figures.comparison_figure(frame, 3.0)):
        picture = np.asarray(canvas.pixels(figure))
        assert len(np.unique(picture.reshape(-1, 3), axis=0)) > 50


NOWHERE = torch.full((HEIGHT, WIDTH), torch.nan, dtype=torch.float64)


def words_of(figure: Figure) -> str:
    return "\n".join(text.get_text() for text in figure.texts)


@pytest.mark.parametrize(
    ("lost", "member", "words", "scales"),
    [
        (["predicted", "sigma"], PixelClass.UNMODELLED, figures.NO_MODEL, 2),
        (["measured"], PixelClass.MISSING, figures.NO_MEASUREMENT, 1),
        (["predicted", "sigma", "measured"], PixelClass.NOT_COMPARED, "nothing to compare", 0),
    ],
)
def test_figures_say_what_is_not_there(
    lost: list[str], member: PixelClass, words: str, scales: int
):
    label = torch.full((HEIGHT, WIDTH), int(member), dtype=torch.uint8)
    gone = dict.fromkeys(lost, NOWHERE)
    frame = dataclasses.replace(comparison(), label=label, **gone)
    assert canvas.pixels(figures.hybrid_figure(frame)).width > 100
    figure = figures.comparison_figure(frame, 3.0)
    assert canvas.pixels(figure).width > 100
    assert words in words_of(figure)
    assert len(figure.axes) == scales


def test_a_range_image_of_nothing_is_drawn():
    assert "nothing is met" in words_of(figures.range_figure(NOWHERE, "nothing"))


@pytest.mark.parametrize("shape", [(1, 1), (41, 41), (16, 1024), (600, 20), (1200, 1600)])
def test_figures_of_every_shape_have_all_of_the_image_and_a_sensible_size(shape: tuple[int, int]):
    label = torch.full(shape, int(PixelClass.AGREES), dtype=torch.uint8)
    label[-1, -1] = PixelClass.NEARER
    wall = torch.full(shape, 2.0)
    frame = FrameComparison(
        name="a",
        measured=wall,
        predicted=wall,
        sigma=wall,
        label=label,
        body=label.int(),
        colour=label[..., None].expand(*shape, 3),
        normal=wall[..., None].expand(*shape, 3).half(),
        usable=wall > 0,
    )
    for figure in (figures.hybrid_figure(frame), figures.comparison_figure(frame, 3.0)):
        picture = canvas.pixels(figure)
        assert 600 <= picture.width <= 1400
        assert 300 <= picture.height <= 2300


@pytest.mark.parametrize("name", ["a" * 200, "$x_1$ \\frac{", "名前\n<b>", ""])
def test_any_name_of_a_frame_is_written_within_the_figure(name: str):
    figure = figures.hybrid_figure(comparison(name))
    title = figure.texts[0]
    assert canvas.pixels(figure).width >= title.get_window_extent().x1
    assert title.get_text().startswith("Hybrid view of frame")
    assert title.get_text().endswith(name[-3:].replace("\n", "□")) or "□" in title.get_text()


def test_large_images_are_reduced_to_means_and_small_ones_to_sharp_squares():
    figure, box = canvas.blank(40, 40), canvas.Box(left=10, top=5, width=20, height=20)
    chequers = np.repeat(255 * (np.indices((200, 200)).sum(0) % 2)[..., None], 3, axis=2)
    canvas.show(figure, box, chequers.astype(np.uint8))
    reduced = np.asarray(canvas.pixels(figure))[5:25, 10:30]
    np.testing.assert_allclose(reduced, 127.5, atol=1.5)
    figure = canvas.blank(40, 40)
    canvas.show(figure, box, chequers[:2, :2].astype(np.uint8))
    enlarged = np.asarray(canvas.pixels(figure))
    assert (enlarged[5:15, 10:20] == 0).all()
    assert (enlarged[5:15, 20:30] == 255).all()
    assert (enlarged[:5] == 255).all()


def test_one_image_pixel_covers_whole_figure_pixels():
    assert canvas.displayed_size((48, 64), 720) == (704, 528)


def test_images_of_a_lidar_with_few_rows_are_stretched():
    width, height = canvas.displayed_size((16, 1024), 720)
    assert width == 720
    assert height == 180
