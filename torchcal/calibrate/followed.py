"""Frames that ``follow`` has passed, looked at once more from what it wrote about them."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from torchcal.calibrate.compare import compare
from torchcal.calibrate.estimate import nominal_belief
from torchcal.calibrate.follow import first_tracker
from torchcal.calibrate.kept_result import FramePlace
from torchcal.calibrate.live_frame import usable_frame
from torchcal.calibrate.result import FrameComparison
from torchcal.calibrate.tracker import Tracker
from torchcal.errors import JobError
from torchcal.geometry import gaussian
from torchcal.model.job import Frame
from torchcal.model.read_job import Recording


@dataclass(frozen=True, kw_only=True, slots=True)
class Passed:
    """What was believed after one frame."""

    index: int
    """Of the frame in its recording."""
    state: Float[Tensor, "slot 4 4"]
    covariance: Float[Tensor, "parameter parameter"]


@dataclass(frozen=True, kw_only=True, slots=True)
class Followed:
    """A recording that is being followed by another program."""

    recording: Recording
    tracker: Tracker
    """As it was before the first frame."""

    @staticmethod
    def of(recording: Recording) -> "Followed":
        """A recording before its first frame.

        Raises:
            TorchcalError: If it cannot be followed.
        """
        tracker = first_tracker(recording, generator=torch.Generator().manual_seed(0))
        return Followed(recording=recording, tracker=tracker)

    def passed(self, index: int, line: Mapping[str, Any]) -> Passed:
        """What a line of ``frames.jsonl`` says.

        Raises:
            KeyError: If the line lacks what is needed.
        """
        parameters = self.tracker.parameters
        corrections = [line["corrections"][name]["value"] for name in parameters.names]
        nominal = parameters.nominal
        return Passed(
            index=index,
            state=parameters.retract(nominal, nominal.new_tensor(corrections)),
            covariance=nominal.new_tensor(line["covariance"]),
        )

    def place(self, passed: Passed) -> FramePlace:
        """Where everything was."""
        file = self.recording.files[passed.index]
        parameters = self.tracker.parameters.at(file.blank())
        Ts = parameters.mechanism.bodies(passed.state)[0].double().cpu()
        J = parameters.pose_jacobians(passed.state)[0]
        bodies = zip(self.tracker.scene.bodies, Ts, strict=True)
        return FramePlace(
            name=file.name,
            T_world_sensor=parameters.sensor_poses(passed.state)[0].double().cpu(),
            pose_covariance=gaussian.moved_covariance(passed.covariance, J).double().cpu(),
            Ts_world_link={body.link: T for body, T in bodies if body.link is not None},
        )

    def comparison(self, passed: Passed) -> FrameComparison:
        """The frame against the model as it was believed to be; blank where it cannot be read."""
        frame = self._frame(passed.index)
        parameters = self.tracker.parameters.at(frame)
        job = replace(self.tracker.job, frames=(frame,))
        belief = nominal_belief(job, parameters)
        belief = replace(belief, state=passed.state, covariance=passed.covariance)
        return compare(job, self.tracker.scene, parameters, belief)[1][0]

    def _frame(self, index: int) -> Frame:
        blank = self.recording.files[index].blank()
        try:
            frame = usable_frame(self.recording.frame(index), self.tracker.job)
        except JobError:
            return blank
        return blank if isinstance(frame, str) else frame
