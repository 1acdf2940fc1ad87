"""Objects of unknown pose that only their own uncertainty makes agree with the images.

A fit that has let go of an object, whose pixels are all beyond the cut-off, is told of its pose by
the few pixels that are left, and is sure of what they happen to say. Of such an object nothing
counts as told.
"""

from collections.abc import Collection, Sequence
from dataclasses import replace

import torch

from torchcal.calibrate.compare import Belief
from torchcal.calibrate.parameters import Parameters
from torchcal.calibrate.result import FrameComparison, PixelClass
from torchcal.geometry import robust
from torchcal.model.scene import Scene
from torchcal.model.sensor import Sensor


def excused_objects(
    sensor: Sensor,
    scene: Scene,
    parameters: Parameters,
    belief: Belief,
    comparisons: Sequence[FrameComparison],
) -> tuple[str, ...]:
    """Unknown objects of whose agreeing pixels most would differ if P of eq. 4 were 0."""
    excused = []
    for name in parameters.object_names:
        body, near, far = scene.body_index(name), 0, 0
        for frame in comparisons:
            shown = (frame.body == body) & frame.usable & (frame.label == PixelClass.AGREES)
            noise = sensor.noise.sigma(frame.predicted) * belief.sigma_scale
            noise = torch.hypot(noise, torch.full_like(noise, belief.drift_sigma))
            close = (frame.measured - frame.predicted).abs() <= robust.AGREEING * noise
            near, far = near + int((shown & close).sum()), far + int((shown & ~close).sum())
        if far > near:
            excused.append(name)
    return tuple(excused)


def told_nothing_of(objects: Collection[str], parameters: Parameters, belief: Belief) -> Belief:
    """The belief with nothing but the prior in the poses of some objects."""
    starts = tuple(f"objects.{name}." for name in objects)
    place = [k for k, name in enumerate(parameters.names) if name.startswith(starts)]
    P = belief.covariance.clone()
    P[place] = 0.0
    P[:, place] = 0.0
    P[place, place] = parameters.prior_sigma[place].square().to(P)
    return replace(belief, covariance=P)
