import math

import pytest
import torch
from scipy.linalg import expm
from scipy.spatial.transform import Rotation
from torch.testing import assert_close

from torchcal.geometry import se3

ATOL = 1e-13  # closed forms and short series in float64, lengths of order 1
SHAPES = pytest.mark.parametrize("shape", [(), (3,), (2, 3), (0,)], ids=str)
ANGLES = pytest.mark.parametrize(
    "angle",
    [0.0, 1e-12, 1e-8, 1e-4, 0.99e-3, 1.01e-3, 0.5, 2.0, 3.0, math.pi - 1e-4, math.pi - 1e-9],
)


def random(*shape: int) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(5), dtype=torch.float64)


def twists(angle: float) -> torch.Tensor:
    """Twists that turn by an angle about all kinds of axes."""
    axes = torch.cat([torch.eye(3).double(), -torch.eye(3).double(), random(30, 3)])
    axes = axes / axes.norm(dim=-1, keepdim=True)
    return torch.cat([random(36, 3), angle * axes], -1)


@ANGLES
def test_log_undoes_exp(angle):
    xi = twists(angle)
    assert_close(se3.log(se3.exp(xi)), xi, rtol=0, atol=ATOL)


def test_half_a_turn_comes_back_about_either_axis():
    T = se3.exp(twists(math.pi))
    xi = se3.log(T)
    assert_close(
        xi[:, 3:].norm(dim=-1), torch.full((36,), math.pi, dtype=torch.float64), rtol=0, atol=ATOL
    )
    assert_close(se3.exp(xi), T, rtol=0, atol=ATOL)


@pytest.mark.parametrize("axis", range(3))
def test_log_of_an_exact_half_turn(axis):
    R = -torch.eye(3, dtype=torch.float64)
    R[axis, axis] = 1.0
    w = se3.rotation_log(R)
    expected = torch.zeros(3, dtype=torch.float64)
    expected[axis] = math.pi
    assert_close(w.abs(), expected, rtol=0, atol=ATOL)


def test_more_than_half_a_turn_comes_back_the_short_way():
    xi = torch.tensor([0.0, 0, 0, 0, 0, 2 * math.pi - 0.5], dtype=torch.float64)
    assert_close(se3.log(se3.exp(xi)), torch.tensor([0.0, 0, 0, 0, 0, -0.5], dtype=torch.float64))


@ANGLES
def test_exp_is_that_of_scipy(angle):
    xi = twists(angle)
    generator = torch.zeros(len(xi), 4, 4, dtype=torch.float64)
    generator[:, :3, :3] = se3.hat(xi[:, 3:])
    generator[:, :3, 3] = xi[:, :3]
    T = se3.exp(xi)
    assert_close(T, torch.from_numpy(expm(generator.numpy())), rtol=0, atol=ATOL)
    R = torch.from_numpy(Rotation.from_rotvec(xi[:, 3:].numpy()).as_matrix())
    assert_close(T[:, :3, :3], R, rtol=0, atol=ATOL)


def test_a_quarter_turn_on_the_way_ahead_ends_on_a_circle():
    xi = torch.tensor([math.pi / 2, 0, 0, 0, 0, math.pi / 2], dtype=torch.float64)
    expected = [[0.0, -1, 0, 1], [1, 0, 0, 1], [0, 0, 1, 0], [0, 0, 0, 1]]
    assert_close(se3.exp(xi), torch.tensor(expected, dtype=torch.float64), rtol=0, atol=ATOL)


def test_hat_is_the_cross_product():
    w, p = random(2, 5, 3)
    assert_close((se3.hat(w) @ p[..., None])[..., 0], torch.linalg.cross(w, p))


@SHAPES
def test_every_function_takes_any_batch(shape):
    xi = random(*shape, 6)
    T = se3.exp(xi)
    assert se3.log(T).shape == (*shape, 6)
    assert se3.adjoint(T).shape == (*shape, 6, 6)
    assert se3.from_xyz_rpy(*se3.to_xyz_rpy(T)).shape == (*shape, 4, 4)
    assert se3.transform(T, random(*shape, 7, 3)).shape == (*shape, 7, 3)
    eye = torch.eye(4, dtype=torch.float64).expand(*shape, 4, 4)
    assert_close(se3.inverse(T) @ T, eye, rtol=0, atol=1e-12)


