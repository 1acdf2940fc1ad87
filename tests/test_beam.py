"""The box of eq. 18 against a plain loop over pixels."""

import pytest
import torch

from torchcal.render.beam import beam_area, box_sum, plain_box_sum


def summed_by_loop(image: torch.Tensor, side: int) -> torch.Tensor:
    half = side // 2
    result = torch.zeros_like(image)
    for v in range(image.shape[-2]):
        for u in range(image.shape[-1]):
            rows, columns = (
                slice(max(v - half, 0), v + half + 1),
                slice(max(u - half, 0), u + half + 1),
            )
            result[..., v, u] = image[..., rows, columns].sum((-2, -1))
    return result


@pytest.mark.parametrize("side", [1, 3, 5, 21])
@pytest.mark.parametrize("batch", [(), (2,), (2, 3)])
def test_the_box_is_clipped_at_the_border(rng: torch.Generator, side: int, batch: tuple[int, ...]):
    image = torch.randn(*batch, 13, 17, generator=rng, dtype=torch.float64)
    torch.testing.assert_close(box_sum(image, side), summed_by_loop(image, side))


@pytest.mark.parametrize("side", [3, 21])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_boxes_are_the_same_by_tensors_and_in_machine_code(
    rng: torch.Generator, side: int, dtype: torch.dtype
):
    image = torch.randn(3, 40, 25, generator=rng, dtype=dtype)
    torch.testing.assert_close(box_sum(image, side), plain_box_sum(image, side))


def test_where_a_box_is_empty_its_sum_is_0_to_the_last_bit(rng: torch.Generator):
    image = torch.rand(30, 30, generator=rng, dtype=torch.float64)
    image[8:20, 5:25] = 0.0
    total = box_sum(image, 5)
    assert (total[10:18, 7:23] == 0).all()
    assert (total[9:19, 6:24] != 0).sum() > 0


def test_a_box_of_one_pixel_changes_nothing(rng: torch.Generator):
    image = torch.randn(5, 6, generator=rng, dtype=torch.float64)
    assert torch.equal(box_sum(image, 1), image)


def test_the_area_is_smaller_in_corners():
    area = beam_area(7, 9, 5, torch.zeros((), dtype=torch.float64))
    assert area[3, 4] == 25
    assert area[0, 0] == 9
    assert area[0, 4] == 15
