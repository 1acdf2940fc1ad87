import torch
from drawn_elements import OBLIQUE, elements, normal, units
from torch.testing import assert_close

from torchcal.geometry import se3
from torchcal.match.random_starts import random_starts


def test_random_starts_carry_a_point_onto_a_measured_one_with_any_rotation(rng):
    model = elements("PLE", normal(2, 3, 3, rng=rng), OBLIQUE.expand(2, 3, 3))
    measured = elements("EPLP", normal(2, 4, 3, rng=rng), units(2, 4, rng=rng))
    found = random_starts(model, measured, 2000, generator=rng)
    assert_close(found.batch, torch.arange(2).repeat_interleave(2000))
    p, q = se3.transform(found.T, model.point[found.batch]), measured.point[found.batch]
    met = torch.cdist(p, q) < 1e-9
    assert met.flatten(1).any(1).all()
    # Each of 12 pairs is drawn 333 times of 4000; 5 deviations are 90.
    assert int(met.sum(0).min()) > 240
    R = found.T[:, :3, :3]
    eye = torch.eye(3, dtype=torch.float64)
    assert_close(R @ R.mT, eye.expand_as(R), rtol=0, atol=1e-12)
    # Entries of a uniform rotation have mean 0 and variance 1/3.
    assert_close(R.mean(0), torch.zeros_like(eye), rtol=0, atol=0.05)
    assert_close(R.square().mean(0), torch.full_like(eye, 1 / 3), rtol=0, atol=0.03)


def test_random_starts_follow_their_generator_and_the_dtype_of_the_elements(rng):
    own = elements("PL", normal(2, 2, 3, rng=rng), units(2, 2, rng=rng))
    one, two, three = (
        random_starts(own, own, 3, generator=torch.Generator().manual_seed(seed)).T
        for seed in (1, 1, 2)
    )
    assert_close(one, two, rtol=0, atol=0)
    assert one.dtype == torch.float64
    assert not torch.equal(one, three)
