"""What a tracker says of one frame."""

from dataclasses import dataclass
from enum import StrEnum

from jaxtyping import Float
from torch import Tensor

from torchcal.calibrate.readings import EXPLAINED


class TrackStatus(StrEnum):
    """Whether a frame could be used."""

    TRACKING = "tracking"
    LOST = "lost"
    """No state near the expected one explains the image."""
    AMBIGUOUS = "ambiguous"
    """Several states explain the image; nobody knows which of them is right."""
    UNUSABLE = "unusable"
    """The frame holds nothing that could be compared: no image, one of another size, or the one
    that was used last."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Tracked:
    """What is believed after a frame; where it was not used, what was believed before it."""

    name: str
    status: TrackStatus
    alarm: bool
    """The calibration that was carried so far does not explain what is seen."""
    message: str
    """One sentence for a person."""
    names: tuple[str, ...]
    """Of the parameters, as ``Parameters.names``."""
    state: Float[Tensor, "slot 4 4"]
    corrections: Float[Tensor, " parameter"]
    """Parameters that lead from the job's nominal values to ``state``."""
    covariance: Float[Tensor, "parameter parameter"]
    """P of eq. 3 of all parameters."""
    T_world_sensor: Float[Tensor, "4 4"]
    pose_covariance: Float[Tensor, "6 6"]
    """Of the twist on the right of ``T_world_sensor``."""
    p_value: float
    """How often chance alone would make image and expectation differ as much; 1 if not used."""
    agreement: float
    """Share of the measured blocks of pixels that are where the model says; 0 if not used."""
    seconds: float
    """That the step took."""


def expected_words(agreement: float, usual: float) -> str:
    """Of a frame that confirms what is estimated: objects may have changed all the same.

    Args:
        agreement: Share of what was measured that is where the model says.
        usual: The same of the frames so far; what never explained much confirms little.
    """
    share = f"{100.0 * agreement:.1f} % of what was measured."
    if usual < EXPLAINED:
        return f"The model explains only {share}"
    return f"What is estimated is as expected; the model agrees with {share}"
