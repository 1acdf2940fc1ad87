"""The proposed changes of the model (section 2.5): what is gone and what is new."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy import ndimage
from torch import Tensor

from torchcal.calibrate.evidence import borne_out
from torchcal.calibrate.patches import Patch, merged_objects
from torchcal.calibrate.reconstruct import mesh_of_region, pixel_width
from torchcal.calibrate.regions import (
    Region,
    RegionKind,
    connected_regions,
    interior,
    numbered,
    significant_regions,
)
from torchcal.calibrate.result import (
    AddedObject,
    FrameComparison,
    ObjectVerdict,
    PixelClass,
    Verdict,
)
from torchcal.model.job import Job
from torchcal.model.scene import Body
from torchcal.model.sensor import Sensor
from torchcal.model.unique_names import unique_names
from torchcal.model.world import World

SEEN_THROUGH_SHARE = 0.6
"""An object is gone when more than this share of what could be seen of it was seen through; with
less, part of it still stands there, and it was moved or changed rather than removed."""

LEAST_EVIDENCE = 30
"""Pixels (in all frames) that must show an object or see through it before anything is said."""

MODELLED_RING = 0.8
"""Share of the surroundings of an unmodelled patch that the model must fill before the patch
counts as a gap that something covers rather than as the end of the model."""

RING = 5
"""Pixels: the width of those surroundings."""


def frame_regions(
    job: Job, comparisons: Sequence[FrameComparison], *, correlation_pixels: float
) -> tuple[tuple[Region, ...], ...]:
    """The regions of every frame that differ from the model beyond chance."""
    return tuple(
        significant_regions(
            frame, job.sensor, correlation_pixels=correlation_pixels, alpha=job.alpha
        )
        for frame in comparisons
    )


def object_verdicts(
    job: Job,
    comparisons: Sequence[FrameComparison],
    regions: Sequence[Sequence[Region]],
    scene_bodies: tuple[Body, ...],
    moved: Mapping[str, Float[Tensor, "4 4"]],
) -> dict[str, ObjectVerdict]:
    """What the images say of every object of the world, and nothing of the robot's links.

    Args:
        job: Its sensor is used.
        comparisons: One for each frame.
        regions: Those of each frame.
        scene_bodies: What ``FrameComparison.body`` counts.
        moved: ``T_world_object`` of those that the estimate has found elsewhere.
    """
    verdicts = {
        body.name: object_verdict(index, comparisons, regions, job.sensor.beam)
        for index, body in enumerate(scene_bodies)
        if body.link is None
    }
    return {name: _moved(verdict, moved.get(name)) for name, verdict in verdicts.items()}


def added_objects(
    job: Job,
    comparisons: Sequence[FrameComparison],
    regions: Sequence[Sequence[Region]],
    Ts_world_sensor: Float[Tensor, "frame 4 4"],
) -> tuple[AddedObject, ...]:
    """New objects with meshes made from the range data."""
    patches = [
        patch
        for frame, found, T in zip(comparisons, regions, Ts_world_sensor, strict=True)
        for mask in new_surfaces(frame, found, job.world)
        if (patch := _patch(frame, mask, job.sensor, T)) is not None
    ]
    found = borne_out(merged_objects(patches), job, comparisons, Ts_world_sensor)
    taken = () if job.world is None else tuple(item.name for item in job.world.objects)
    return _renamed(found, taken)


def object_verdict(
    body: int,
    comparisons: Sequence[FrameComparison],
    regions: Sequence[Sequence[Region]],
    beam: int,
) -> ObjectVerdict:
    """What all frames together say of one body.

    Only pixels count that show nothing but this body: those within half a beam of its silhouette
    mix it with what stands behind it. Being hidden or never looked at is no evidence against it.
    """
    agree = seen_through = hidden = 0
    showing, piercing = [], []
    for frame, found in zip(comparisons, regions, strict=True):
        shown = interior(frame.body == body, beam) & frame.usable
        farther, nearer = (
            _union(found, kind, shown) for kind in (RegionKind.FARTHER, RegionKind.NEARER)
        )
        nearer |= (frame.label == PixelClass.NEARER) & ~farther
        agreeing = (frame.label == PixelClass.AGREES) & ~farther & ~nearer
        here, through = int((shown & agreeing).sum()), int((shown & farther).sum())
        agree, seen_through = agree + here, seen_through + through
        hidden += int((shown & nearer).sum())
        showing += [frame.name] if here else []
        piercing += [frame.name] if through else []
    verdict = _verdict(agree, seen_through)
    return ObjectVerdict(
        verdict=verdict,
        agree=agree,
        seen_through=seen_through,
        hidden=hidden,
        frames=tuple(piercing if verdict is Verdict.REMOVED else showing),
    )


def new_surfaces(
    frame: FrameComparison, regions: Sequence[Region], world: World | None
) -> list[Bool[Tensor, "h w"]]:
    """The pixels of each new thing that one frame shows.

    Regions nearer than the model, joined with what was measured where the model is empty: all of
    that if the world is complete, else only gaps of the model which a nearer region reaches into.
    """
    nothing = torch.zeros_like(frame.usable)
    nearer = _union(regions, RegionKind.NEARER, nothing)
    if world is None:
        beyond = nothing
    elif world.complete:
        beyond = _union(regions, RegionKind.UNMODELLED, nothing)
    else:
        beyond = _covered_gaps(frame, nearer)
    labels = connected_regions(nearer | beyond)
    return [labels == i for i in range(1, int(labels.max()) + 1)]


def _verdict(agree: int, seen_through: int) -> Verdict:
    compared = agree + seen_through
    if compared < LEAST_EVIDENCE:
        return Verdict.UNSEEN
    is_gone = seen_through > SEEN_THROUGH_SHARE * compared
    return Verdict.REMOVED if is_gone else Verdict.AGREES


def _moved(verdict: ObjectVerdict, T_world_object: Tensor | None) -> ObjectVerdict:
    """An object that the images show where the estimate has it, and not where the model has it."""
    if T_world_object is None or verdict.verdict is not Verdict.AGREES:
        return verdict
    return replace(verdict, verdict=Verdict.MOVED, T_world_object=T_world_object)


def _renamed(added: Sequence[AddedObject], taken: Sequence[str]) -> tuple[AddedObject, ...]:
    """The added objects under names that no object of the world has."""
    names = unique_names([*taken, *(item.name for item in added)])[len(taken) :]
    return tuple(replace(item, name=name) for item, name in zip(added, names, strict=True))


def _union(regions: Sequence[Region], kind: RegionKind, like: Tensor) -> Bool[Tensor, "h w"]:
    """The pixels of all regions of a kind."""
    union = torch.zeros_like(like)
    for region in regions:
        if region.kind == kind:
            union |= region.mask.to(like.device)
    return union


def _covered_gaps(frame: FrameComparison, nearer: Bool[Tensor, "h w"]) -> Bool[Tensor, "h w"]:
    """Gaps of the model that a nearer region reaches into and the model surrounds."""
    inside = nearer.cpu().numpy()
    unmodelled = ((frame.label == PixelClass.UNMODELLED) & frame.usable).cpu().numpy()
    modelled = frame.predicted.isfinite().cpu().numpy()
    gaps = numbered(unmodelled)
    reach = np.asarray(ndimage.binary_dilation(inside, iterations=2), bool)
    reached = np.unique(gaps[reach])
    covered = [g for g in reached if g > 0 and _is_surrounded(gaps == g, modelled, inside)]
    return torch.from_numpy(np.isin(gaps, covered)).to(nearer.device)


def _is_surrounded(gap: np.ndarray, modelled: np.ndarray, nearer: np.ndarray) -> bool:
    """Whether a gap is smaller than what was found nearer and the model fills its surroundings."""
    ring = ndimage.binary_dilation(gap, np.ones((3, 3), bool), iterations=RING) & ~gap
    return bool(gap.sum() <= nearer.sum() and modelled[ring].mean() >= MODELLED_RING)


def _patch(
    frame: FrameComparison,
    mask: Bool[Tensor, "h w"],
    sensor: Sensor,
    T_world_sensor: Float[Tensor, "4 4"],
) -> Patch | None:
    """The mesh of one region; None where its pixels hold no triangle."""
    measured = frame.measured[mask]
    middle = measured.nanmedian()
    sigma = float(sensor.noise.sigma(middle))
    mesh = mesh_of_region(
        frame.measured,
        mask,
        sensor.projection,
        T_world_sensor,
        sigma=sigma,
        beam=sensor.beam,
        behind=frame.predicted,
    )
    if len(mesh.faces) == 0:
        return None
    known = float(frame.sigma[mask].nanmedian())
    spread = max(sigma, known) if math.isfinite(known) else sigma
    width = pixel_width(sensor.projection) * float(middle)
    return Patch(frame=frame.name, mesh=mesh, tolerance=2.0 * (spread + width))
