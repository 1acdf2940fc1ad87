"""The method on one page: estimate, compare, update (sections 2 and 3 of the paper)."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchcal.calibrate.anywhere import locate
from torchcal.calibrate.compare import Belief, compare, compare_as_believed
from torchcal.calibrate.estimate import (
    belief_after,
    declared_agreement,
    doubted,
    estimate_of,
    nominal_belief,
)
from torchcal.calibrate.excused import excused_objects, told_nothing_of
from torchcal.calibrate.fits import Choice, choose_found, choose_start, fit_pixels, fit_rest
from torchcal.calibrate.foresight import next_view
from torchcal.calibrate.observation import grown
from torchcal.calibrate.parameters import Parameters
from torchcal.calibrate.readings import EXPLAINED, misreadings
from torchcal.calibrate.refine import fitted_drift, slow_error
from torchcal.calibrate.regions import significant_regions
from torchcal.calibrate.result import Calibration, FrameComparison, Status
from torchcal.calibrate.revise import revise
from torchcal.calibrate.stages import ONCE, Progress, Stages, Tick
from torchcal.calibrate.suspicion import suspicions
from torchcal.model.job import Job, check_frames
from torchcal.model.precision import job_in_double
from torchcal.model.scene import Scene, build_scene
from torchcal.render.synthesis import synthesise


def calibrate(
    job: Job,
    *,
    estimate: bool = True,
    generator: torch.Generator,
    progress: Progress | None = None,
) -> Calibration:
    """Estimates what is unknown, compares model and measurement, and proposes a better model.

    Args:
        job: The recording and everything that is believed about it.
        estimate: False: compare at the nominal pose, with the prior for P of eq. 3.
        generator: Draws starts and points; on the CPU.
        progress: Called at the beginning and the end of each stage, and with each image between.

    Raises:
        TorchcalError: If there is no frame, or one of which nobody knows where it was taken.
    """
    check_frames(job)
    stages = Stages(progress, len(job.frames))
    dtype, job = job.T_world_base.dtype, job_in_double(job)
    bases = None
    if estimate and job.initial == "anywhere":
        with stages.stage("look everywhere"):
            located = locate(job, generator)
            job, bases = located.job, located.Ts_world_base
    scene = build_job_scene(job)
    parameters = Parameters.of(job, scene)
    belief, choice = nominal_belief(job, parameters), None
    if estimate and parameters.names:
        belief, choice = _estimated(job, scene, parameters, generator, bases, stages)
    with stages.stage("compare", rounds=ONCE):
        belief, comparisons = compare(job, scene, parameters, belief, stages.tick)
        if choice is not None:
            belief, comparisons = _without_excuses(job, scene, parameters, belief, comparisons)
    result = estimate_of(job.sensor, parameters, belief, choice, comparisons)
    with stages.stage("update"):
        update = revise(job, scene, parameters, belief, comparisons, result, generator)
    warnings = suspicions(job)
    agreement = declared_agreement(job.sensor, belief, comparisons)
    if choice is not None and (result.status != Status.CONVERGED or agreement < EXPLAINED):
        with stages.stage("look for a mistake"):
            mistakes = misreadings(job, scene, parameters, belief.state)
        result, warnings = doubted(result, mistakes), warnings + mistakes
    ahead = None
    if choice is not None:
        with stages.stage("look ahead"):
            ahead = next_view(job, scene, belief.state, belief.covariance, generator)
    return Calibration(
        job=job,
        estimate=result.to(dtype),
        comparisons=comparisons,
        update=update,
        next_view=ahead,
        warnings=warnings,
        timing=stages.timing,
        seed=generator.initial_seed(),
    )


def predict(job: Job) -> tuple[Float[Tensor, "h w"], ...]:
    """What the model predicts at the nominal pose: range images (m), NaN where nothing is met.

    Raises:
        TorchcalError: As ``calibrate``.
    """
    check_frames(job)
    job = job_in_double(job)
    scene = build_job_scene(job)
    parameters = Parameters.of(job, scene)
    poses = parameters.bodies_in_sensor(parameters.nominal).float()
    return tuple(synthesise(scene.surface, pose, job.sensor).range for pose in poses)


def build_job_scene(job: Job) -> Scene:
    """The job's world and robot as one surface, on the job's device."""
    device = job.T_world_base.device
    return build_scene(job.world, job.robot, dtype=torch.float32, device=device)


def _estimated(
    job: Job,
    scene: Scene,
    parameters: Parameters,
    generator: torch.Generator,
    bases: Float[Tensor, "start 4 4"] | None,
    stages: Stages,
) -> tuple[Belief, Choice]:
    """Section 3: start, fit, set aside what differs, fit the rest."""
    with stages.stage("find a start"):
        if bases is None:
            choice = choose_start(job, scene, parameters, generator, stages.tick)
        else:
            choice = choose_found(job, scene, parameters, parameters.with_base(bases), stages.tick)
    with stages.stage("fit every pixel"):
        refined = fit_pixels(job, scene, parameters, choice.state, stages.tick)
    with stages.stage("set aside what differs"):
        # Set aside for the fit is what its own noise model does not explain.
        belief = belief_after(refined, fitted_drift(refined))
        differing = _differing_pixels(job, scene, parameters, belief, stages.tick)
    with stages.stage("fit the rest"):
        refined = fit_rest(job, scene, parameters, refined, differing, stages.tick)
        return belief_after(refined, slow_error(refined)), choice


def _without_excuses(
    job: Job,
    scene: Scene,
    parameters: Parameters,
    belief: Belief,
    comparisons: tuple[FrameComparison, ...],
) -> tuple[Belief, tuple[FrameComparison, ...]]:
    """The same, with nothing told of the objects that the images do not bear out."""
    excused = excused_objects(job.sensor, scene, parameters, belief, comparisons)
    if not excused:
        return belief, comparisons
    belief = told_nothing_of(excused, parameters, belief)
    return belief, compare_as_believed(job, scene, parameters, belief)


def _differing_pixels(
    job: Job, scene: Scene, parameters: Parameters, belief: Belief, tick: Tick
) -> Bool[Tensor, "frame h w"]:
    """Pixels in or beside regions that differ from the model: their beams mix both surfaces."""
    belief, comparisons = compare(job, scene, parameters, belief, tick)
    return torch.stack([_differing(job, frame, belief.drift_pixels) for frame in comparisons])


def _differing(job: Job, frame: FrameComparison, correlation_pixels: float) -> Tensor:
    regions = significant_regions(
        frame, job.sensor, correlation_pixels=correlation_pixels, alpha=job.alpha
    )
    mask = torch.zeros_like(frame.usable)
    for region in regions:
        mask |= region.mask.to(mask.device)
    return grown(mask[None], job.sensor.beam + 2)[0]
