"""Objects that stand elsewhere than the model says (section 2.5).

What the images show nearer than the model without an object may be that object at another place:
its own mesh is laid onto those points, fitted to the pixels, and kept where they bear it out
better than the object at its old place or none at all.
"""

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchcal.calibrate.compare import Belief
from torchcal.calibrate.mechanism import centre_of
from torchcal.calibrate.nearest_fit import NearestFit
from torchcal.calibrate.observation import Observation, coarse_factor, coarser, grown, observe
from torchcal.calibrate.parameters import Parameters
from torchcal.calibrate.range_fit import RangeFit
from torchcal.calibrate.regions import Region, interior
from torchcal.calibrate.result import FrameComparison
from torchcal.calibrate.update import frame_regions
from torchcal.geometry import gaussian, robust, se3
from torchcal.geometry.projection import pixel_grid
from torchcal.model.job import Job, PosePrior
from torchcal.model.scene import Scene, Surface, without_bodies
from torchcal.render.synthesis import synthesise
from torchcal.solve.gauss_newton import (
    GaussNewtonConfig,
    Solution,
    covariance,
    minimise,
    shared,
)

SHIFT, TURN = 0.15, math.radians(10.0)
"""m, rad: standard deviations of where an object that was moved may stand."""
REACH = 0.5
"""m beyond its own outline: how far from its place an object is looked for."""
SUSPICIOUS = 0.1
"""Of an object's pixels: what differs on and beside it must be more before it is looked for."""
TOUCHING = 3
"""Pixels within which a region is beside an object."""
LEAST_POINTS = 30
"""Pixels in all frames on which a mesh is laid."""
DECISIVE = 10.0
"""Difference of robust costs that noise does not reach: a likelihood ratio of 20,000."""
GAIN = 0.9
"""Largest share of the cost that may be left: models are a little wrong everywhere."""
STARTS, POINTS = 12, 150
"""Poses from which the mesh is laid onto the points, and points of each frame."""
OPEN = 0.3
"""Share of the prior's sigma that is left of a direction which nothing tells."""
FARTHEST, STEPS = 1.5, 13
"""Prior sigmas to both sides, and the poses between them, in which such a direction is tried."""
LAY = GaussNewtonConfig(iterations=15, ripple=0.01)
FIT = GaussNewtonConfig(iterations=12, ripple=0.005)


@dataclass(frozen=True, kw_only=True, slots=True)
class Looked:
    """A recording against its model."""

    job: Job
    scene: Scene
    parameters: Parameters
    belief: Belief
    comparisons: tuple[FrameComparison, ...]
    """In true ranges."""
    regions: tuple[tuple[Region, ...], ...]
    """Of each frame."""

    @staticmethod
    def of(
        job: Job,
        scene: Scene,
        parameters: Parameters,
        belief: Belief,
        comparisons: tuple[FrameComparison, ...],
    ) -> "Looked":
        """With the regions that differ beyond chance; the comparisons are in true ranges."""
        regions = frame_regions(job, comparisons, correlation_pixels=belief.drift_pixels)
        return Looked(
            job=job,
            scene=scene,
            parameters=parameters,
            belief=belief,
            comparisons=comparisons,
            regions=regions,
        )


def find_moved(looked: Looked, generator: torch.Generator) -> dict[str, Float[Tensor, "4 4"]]:
    """``T_world_object`` of the objects that the images show at another place than the model.

    Objects whose pose the job declares unknown are left to the estimate.
    """
    found = {}
    for index in suspects(looked):
        T_world_object = _place_of(looked, index, generator)
        if T_world_object is not None:
            found[looked.scene.bodies[index].name] = T_world_object
    return found


