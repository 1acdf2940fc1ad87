import pytest
import torch
from torch.testing import assert_close

from torchcal.match.nearest import Patches


def drawn(*shape: int, seed: int) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.rand(*shape, 3, generator=generator, dtype=torch.float64)


@pytest.fixture
def patches() -> Patches:
    normals = torch.nn.functional.normalize(drawn(200, seed=1) - 0.5, dim=-1)
    return Patches.of(drawn(200, seed=0), normals)


@pytest.mark.parametrize("shape", [(), (50,), (4, 30), (0,)], ids=str)
def test_nearest_is_that_of_all_pairs(patches, shape):
    queries = drawn(*shape, seed=2)
    distance, index = patches.nearest(queries)
    pairs = (queries[..., None, :] - patches.points).norm(dim=-1)
    expected = pairs.min(-1)
    assert_close(distance, expected.values)
    assert_close(index, expected.indices)


def test_the_index_leads_to_the_normal_of_the_patch():
    points = torch.tensor([[0.0, 0, 0], [1, 0, 0]], dtype=torch.float64)
    normals = torch.tensor([[0.0, 0, 1], [0, 1, 0]], dtype=torch.float64)
    _, index = Patches.of(points, normals).nearest(points.flip(0) + 0.1)
    assert_close(Patches.of(points, normals).normals[index], normals.flip(0))


@pytest.mark.parametrize("bad", [torch.nan, torch.inf, -torch.inf])
def test_queries_that_are_not_finite_are_infinitely_far_and_leave_the_others(patches, bad):
    queries = drawn(6, seed=3)
    expected, expected_index = patches.nearest(queries)
    queries[2, 1] = bad
    expected[2], expected_index[2] = torch.inf, 0
    distance, index = patches.nearest(queries)
    assert_close(distance, expected, rtol=0, atol=0)
    assert_close(index, expected_index)


def test_without_patches_everything_is_infinitely_far():
    none = torch.zeros(0, 3, dtype=torch.float64)
    distance, index = Patches.of(none, none).nearest(drawn(3, seed=0))
    assert distance.eq(torch.inf).all()
    assert index.eq(0).all()


def test_dtype_follows_the_queries(patches):
    distance, _ = patches.nearest(drawn(3, seed=0).float())
    assert distance.dtype == torch.float32
