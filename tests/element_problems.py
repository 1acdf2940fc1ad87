"""Problems of elements that several test files solve."""

import torch

import torchcal
from torchcal import Elements, ElementSearch
from torchcal.demo import brick
from torchcal.geometry import se3

ALL_EIGHT = ElementSearch(enough=1.0)


def generator() -> torch.Generator:
    return torch.Generator().manual_seed(7)


def find(trials: brick.BrickTrials, **options) -> torchcal.ElementPoses:
    return torchcal.find_element_poses(
        brick.brick_model(),
        trials.measured,
        trials.candidates,
        **{"generator": generator(), "search": ALL_EIGHT, **options},
    )


def room(rng: torch.Generator, count: int = 60) -> tuple[Elements, Elements, torch.Tensor]:
    """Points, lines and planes of a room, measured with noise in ``count`` poses.

    Returns:
        The model, the measured elements in another order, and T_measured_model.
    """

    def unit(*shape: int) -> torch.Tensor:
        draw = torch.randn(*shape, 3, generator=rng, dtype=torch.float64)
        return torch.nn.functional.normalize(draw, dim=-1)

    def point(*shape: int) -> torch.Tensor:
        return 4 * torch.rand(*shape, 3, generator=rng, dtype=torch.float64) - 2

    model = Elements.join(
        Elements.points(point(3)),
        Elements.lines(point(4), unit(4)),
        Elements.planes(point(4), unit(4)),
    )
    T = se3.exp(torch.randn(count, 6, generator=rng, dtype=torch.float64))
    kind = model.kind.expand(count, -1)
    d = model.direction @ T[:, :3, :3].mT
    slide = torch.randn(count, 11, 3, generator=rng, dtype=torch.float64)
    along = (slide * d).sum(-1, keepdim=True) * d
    beside = torch.where((kind == 1)[..., None], along, slide - along)
    exact = se3.transform(T, model.point) + torch.where((kind == 0)[..., None], 0.0, beside)
    noise = torch.randn(count, 11, 6, generator=rng, dtype=torch.float64)
    noisy = exact + 0.01 * noise[..., :3]
    turned = torch.nn.functional.normalize(d + 0.005 * noise[..., 3:], dim=-1)
    sense = torch.where((kind == 1) & (noise[..., 0] > 0), -1.0, 1.0)[..., None]
    measured = Elements(
        kind=kind,
        point=noisy,
        direction=torch.where((kind == 0)[..., None], 0.0, sense * turned),
        covariance=torch.diag(torch.tensor([1e-4] * 3 + [2.5e-5] * 3).double()).expand(
            count, 11, 6, 6
        ),
    )
    return model, measured, T
