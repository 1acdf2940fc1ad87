"""What the sensor should measure in every frame (eq. 2) with its own errors, and H of eq. 4."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchcal.calibrate.parameters import Parameters
from torchcal.model.scene import Surface
from torchcal.model.sensor import Sensor
from torchcal.render.synthesis import Synthesis, synthesise


@dataclass(frozen=True, kw_only=True, slots=True)
class Prediction:
    """One frame's predicted image."""

    range: Float[Tensor, "h w"]
    """m, as a sensor with the state's offset and scale measures it; NaN where nothing is met."""
    jacobian: Float[Tensor, "h w active"]
    """H of eq. 4: derivative of ``range``; 0 where it is NaN."""
    active: Int[Tensor, " active"]
    """The parameters of ``jacobian``; the image does not depend on others."""
    synthesis: Synthesis
    """Before the sensor's own errors."""


def predictions(
    surface: Surface,
    sensor: Sensor,
    parameters: Parameters,
    state: Float[Tensor, "slot 4 4"],
    *,
    dtype: torch.dtype,
    frames: Sequence[int] | None = None,
) -> Iterator[Prediction]:
    """Predicts frame by frame, so that one frame's derivatives are held at a time.

    Args:
        surface: The scene's triangles.
        sensor: What measures them.
        parameters: What is unknown.
        state: Where everything is.
        dtype: Of the images.
        frames: Which; all if left out.
    """
    offset, scale = parameters.range_error(state).tolist()
    Ts_sensor_body = parameters.bodies_in_sensor(state).to(dtype)
    frames = range(len(Ts_sensor_body)) if frames is None else frames
    for k, motion in zip(frames, parameters.motions(state, frames), strict=True):
        synthesis = synthesise(surface, Ts_sensor_body[k], sensor, motion.to(dtype))
        assert synthesis.jacobian is not None, "a motion was given"
        active = parameters.active(k)
        measured = offset + (1.0 + scale) * synthesis.range
        yield Prediction(
            range=measured,
            jacobian=_with_range_error(synthesis, parameters, active, scale),
            active=active,
            synthesis=synthesis,
        )


def _with_range_error(
    synthesis: Synthesis, parameters: Parameters, active: Tensor, scale: float
) -> Tensor:
    """The derivative to all active parameters: z_measured = offset + (1 + scale) z."""
    assert synthesis.jacobian is not None, "a motion was given"
    to_offset, to_scale = parameters.range_parameters
    if to_offset is None and to_scale is None:
        return synthesis.jacobian
    met = synthesis.range.isfinite()
    own = {
        to_offset: met.to(synthesis.range),
        to_scale: torch.where(met, synthesis.range, 0.0),
    }
    jacobian = (1.0 + scale) * synthesis.jacobian
    for place, parameter in enumerate(active.tolist()):
        if parameter in own:
            jacobian[..., place] = own[parameter]
    return jacobian
