"""torchcal's own poses from range images, called as the other programs are."""

import torch
import trimesh
from torch import Tensor

import torchcal

from .registration import Localise

POSITION_SIGMA, ROTATION_SIGMA = 0.2, 0.15
"""m and rad: all that is told of how far off the starting values are."""


def torchcal_all(mesh: trimesh.Trimesh, sensor: torchcal.Sensor) -> Localise:
    """Elements of the image and every pixel, with or without a starting value."""
    site = _site(mesh)

    def localise(image: Tensor, start: Tensor | None) -> Tensor:
        found = torchcal.localise(
            image, site, sensor, start=_prior(start), generator=torch.Generator().manual_seed(0)
        )
        return _pose(found)

    return localise


def torchcal_pixels(mesh: trimesh.Trimesh, sensor: torchcal.Sensor) -> Localise:
    """Every pixel alone."""
    site = _site(mesh)

    def localise(image: Tensor, start: Tensor | None) -> Tensor:
        prior = _prior(start)
        assert prior is not None
        found = torchcal.localise_pixels(
            image, site, sensor, start=prior, generator=torch.Generator().manual_seed(0)
        )
        return _pose(found)

    return localise


def _site(mesh: trimesh.Trimesh) -> torchcal.Site:
    origin = torch.eye(4, dtype=torch.float64)
    hall = torchcal.WorldObject(name="hall", mesh=mesh, T_world_object=origin)
    world = torchcal.World(objects=(hall,))
    scene = torchcal.build_scene(world, None, dtype=torch.float64, device=torch.device("cpu"))
    return torchcal.Site.of(scene.surface, origin[None], torch.Generator().manual_seed(0))


def _prior(start: Tensor | None) -> torchcal.Prior | None:
    if start is None:
        return None
    sigma = torch.tensor([POSITION_SIGMA] * 3 + [ROTATION_SIGMA] * 3, dtype=torch.float64)
    return torchcal.Prior(T_world_sensor=start, covariance=sigma.square().diag())


def _pose(found: torchcal.Localisation) -> Tensor:
    """Not a number where no pose was called found."""
    if found.pixels is None or found.status != torchcal.Status.CONVERGED:
        return torch.full((4, 4), torch.nan, dtype=torch.float64)
    return found.pixels.T_world_sensor