def suspects(looked: Looked) -> list[int]:
    """The bodies of the world that regions touch which are no trifle beside them.

    What was pushed towards the sensor covers mostly other bodies with what is new.
    """
    differing = torch.zeros(len(looked.scene.bodies), dtype=torch.int64)
    shown = torch.zeros_like(differing)
    for frame, regions in zip(looked.comparisons, looked.regions, strict=True):
        shown += _pixels(frame.body[frame.usable], len(shown))
        for region in regions:
            beside = grown(region.mask[None].to(frame.body.device), TOUCHING)[0]
            touched = _pixels(frame.body[beside], len(shown)) > 0
            differing[touched] += region.pixels
    return [
        index
        for index, body in enumerate(looked.scene.bodies)
        if body.link is None
        and body.name not in looked.job.objects
        and differing[index] >= max(LEAST_POINTS, SUSPICIOUS * int(shown[index]))
    ]


def _pixels(body: Tensor, bodies: int) -> Int[Tensor, " body"]:
    """How many pixels show each body."""
    return torch.bincount(body[body >= 0].flatten().cpu(), minlength=bodies)


def _place_of(looked: Looked, index: int, generator: torch.Generator) -> Tensor | None:
    """Where the images show the object; None where they do not."""
    others = without_bodies(looked.scene.surface, [index])
    if not len(others.faces):
        return None
    observation = observe(looked.job)
    foreign = _foreign(looked, index, others)
    beam = looked.job.sensor.beam
    pure = torch.stack([interior(mask, beam) for mask in foreign]) & observation.measured
    if int(pure.sum()) < LEAST_POINTS:
        return None
    alone, surface = _alone(looked, index), looked.scene.surface
    fit = RangeFit(
        observation=_around(_with_drift(observation, looked.belief), looked, foreign, index),
        surface=surface,
        parameters=alone,
        cutoff=robust.EFFICIENT,
        drift=None,
        sigma_scale=looked.belief.sigma_scale,
    )
    laid = _laid_on(observation.without(~pure), _only(surface, index), alone, generator)
    coarse = replace(fit, observation=coarser(fit.observation, coarse_factor(observation.sensor)))
    state = _slid(coarse, laid)
    for each in (coarse, fit):
        # Most suspects are let go before the full resolution is looked at.
        solution = minimise(shared(each.evaluate), alone.retract, state, FIT)
        state = solution.state
        if not _is_gain(each, others, solution):
            return None
    return alone.object_poses(state[0])[-1]


def _is_gain(fit: RangeFit, others: Surface, solution: Solution) -> bool:
    """Whether the pixels bear a place out better than the old one, and than no object at all."""
    old = fit.parameters.nominal[None]
    stays, gone = (each.evaluate(old).cost for each in (fit, replace(fit, surface=others)))
    return bool(solution.equations.cost + DECISIVE < GAIN * torch.minimum(stays, gone))


def _only(surface: Surface, index: int) -> Surface:
    """The surface of one body."""
    bodies = int(surface.vertex_body.max()) + 1
    return without_bodies(surface, [body for body in range(bodies) if body != index])


def _laid_on(
    points: Observation, surface: Surface, alone: Parameters, generator: torch.Generator
) -> Solution:
    """The object's pose in which its surface lies best on measured points (3.5)."""
    nominal = alone.nominal.expand(STARTS, *alone.nominal.shape)
    steps = torch.randn(STARTS, len(alone.names), generator=generator, dtype=torch.float64)
    steps[0] = 0.0
    starts = alone.retract(nominal, steps.to(alone.prior_sigma) * alone.prior_sigma)
    first = _laid(points, surface, alone, alone.nominal, starts, generator)
    # The sides that are seen at the new place are not those seen at the old one.
    return _laid(points, surface, alone, first.state[0], first.state, generator)


def _laid(
    points: Observation,
    surface: Surface,
    alone: Parameters,
    seen_at: Tensor,
    starts: Tensor,
    generator: torch.Generator,
) -> Solution:
    """The best pose, with the sides of the object that are seen at one state."""
    fit = NearestFit.of(points, surface, alone, seen_at, count=POINTS, generator=generator)
    solution = minimise(shared(fit.evaluate), alone.retract, starts, LAY)
    best = int(solution.equations.cost.nan_to_num(torch.inf).argmin())
    return minimise(shared(fit.evaluate), alone.retract, solution.state[best : best + 1], LAY)


