"""A tracker over a whole recording."""

from collections.abc import Iterator
from dataclasses import replace

import torch

from torchcal.calibrate.tracked import Tracked
from torchcal.calibrate.tracker import Tracker
from torchcal.calibrate.wander import Wander
from torchcal.errors import JobError
from torchcal.model.read_job import Recording


def follow(
    recording: Recording, *, drift: Wander | None = None, generator: torch.Generator
) -> Iterator[Tracked]:
    """What is believed after each frame; one that cannot be read is passed over.

    Args:
        recording: From ``read_recording``.
        drift: How much the unknowns may change between two frames.
        generator: Draws the starts of searches; on the CPU.

    Raises:
        TorchcalError: As ``Tracker.of``, before the first frame.
    """
    job = recording.job
    first = recording.files[0].T_world_sensor
    if first is not None:
        job = replace(job, T_world_base=first.to(job.T_world_base))
    tracker = Tracker.of(job, drift=drift, generator=generator)
    return _tracked(tracker, recording)


def _tracked(tracker: Tracker, recording: Recording) -> Iterator[Tracked]:
    for index, file in enumerate(recording.files):
        try:
            frame = recording.frame(index)
        except JobError as error:
            tracker, tracked = tracker.skip(file.name, str(error))
        else:
            tracker, tracked = tracker.step(frame)
        yield tracked
