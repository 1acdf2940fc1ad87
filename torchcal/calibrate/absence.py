"""Objects that are gone although nobody has estimated from where the images were taken.

Where P is wide no single pixel can tell: each might show what is beside the object. All pixels
together can, for one pose must explain them all. So objects are judged from the pose within P that
explains the images best, and pixels from where the job says.
"""

from collections.abc import Mapping

import torch

from torchcal.calibrate.compare import compare
from torchcal.calibrate.estimate import agreement_with, belief_after
from torchcal.calibrate.fits import EXPLAINED_ANYWHERE, choose_start, fit_pixels
from torchcal.calibrate.moves import Looked
from torchcal.calibrate.refine import fitted_drift
from torchcal.calibrate.result import ObjectVerdict, Verdict
from torchcal.calibrate.spread import moves_far
from torchcal.calibrate.update import frame_regions, object_verdicts


def with_absent(
    looked: Looked, verdicts: Mapping[str, ObjectVerdict], generator: torch.Generator
) -> dict[str, ObjectVerdict]:
    """The verdicts, and "removed" where the pose that explains the images best sees through.

    Nothing changes without objects, where the pose is known well enough for single pixels to tell,
    and where several poses or none explain the images.
    """
    if not verdicts or not _is_wide(looked):
        return dict(verdicts)
    settled = _settled_verdicts(looked, generator)
    gone = {name: each for name, each in settled.items() if each.verdict is Verdict.REMOVED}
    return dict(verdicts) | gone


def _is_wide(looked: Looked) -> bool:
    """Whether P moves some image far."""
    belief, parameters = looked.belief, looked.parameters
    for k, frame in enumerate(looked.comparisons):
        active = parameters.active(k)
        motion = parameters.motion(belief.state, k).to(frame.predicted)
        P = belief.covariance[active[:, None], active]
        if moves_far(frame.predicted, frame.body, motion, P, looked.job.sensor):
            return True
    return False


def _settled_verdicts(looked: Looked, generator: torch.Generator) -> dict[str, ObjectVerdict]:
    job, scene, parameters = looked.job, looked.scene, looked.parameters
    choice = choose_start(job, scene, parameters, generator)
    refined = fit_pixels(job, scene, parameters, choice.state)
    belief = belief_after(refined, fitted_drift(refined))
    belief, comparisons = compare(job, scene, parameters, belief)
    if choice.rivals or agreement_with(comparisons, belief) < EXPLAINED_ANYWHERE:
        return {}
    regions = frame_regions(job, comparisons, correlation_pixels=belief.drift_pixels)
    return object_verdicts(job, comparisons, regions, scene.bodies, {})
