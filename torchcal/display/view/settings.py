"""What a person has chosen to see."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from torchcal.calibrate.kept_result import Result
from torchcal.calibrate.result import FrameComparison
from torchcal.display.arrays import as_array

LEAST_ALPHA, MOST_ALPHA, ALPHA_STEP = 0.5, 20.0, 0.5
"""Standard deviations: the ends and steps of the slider of eq. 5's alpha."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Settings:
    """The state of the controls."""

    frame: int = 0
    alpha: float
    selected: str
    """The object whose evidence is shown; empty where there is none."""
    raw: bool = False
    """The measurement alone, by its range: no model, no classes."""
    model: bool = True
    measurement: bool = True
    hybrid: bool = True
    along: bool = True
    """The viewer looks over the sensor's shoulder in every new frame."""

    @staticmethod
    def of(result: Result) -> "Settings":
        """What is shown first: the first frame, and the first proposal."""
        names = object_names(result)
        alpha = min(max(result.alpha, LEAST_ALPHA), MOST_ALPHA)
        return Settings(alpha=alpha, selected=names[0] if names else "")

    @property
    def shows_model(self) -> bool:
        """Whether world and robot are drawn."""
        return self.model and not self.raw

    @property
    def shows_points(self) -> bool:
        """Whether the measured points are drawn."""
        return self.measurement or self.raw


def object_names(result: Result) -> tuple[str, ...]:
    """Everything that can be asked about: proposals first, then the rest of the model."""
    proposed = result.transaction.decisions
    return (*proposed, *(name for name in result.bodies if name not in proposed))


def shoulder_look(
    T_world_sensor: Float[np.ndarray, "4 4"], comparison: FrameComparison
) -> tuple[Float[np.ndarray, " 3"], Float[np.ndarray, " 3"]]:
    """Where a viewer stands behind the sensor and what it looks at (m, world)."""
    ranges = as_array(comparison.measured)
    finite = ranges[np.isfinite(ranges)]
    away = float(np.median(finite)) if finite.size else 1.0
    place, (right, down, forward) = T_world_sensor[:3, 3], T_world_sensor[:3, :3].T
    eye = place - 0.45 * away * forward - 0.4 * away * down + 0.3 * away * right
    return eye, place + 0.7 * away * forward
