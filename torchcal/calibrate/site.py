"""A place whose model is known, made ready for range images from anywhere in it."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from torchcal.geometry import se3
from torchcal.match.directions import Directions
from torchcal.match.model.features import ModelFeatures, find_model_features
from torchcal.match.model.visibility import Seen, visible
from torchcal.match.prior_gate import Prior
from torchcal.match.volume import Volume
from torchcal.model.scene import Surface
from torchcal.model.sensor import Sensor
from torchcal.render.synthesis import synthesise

DIRECTIONS = 14
"""Most directions of planes that rotations are sought with."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Site:
    """What stands still, with all that does not depend on the image."""

    surface: Surface
    Ts_world_body: Float[Tensor, "body 4 4"]
    features: ModelFeatures
    """The model's elements in the world (3.1 (2))."""
    directions: Directions
    """Normals of the model's planes, by area."""
    volume: Volume
    low: Float[Tensor, "3"]
    """m: the least coordinates of the model, in the world."""
    high: Float[Tensor, "3"]

    @property
    def extent(self) -> Float[Tensor, "6"]:
        """Standard deviations (m, rad) of a pose of which nothing but the site is known."""
        return extent(self.low, self.high)

    @property
    def middle(self) -> Prior:
        """No more than that the sensor is about the site."""
        T = torch.eye(4).to(self.low)
        T[:3, 3] = 0.5 * (self.low + self.high)
        return Prior(T_world_sensor=T, covariance=torch.diag(self.extent.square()))

    def seen_from(
        self, T_world_sensor: Float[Tensor, "4 4"], sensor: Sensor, *, jump: float
    ) -> Seen:
        """Which of the elements a sensor with ideal rays sees.

        Args:
            T_world_sensor: Where it is.
            sensor: Its optics and limits.
            jump: m; a smaller step of the range is no edge.
        """
        poses = se3.inverse(T_world_sensor) @ self.Ts_world_body
        rays = replace(sensor, beam=0)
        face = synthesise(self.surface, poses.to(self.surface.vertices), rays).face
        return visible(self.features, T_world_sensor, sensor.projection, face, jump=jump)

    @staticmethod
    def of(
        surface: Surface, Ts_world_body: Float[Tensor, "body 4 4"], generator: torch.Generator
    ) -> "Site":
        """Finds the elements of a scene and its voxels.

        Args:
            surface: Triangles on bodies.
            Ts_world_body: Where the bodies stand.
            generator: Draws points of the surface; on the CPU.
        """
        exact = replace(surface, vertices=surface.vertices.double())
        features = find_model_features(exact, Ts_world_body.double())
        planes = features.features.planes
        corners = features.triangles.flatten(0, 1)
        return Site(
            surface=replace(surface, vertices=surface.vertices.float()),
            Ts_world_body=Ts_world_body.double(),
            features=features,
            directions=Directions.of(planes.elements.direction, planes.area, count=DIRECTIONS),
            volume=Volume.of(features.triangles, generator),
            low=corners.amin(0),
            high=corners.amax(0),
        )


def extent(low: Float[Tensor, "3"], high: Float[Tensor, "3"]) -> Float[Tensor, "6"]:
    """Standard deviations (m, rad) of a pose that is somewhere in a box (m)."""
    return torch.cat([(high - low).norm().expand(3), low.new_full((3,), torch.pi)])