def _slid(fit: RangeFit, laid: Solution) -> Float[Tensor, "1 slot 4 4"]:
    """The best pose along the directions that points on its sides leave open.

    A box may slide along its own sides: only its outlines in the images say how far.
    """
    parameters, state = fit.parameters, laid.state
    left, directions = gaussian.left_over(
        covariance(laid.equations.information[0]), parameters.prior_sigma
    )
    grid = torch.linspace(-FARTHEST, FARTHEST, STEPS).to(state)
    for direction in directions.mT[left > OPEN]:
        steps = grid[:, None] * direction * parameters.prior_sigma
        states = parameters.retract(state.expand(STEPS, *state.shape[1:]), steps)
        best = int(fit.evaluate(states).cost.argmin())
        state = states[best : best + 1]
    return state


def _foreign(looked: Looked, index: int, others: Surface) -> Bool[Tensor, "frame h w"]:
    """Pixels near the object that show something nearer than the model without it."""
    job, scene, state = looked.job, looked.scene, looked.belief.state
    poses = looked.parameters.bodies_in_sensor(state)
    points = scene.surface.vertices[scene.surface.vertex_body == index].double()
    middle = centre_of(scene, index)
    reach = float((points - middle).norm(dim=-1).max()) + REACH
    masks = []
    for frame, Ts in zip(looked.comparisons, poses, strict=True):
        behind = synthesise(others, Ts.float(), job.sensor).range
        known = torch.where(
            frame.sigma.isfinite(), frame.sigma, job.sensor.noise.sigma(frame.measured)
        )
        nearer = ~(frame.measured > behind - job.alpha * known) & frame.measured.isfinite()
        centre = se3.transform(Ts[index], middle[None])[0]
        masks.append(nearer & frame.usable & (_distances(job, frame, centre) < reach))
    return torch.stack(masks)


def _distances(job: Job, frame: FrameComparison, p_sensor: Tensor) -> Float[Tensor, "h w"]:
    """How far (m) what every pixel measured is from a point in the sensor's frame."""
    projection = job.sensor.projection
    grid = pixel_grid(projection, dtype=torch.float64, device=frame.measured.device)
    return (frame.measured[..., None] * projection.rays(*grid) - p_sensor).norm(dim=-1)


def _alone(looked: Looked, index: int) -> Parameters:
    """The pose of one object as the only unknown, about where the model has it."""
    name, old = looked.scene.bodies[index].name, looked.parameters
    sigma = torch.tensor([SHIFT] * 3 + [TURN] * 3).to(old.prior_sigma)
    job = replace(looked.job, objects={**looked.job.objects, name: PosePrior(sigma=sigma)})
    new = Parameters.of(job, looked.scene)
    place = new.mechanism.slots.of_objects.stop - 1
    state = looked.belief.state
    columns = new.columns.unflatten(0, (-1, 6))[place].any(0)
    return replace(
        new,
        names=tuple(n for n, own in zip(new.names, columns.tolist(), strict=True) if own),
        units=tuple(u for u, own in zip(new.units, columns.tolist(), strict=True) if own),
        prior_sigma=new.prior_sigma[columns],
        columns=new.columns[:, columns],
        nominal=torch.cat([state[:place], new.nominal[place : place + 1], state[place:]]),
    )


def _with_drift(observation: Observation, belief: Belief) -> Observation:
    drift = torch.full_like(observation.sigma, belief.drift_sigma)
    return replace(observation, sigma=torch.hypot(observation.sigma, drift))


def _around(observation: Observation, looked: Looked, foreign: Tensor, index: int) -> Observation:
    """The pixels in and beside which the object is or may be, cut out."""
    beam = max(looked.job.sensor.beam, 1)
    shown = torch.stack([frame.body == index for frame in looked.comparisons])
    near = grown(foreign | shown, beam + 1)
    rows, columns = (near.any(0).any(axis).nonzero()[:, 0] for axis in (1, 0))
    height, width = near.shape[1:]
    top, bottom = max(int(rows[0]) - beam, 0), min(int(rows[-1]) + 1 + beam, height)
    left, right = max(int(columns[0]) - beam, 0), min(int(columns[-1]) + 1 + beam, width)
    return observation.without(~near).part(slice(top, bottom), slice(left, right))
