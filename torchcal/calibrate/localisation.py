"""What is known of a sensor's pose from one range image: poses of both stages, rivals, matches."""

from dataclasses import dataclass

from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchcal.calibrate.result import Status, UnobservableDirection
from torchcal.match.features import Features


@dataclass(frozen=True, kw_only=True, slots=True)
class StagePose:
    """A pose and how sure it is."""

    T_world_sensor: Float[Tensor, "4 4"]
    covariance: Float[Tensor, "6 6"]
    """Of the twist (m, rad) on the right of the pose."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Matches:
    """Which elements of the model are which of the image (3.1 (5)).

    Elements count planes first, then lines, then vertexes.
    """

    model: Features
    """What the model shows from about the pose, in the world's frame."""
    measured: Features
    """What the image shows, in the sensor's frame."""
    pairs: Int[Tensor, "pair 2"]
    """Matched elements: of the model, and measured."""
    used: Bool[Tensor, " pair"]
    """Whether the estimate rests on the pair; the others were found wrong."""
    model_alone: Int[Tensor, " model"]
    """Elements of the model without a partner."""
    measured_alone: Int[Tensor, " measured"]
    """Measured elements without a partner."""
    candidates: int
    """Pairs that C of eq. 6 allows."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Rival:
    """Another pose that explains the image as well."""

    T_world_sensor: Float[Tensor, "4 4"]
    score: float
    """Robust cost per measured pixel."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Localisation:
    """The pose of a sensor from one range image."""

    status: Status
    message: str
    """One sentence for a person."""
    elements: StagePose | None
    """From planes, lines and vertexes; None where they do not give a pose."""
    pixels: StagePose | None
    """From every pixel; None where nothing was found to start from."""
    agreement: float
    """Share of what was measured that is where the model says, within the noise."""
    score: float
    """Robust cost per measured pixel of the image's coarse rays; infinite without a pose."""
    rivals: tuple[Rival, ...]
    unobservable: tuple[UnobservableDirection, ...]
    """Directions that the image says nothing about."""
    matches: Matches | None
    seconds: dict[str, float]
    """Of each stage."""
