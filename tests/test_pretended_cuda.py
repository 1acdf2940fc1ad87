"""The pretended GPU raises where a real one would, and nowhere else: all tests run on both."""

import copy

import numpy as np
import pytest
import torch
from torch import Tensor

CPU = torch.arange(3.0)


@pytest.fixture
def there(device: torch.device) -> Tensor:
    return CPU.to(device)


@pytest.mark.parametrize("make", [torch.zeros, torch.ones, torch.empty, torch.rand])
def test_factories_lie_where_they_are_told_to(device, make):
    assert make(2, device=device).is_cuda
    assert make(2, device=str(device)).device == device
    assert make(2).device == torch.device("cpu")


def test_what_is_computed_stays_there(there):
    parts = [
        there + 1.0,
        2.0 - there,
        there[1:],
        there[there > 0],
        there.max(0).values,
        there.new_tensor([1.0]),
        torch.zeros_like(there),
        torch.stack([there, there]).mT,
        torch.linalg.eigh(there.diag()).eigenvectors,
        *there,
        *there.split(1),
        copy.deepcopy(there),
        there.double().to(torch.float32),
        torch.eye(3).to(there),
    ]
    assert all(part.is_cuda for part in parts)


def test_numbers_are_the_same(there):
    assert there.tolist() == CPU.tolist()
    assert float(there.sum()) == 3.0
    assert f"{there[2]:.1f}" == "2.0"
    torch.testing.assert_close((there * 2).cpu(), CPU * 2)


def test_a_transfer_is_a_copy(there):
    back, away = there.cpu(), CPU.clone()
    there.add_(1.0)
    assert back.tolist() == CPU.tolist()
    moved = away.to(there)
    away.add_(1.0)
    assert moved.tolist() == CPU.tolist()
    assert there.to(there.device) is there


def test_views_and_changes_in_place_share_memory(there):
    there[1:][0] = 7.0
    there[there == 2.0] = 5.0
    assert there.tolist() == [0.0, 7.0, 5.0]


def test_gradients_flow(there):
    leaf = torch.ones(3, device=there.device, requires_grad=True)
    (leaf.square() * there).sum().backward()
    assert leaf.grad is not None
    assert leaf.grad.is_cuda
    assert leaf.grad.tolist() == [0.0, 2.0, 4.0]


@pytest.mark.parametrize("to_numpy", [lambda x: x.numpy(), np.asarray, np.sqrt])
def test_numpy_gets_nothing(there, to_numpy):
    with pytest.raises(TypeError, match=r"Tensor\.cpu\(\)"):
        to_numpy(there)


@pytest.mark.parametrize(
    "mixed",
    [
        lambda x: x + CPU,
        lambda x: torch.where(CPU > 1, x, x),
        lambda x: torch.cat([x, CPU]),
        lambda x: torch.stack([x[0], CPU[0]]),
        lambda x: torch.isin(x, CPU),
        lambda x: x.index_add(0, torch.tensor([0]), x[:1]),
        lambda x: torch.einsum("i,i", x, CPU),
        lambda x: CPU.clone().add_(x),
        lambda x: CPU[(x > 1)],
        lambda x: CPU[x.long()],
        lambda x: x.__setitem__([0, 1, 2], CPU),
        lambda x: CPU.clone().__setitem__([0, 1, 2], x),
    ],
)
def test_devices_do_not_mix(there, mixed):
    with pytest.raises((RuntimeError, IndexError), match="device"):
        mixed(there)


def test_what_cuda_takes_from_the_cpu(there):
    single = torch.tensor(2.0)
    assert (there * single).is_cuda
    assert torch.where(there > 1, single, there).is_cuda
    assert there[torch.tensor([0, 2])].is_cuda
    assert there[CPU > 1].tolist() == [2.0]
    assert CPU[there[1].long()].device == torch.device("cpu")
    there[:2] = CPU[1:]
    there.copy_(there.cpu())
    assert there.tolist() == [1.0, 2.0, 2.0]
    here = CPU.clone()
    here[1:] = there[1:]
    assert here.device == torch.device("cpu")


def test_random_numbers_want_a_generator_of_the_device(device, there, rng):
    with pytest.raises(RuntimeError, match="'cuda' device type for generator"):
        torch.rand(2, generator=rng, device=device)
    with pytest.raises(RuntimeError, match="'cuda' device type for generator"):
        there.normal_(generator=rng)
    assert torch.rand(2, generator=rng).to(device).is_cuda


def test_whole_numbers_have_no_matrix_product(there):
    whole = there.long()
    with pytest.raises(RuntimeError, match="not implemented for"):
        torch.matmul(whole[None], whole[:, None])
