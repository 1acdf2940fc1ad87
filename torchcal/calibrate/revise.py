"""The update as a whole (section 2.5): verdicts, moves, and what is new beside the corrected model.

What was removed or moved hides and reveals other things. So the images are compared once more with
the model as it should be, and only what still differs there is something new.
"""

from collections.abc import Mapping
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from torchcal.calibrate.absence import with_absent
from torchcal.calibrate.compare import Belief, compare_as_believed, without_range_error
from torchcal.calibrate.moves import Looked, find_moved
from torchcal.calibrate.parameters import Parameters
from torchcal.calibrate.result import Estimate, FrameComparison, ObjectVerdict, Update, Verdict
from torchcal.calibrate.update import added_objects, object_verdicts
from torchcal.model.job import Job
from torchcal.model.scene import Scene, without_bodies

SAME_PLACE = 1e-9
"""m and parts of a rotation: what rounding adds to a pose."""
CONTRADICTED = 0.1
"""Largest share of a moved object's pixels that may see through it where it is said to be."""


def revise(
    job: Job,
    scene: Scene,
    parameters: Parameters,
    belief: Belief,
    comparisons: tuple[FrameComparison, ...],
    estimate: Estimate,
    generator: torch.Generator,
) -> Update:
    """Proposes a better model of the world.

    Args:
        job: The recording.
        scene: Its model.
        parameters: What was unknown.
        belief: What was found, with the noise of ``comparisons``.
        comparisons: One for each frame.
        estimate: The same as the belief, in words.
        generator: Draws where moved objects may stand.
    """
    true = _in_true_ranges(comparisons, estimate)
    looked = Looked.of(job, scene, parameters, belief, true)
    known = {name: estimate.Ts_world_object[name] for name in estimate.moved}
    first = _verdicts(looked, known)
    if not estimate.estimated:
        first = with_absent(looked, first, generator)
    places = find_moved(looked, generator)
    while True:
        gone = [name for name in _removed(first) if name not in places]
        again = _corrected(looked, estimate, gone, places)
        second = _verdicts(again, known | places)
        wrong = [name for name in places if not _is_confirmed(second[name])]
        if not wrong:
            break
        places = {name: T for name, T in places.items() if name not in wrong}
    verdicts = {name: second[name] if name in places else first[name] for name in first}
    return Update(
        verdicts={name: _adjusted(each, name, job, estimate) for name, each in verdicts.items()},
        added=added_objects(job, again.comparisons, again.regions, estimate.Ts_world_sensor),
    )


def _in_true_ranges(
    comparisons: tuple[FrameComparison, ...], estimate: Estimate
) -> tuple[FrameComparison, ...]:
    return tuple(
        without_range_error(each, estimate.range_offset, estimate.range_scale)
        for each in comparisons
    )


def _verdicts(looked: Looked, moved: Mapping[str, Tensor]) -> dict[str, ObjectVerdict]:
    return object_verdicts(
        looked.job, looked.comparisons, looked.regions, looked.scene.bodies, moved
    )


def _adjusted(verdict: ObjectVerdict, name: str, job: Job, estimate: Estimate) -> ObjectVerdict:
    """An object of unknown pose that is still there, where it was estimated.

    The sensor's pose was estimated together with it: the model would contradict it elsewhere.
    """
    T = estimate.Ts_world_object.get(name)
    if T is None or job.world is None or verdict.verdict not in (Verdict.AGREES, Verdict.UNSEEN):
        return verdict
    (nominal,) = (item.T_world_object for item in job.world.objects if item.name == name)
    differs = float((T - nominal.to(T)).abs().max()) > SAME_PLACE
    return replace(verdict, T_world_object=T) if differs else verdict


def _removed(verdicts: Mapping[str, ObjectVerdict]) -> list[str]:
    return [name for name, each in verdicts.items() if each.verdict is Verdict.REMOVED]


def _is_confirmed(verdict: ObjectVerdict) -> bool:
    """Whether hardly a pixel sees through the object at its new place."""
    compared = verdict.agree + verdict.seen_through
    return verdict.verdict is Verdict.MOVED and verdict.seen_through <= CONTRADICTED * compared


def _corrected(
    looked: Looked,
    estimate: Estimate,
    gone: list[str],
    places: Mapping[str, Float[Tensor, "4 4"]],
) -> Looked:
    """The images against the model without some objects, and with others at new places."""
    world = looked.job.world
    if world is None or not (gone or places):
        return looked
    objects = tuple(
        replace(item, T_world_object=places.get(item.name, item.T_world_object))
        for item in world.objects
    )
    job = replace(looked.job, world=replace(world, objects=objects))
    bodies = [looked.scene.body_index(name) for name in gone]
    scene = replace(looked.scene, surface=without_bodies(looked.scene.surface, bodies))
    parameters = Parameters.of(job, scene)
    comparisons = compare_as_believed(job, scene, parameters, looked.belief)
    true = _in_true_ranges(comparisons, estimate)
    return Looked.of(job, scene, parameters, looked.belief, true)