def test_batch_is_the_loop_over_its_elements():
    xi = random(2, 3, 6)
    T = se3.exp(xi)
    for index in ((0, 0), (1, 2)):
        assert_close(T[index], se3.exp(xi[index]), rtol=0, atol=ATOL)
        assert_close(se3.log(T)[index], se3.log(T[index]), rtol=0, atol=ATOL)


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_a_bad_element_leaves_its_neighbours_bit_for_bit(bad):
    xi = random(7, 6) * torch.logspace(-9, 0, 7, dtype=torch.float64)[:, None]
    broken = xi.clone()
    broken[3] = bad
    for function, good, ill in (
        (se3.exp, xi, broken),
        (se3.log, se3.exp(xi), se3.exp(broken)),
        (se3.inverse, se3.exp(xi), se3.exp(broken)),
    ):
        found, expected = function(ill), function(good)
        assert torch.equal(found[[0, 1, 2, 4, 5, 6]], expected[[0, 1, 2, 4, 5, 6]])
        assert not found[3].isfinite().all()


def test_adjoint_moves_a_twist_to_the_other_side():
    T, xi = se3.exp(random(4, 6)), random(4, 6)
    moved = (se3.adjoint(T) @ xi[..., None])[..., 0]
    assert_close(T @ se3.exp(xi), se3.exp(moved) @ T, rtol=0, atol=1e-12)


def test_adjoint_of_a_product_is_the_product_of_adjoints():
    A, B = se3.exp(random(2, 6)).unbind(0)
    assert_close(se3.adjoint(A @ B), se3.adjoint(A) @ se3.adjoint(B), rtol=0, atol=1e-12)


@ANGLES
def test_log_and_exp_have_the_gradient_of_the_identity(angle):
    xi = twists(angle)[:3].requires_grad_()
    (grad,) = torch.autograd.grad(se3.log(se3.exp(xi)).sum(), xi)
    # near pi the rotation's log divides by sin(angle / 2 - pi / 2): rounding is magnified
    atol = 1e-9 if angle < 3.1 else 1e-3
    assert_close(grad, torch.ones_like(grad), rtol=0, atol=atol)


def test_rpy_is_that_of_scipy():
    xyz, rpy = random(2, 20, 3)
    T = se3.from_xyz_rpy(xyz, rpy)
    R = Rotation.from_euler("xyz", rpy.numpy()).as_matrix()
    assert_close(T[:, :3, :3], torch.from_numpy(R), rtol=0, atol=ATOL)
    assert_close(T[:, :3, 3], xyz)


@pytest.mark.parametrize("pitch", [0.3, -1.5, math.pi / 2, -math.pi / 2])
def test_rpy_comes_back_as_the_same_pose_even_at_gimbal_lock(pitch):
    rpy = torch.tensor([[0.4, pitch, -0.7], [3.0, pitch, 3.0]], dtype=torch.float64)
    T = se3.from_xyz_rpy(random(2, 3), rpy)
    xyz, found = se3.to_xyz_rpy(T)
    assert_close(se3.from_xyz_rpy(xyz, found), T, rtol=0, atol=1e-12)
    if abs(pitch) < 1.55:
        assert_close(found, rpy, rtol=0, atol=1e-12)
    else:
        assert_close(found[:, 0], torch.zeros(2, dtype=torch.float64))


def test_transform_moves_points_of_b_to_a():
    T_a_b = se3.from_xyz_rpy(
        torch.tensor([1.0, 2, 3], dtype=torch.float64), torch.tensor([0, 0, math.pi / 2]).double()
    )
    p_a = se3.transform(T_a_b, torch.tensor([[1.0, 0, 0], [0, 1, 0]]).double())
    assert_close(p_a, torch.tensor([[1.0, 3, 3], [0, 2, 3]]).double())


def test_one_cloud_is_moved_by_every_pose_of_a_batch():
    Ts, p = se3.exp(random(2, 4, 6)), random(5, 3)
    moved = se3.transform(Ts, p)
    assert moved.shape == (2, 4, 5, 3)
    assert_close(moved[1, 2], se3.transform(Ts[1, 2], p))


def test_inputs_are_left_as_they_were():
    xi = random(3, 6)
    T = se3.exp(xi)
    xi_before, T_before = xi.clone(), T.clone()
    se3.exp(xi)
    for function in (se3.log, se3.inverse, se3.adjoint, se3.to_xyz_rpy):
        function(T)
    assert torch.equal(xi, xi_before)
    assert torch.equal(T, T_before)


def test_single_precision_stays_single():
    xi = 0.5 * random(4, 6).float()
    T = se3.exp(xi)
    tensors = (T, se3.log(T), se3.inverse(T), se3.adjoint(T), *se3.to_xyz_rpy(T))
    assert {tensor.dtype for tensor in tensors} == {torch.float32}
    assert_close(se3.log(T), xi, rtol=0, atol=1e-5)
