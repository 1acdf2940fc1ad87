"""Frames that ``follow`` has passed, looked at once more from what it wrote about them."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

from jaxtyping import Float
from torch import Tensor

from torchcal.calibrate.compare import compare
from torchcal.calibrate.estimate import nominal_belief
from torchcal.calibrate.kept_result import FramePlace
from torchcal.calibrate.live_frame import only_frame, usable_frame
from torchcal.calibrate.parameters import Parameters
from torchcal.calibrate.pipeline import build_job_scene
from torchcal.calibrate.result import FrameComparison
from torchcal.calibrate.slots import BASE
from torchcal.calibrate.tracked import TrackStatus
from torchcal.errors import JobError, TorchcalError
from torchcal.geometry import gaussian
from torchcal.model.job import Frame, Job
from torchcal.model.read_job import Recording
from torchcal.model.scene import Scene

ELSEWHERE = 1e-4
"""m and parts of 1: poses of the same line differ by less, written in single precision."""


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
    job: Job
    """Of one frame that is not there yet, as a tracker begins with it."""
    scene: Scene
    parameters: Parameters
    """Of that frame."""

    @staticmethod
    def of(recording: Recording) -> "Followed":
        """A recording before its first frame.

        Raises:
            TorchcalError: If its start is to be sought anywhere: its nominal pose says nothing.
        """
        job = recording.job
        if job.initial != "nominal":
            found = f"{job.file}: found search.initial = {job.initial!r}"
            raise TorchcalError(f"{found}; expected 'nominal' to view it while it is followed")
        first = recording.files[0].T_world_sensor
        if first is not None:
            job = replace(job, T_world_base=first.to(job.T_world_base))
        job, scene = only_frame(job), build_job_scene(job)
        parameters = Parameters.of(job, scene)
        return Followed(recording=recording, job=job, scene=scene, parameters=parameters)

    def passed(self, index: int, line: Mapping[str, Any]) -> Passed:
        """What a line of ``frames.jsonl`` says.

        Raises:
            KeyError: If the line lacks what is needed.
            TorchcalError: If it is of another job.
        """
        parameters, nominal = self.parameters, self.parameters.nominal
        self._refuse_other(index, line)
        corrections = [line["corrections"][name]["value"] for name in parameters.names]
        passed = Passed(
            index=index,
            state=parameters.retract(nominal, nominal.new_tensor(corrections)),
            covariance=nominal.new_tensor(line["covariance"]),
        )
        if line["status"] == TrackStatus.TRACKING:
            self._refuse_elsewhere(passed, line)
        return passed

    def _refuse_other(self, index: int, line: Mapping[str, Any]) -> None:
        """Raises unless a line is of the recording's frame and of the job's unknowns."""
        files, names = self.recording.files, self.parameters.names
        if index >= len(files):
            raise self._other(f"more than {len(files)} frames", "as many as the job has at most")
        if line["name"] != files[index].name:
            raise self._other(f"frame {line['name']}", f"{files[index].name}")
        if tuple(line["corrections"]) != names:
            raise self._other(", ".join(line["corrections"]), f"the unknowns {', '.join(names)}")

    def _refuse_elsewhere(self, passed: Passed, line: Mapping[str, Any]) -> None:
        """Raises unless the job puts the sensor where the line says, which the images do not."""
        said = passed.state.new_tensor(line["T_world_sensor"]).cpu().double()
        parameters = self._parameters_at(self.recording.blank(passed.index))
        found = parameters.sensor_poses(passed.state)[0].cpu().double()
        if not float((found - said).abs().max()) <= ELSEWHERE:
            raise self._other(
                f"a sensor in frame {line['name']} that is elsewhere than its corrections put it",
                "the nominal poses and joints of the job",
            )

    def _other(self, found: str, expected: str) -> TorchcalError:
        return TorchcalError(
            f"{self.job.file}: found {found} in what torchcal follow wrote; expected {expected}, "
            "since it is to be of this job"
        )

    def place(self, passed: Passed) -> FramePlace:
        """Where everything was."""
        parameters = self._parameters_at(self.recording.blank(passed.index))
        Ts = parameters.mechanism.at(passed.state).Ts_world_body[0].double().cpu()
        J = parameters.pose_jacobians(passed.state)[0]
        bodies = zip(self.scene.bodies, Ts, strict=True)
        return FramePlace(
            name=self.recording.files[passed.index].name,
            T_world_sensor=parameters.sensor_poses(passed.state)[0].double().cpu(),
            pose_covariance=gaussian.moved_covariance(passed.covariance, J).double().cpu(),
            Ts_world_link={body.link: T for body, T in bodies if body.link is not None},
        )

    def comparison(self, passed: Passed) -> FrameComparison:
        """The frame against the model as it was believed to be; blank where it cannot be read."""
        frame = self._frame(passed.index)
        parameters = self._parameters_at(frame)
        job = replace(self.job, frames=(frame,))
        belief = nominal_belief(job, parameters)
        belief = replace(belief, state=passed.state, covariance=passed.covariance)
        return compare(job, self.scene, parameters, belief)[1][0]

    def _parameters_at(self, frame: Frame) -> Parameters:
        return self.parameters.at(frame, self.parameters.nominal[BASE])

    def _frame(self, index: int) -> Frame:
        blank = self.recording.blank(index)
        try:
            frame = usable_frame(self.recording.frame(index), self.job)
        except JobError:
            return blank
        return blank if isinstance(frame, str) else frame
