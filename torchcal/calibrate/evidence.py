"""What all frames say of a thing that some of them showed (section 2.5): for, against, hidden."""

from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from torchcal.calibrate.range_fit import FILLED
from torchcal.calibrate.regions import EDGE_TOLERANCE, interior, steepness
from torchcal.calibrate.result import AddedObject, Evidence, FrameComparison
from torchcal.geometry import se3
from torchcal.model.job import Job
from torchcal.model.scene import build_scene
from torchcal.model.world import World, WorldObject
from torchcal.render.synthesis import synthesise


def borne_out(
    added: Sequence[AddedObject],
    job: Job,
    comparisons: Sequence[FrameComparison],
    Ts_world_sensor: Float[Tensor, "frame 4 4"],
) -> tuple[AddedObject, ...]:
    """The objects that fewer pixels see through than show, with their evidence, named anew.

    Args:
        added: What single frames showed, the largest first.
        job: The recording; its sensor and alpha are used.
        comparisons: One for each frame, in true ranges.
        Ts_world_sensor: The pose of each frame.
    """
    judged = [
        replace(item, evidence=evidence_of(item, job, comparisons, Ts_world_sensor))
        for item in added
    ]
    kept = [item for item in judged if item.evidence.contradicting <= item.evidence.supporting]
    return tuple(replace(item, name=f"added_{i}") for i, item in enumerate(kept, start=1))


def evidence_of(
    item: AddedObject,
    job: Job,
    comparisons: Sequence[FrameComparison],
    Ts_world_sensor: Float[Tensor, "frame 4 4"],
) -> Evidence:
    """Pixels that show an added object, that see through its mesh, and that see something nearer.

    Pixels within half a beam of the mesh's outline show other things as well and are not asked.
    """
    eye = torch.eye(4, dtype=torch.float64)
    alone = World(objects=(WorldObject(name=item.name, mesh=item.mesh, T_world_object=eye),))
    surface = build_scene(alone, None, dtype=torch.float32, device=Ts_world_sensor.device).surface
    images = synthesise(surface, se3.inverse(Ts_world_sensor)[:, None].float(), job.sensor)
    through = hidden = 0
    for frame, shown, full in zip(comparisons, images.range, images.coverage, strict=True):
        mask = interior((full > FILLED) & shown.isfinite(), job.sensor.beam)
        mask = mask & frame.usable & frame.measured.isfinite()
        difference = (frame.measured - shown) / _sigma(frame, shown, job)
        through += int((mask & (difference > job.alpha)).sum())
        hidden += int((mask & (difference < -job.alpha)).sum())
    return Evidence(supporting=item.evidence.supporting, contradicting=through, hidden=hidden)


def _sigma(frame: FrameComparison, shown: Float[Tensor, "h w"], job: Job) -> Float[Tensor, "h w"]:
    """What a pixel may differ from a mesh that was itself measured (m)."""
    noise = job.sensor.noise.sigma(shown)
    known = torch.maximum(noise, frame.sigma.to(noise).nan_to_num(0.0))
    slope = torch.from_numpy(steepness(shown.double().cpu().numpy())).to(noise)
    return torch.hypot(known, EDGE_TOLERANCE * slope)
