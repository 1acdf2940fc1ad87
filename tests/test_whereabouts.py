"""What is known of a pose from a coarse image, and what of it is followed."""

import torch

from torchcal.calibrate.whereabouts import CLOSE, UNEXPLAINED, Whereabouts
from torchcal.geometry import robust


def of_costs(*costs: float) -> Whereabouts:
    poses = torch.eye(4, dtype=torch.float64).repeat(len(costs), 1, 1)
    poses[:, 0, 3] = torch.arange(len(costs))
    return Whereabouts(Ts_world_sensor=poses, cost=torch.tensor(costs, dtype=torch.float64))


def test_poses_that_cost_little_more_than_the_best_are_close():
    found = of_costs(1.0, 0.99 * CLOSE, 1.01 * CLOSE, 3.0)
    assert found.close[:, 0, 3].tolist() == [0.0, 1.0]


def test_the_best_is_close_to_itself_even_if_it_costs_nothing():
    assert len(of_costs(0.0, 0.1).close) == 1


def test_only_what_explains_a_good_part_of_the_image_is_promising():
    nothing = float(robust.biweight_cost(torch.tensor(100.0), robust.EFFICIENT))
    assert abs(nothing - UNEXPLAINED) < 1e-6
    assert of_costs(0.5 * nothing, nothing).promising
    assert not of_costs(0.7 * nothing).promising
