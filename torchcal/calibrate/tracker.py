"""Continuous calibration: one frame after the other, with an alarm when something was moved.

Between frames what is believed gets less sure by the drift model. A frame is fitted with little
regard to it, so that a bumped camera is found; then both are joined if chance explains how they
differ, and if not the frame is believed.
"""

import time
from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from torchcal.calibrate.anywhere import check_searchable, locate, without_prior
from torchcal.calibrate.fits import EXPLAINED, EXPLAINED_ANYWHERE
from torchcal.calibrate.frame_fit import FrameFit, Told, Trust
from torchcal.calibrate.frame_search import FrameSearch, Sighting
from torchcal.calibrate.innovation import Innovation, innovation
from torchcal.calibrate.live_frame import is_repeated, only_frame, usable_frame
from torchcal.calibrate.observability import parameter_words
from torchcal.calibrate.parameters import Parameters
from torchcal.calibrate.pipeline import build_job_scene
from torchcal.calibrate.result import rivals_words
from torchcal.calibrate.slots import BASE
from torchcal.calibrate.tracked import Tracked, TrackStatus, expected_words
from torchcal.calibrate.wander import Wander, own_error, usually_unsure
from torchcal.errors import TorchcalError
from torchcal.geometry import gaussian
from torchcal.model.job import Frame, Job
from torchcal.model.precision import frame_in_double, job_in_double
from torchcal.model.scene import Scene

CHANCE = 1e-6
"""An alarm if chance alone would make a frame differ as much less often than this."""
BUMP = {"m": 0.03, "rad": 0.035, "1": 0.01}
"""What a bump may change at once, in the parameters' units, beyond the drift."""
FORGOTTEN = 0.1
"""Share of the usual agreement that each frame replaces where it agrees less."""
PATIENCE = 3
"""So many lost or ambiguous frames in a row are an alarm."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Tracker:
    """What is believed of a job's unknowns before its next frame."""

    job: Job
    """Without frames."""
    scene: Scene
    parameters: Parameters
    """Of one frame: the last one that could be placed."""
    drift: Float[Tensor, " parameter"]
    """Standard deviation of the change between two frames."""
    generator: torch.Generator
    state: Float[Tensor, "slot 4 4"]
    covariance: Float[Tensor, "parameter parameter"]
    T_first: Float[Tensor, "4 4"]
    """Nominal pose of the frame whose sensor the base is; without a robot."""
    dtype: torch.dtype
    """Of what is told: the job's own."""
    starts: Float[Tensor, "start slot 4 4"] | None = None
    """Where the first frame may be: found anywhere in the world."""
    trust: Trust | None = None
    """None until a frame was explained."""
    agreement: float = 0.0
    """What is usual: of the last frames that were explained."""
    frame: Frame | None = None
    """The last one that was believed."""
    lost: int = 0
    """Frames in a row that were not explained, or by several states."""

    @staticmethod
    def of(job: Job, *, drift: Wander | None = None, generator: torch.Generator) -> "Tracker":
        """Begins with what a job believes.

        Args:
            job: World, robot, sensor and what is unknown; its frames are not looked at. Without a
                robot the first one's nominal pose is where the sensor is believed to start; if
                there is none, it is ``job.T_world_base``.
            drift: How much the unknowns may change between two frames.
            generator: Draws the starts of searches; on the CPU.

        Raises:
            TorchcalError: If the job declares nothing unknown, the drift is not of its unknowns, or
                the start is to be sought anywhere with images that are too small for that.
        """
        if job.initial == "anywhere":
            check_searchable(job)
        dtype, job = job.T_world_base.dtype, job_in_double(job)
        alone = only_frame(job)
        scene = build_job_scene(job)
        parameters = Parameters.of(without_prior(alone), scene)
        if not parameters.names:
            raise TorchcalError(f"{job.file}: found nothing unknown; expected something to track")
        return Tracker(
            job=replace(job, frames=()),
            scene=scene,
            parameters=parameters,
            drift=(drift or Wander()).sigmas(usually_unsure(job, parameters)),
            generator=generator,
            state=parameters.nominal,
            covariance=torch.diag(parameters.prior_sigma.square()),
            T_first=parameters.nominal[BASE],
            dtype=dtype,
        )

    def step(self, frame: Frame) -> tuple["Tracker", Tracked]:
        """Takes the next frame.

        Returns:
            The tracker for the frame after it, and what is believed now. A frame that cannot be
            used changes no estimate and is no error.
        """
        began = time.perf_counter()
        usable = usable_frame(frame_in_double(frame), self.job)
        if isinstance(usable, str):
            return self.skip(frame.image.name, usable)
        if self.frame is not None and is_repeated(usable, self.frame):
            return self._repeated(frame.image.name, began)
        anywhere = self.job.initial == "anywhere"
        begun = self._located(usable) if anywhere else self
        expecting = begun._expecting(begun.parameters.at(usable, begun.T_first))
        alone = replace(begun.job, frames=(usable,))
        fit = FrameFit.of(alone, self.scene, expecting._wide(), self.trust or Trust())
        before = self if anywhere else expecting
        if not fit.measured:
            words = "The image holds no area that can be compared."
            return before, before._unused(frame.image.name, TrackStatus.UNUSABLE, words, began)
        search = FrameSearch(job=alone, scene=self.scene, fit=fit, generator=self.generator)
        seen = expecting._seen(search)
        least = EXPLAINED_ANYWHERE if anywhere else EXPLAINED
        refused = expecting._refused(seen, least)
        if refused is not None:
            after = replace(before, lost=self.lost + 1)
            return after, after._unused(frame.image.name, *refused, began)
        return expecting._believing(seen, usable, began)

    def skip(self, name: str, why: str) -> tuple["Tracker", Tracked]:
        """Passes a frame over that could not be had: what is believed gets less sure.

        Args:
            name: Of the frame.
            why: One sentence for a person.
        """
        after = self._expecting(self.parameters)
        return after, after._unused(name, TrackStatus.UNUSABLE, why, time.perf_counter())

    def _repeated(self, name: str, began: float) -> tuple["Tracker", Tracked]:
        """The last frame once more contradicts nothing, and must not make anything surer."""
        after = replace(self._expecting(self.parameters), lost=0)
        words = "The image is the same as the last one that was used: it tells nothing new."
        tracked = after._unused(name, TrackStatus.TRACKING, words, began)
        return after, replace(tracked, agreement=self.agreement)

    def _located(self, frame: Frame) -> "Tracker":
        """Begun where a search all over the world puts a frame."""
        if self.job.robot is None and frame.T_world_sensor is None:
            frame = replace(frame, T_world_sensor=self.T_first)
        located = locate(replace(self.job, frames=(frame,)), self.generator)
        job = replace(located.job, initial="nominal")
        parameters = Parameters.of(job, self.scene)
        return replace(
            self,
            job=replace(job, frames=()),
            parameters=parameters,
            state=parameters.nominal,
            covariance=torch.diag(parameters.prior_sigma.square()),
            T_first=self.T_first if frame.T_world_sensor is None else frame.T_world_sensor,
            starts=parameters.with_base(located.Ts_world_base),
        )

    def _expecting(self, parameters: Parameters) -> "Tracker":
        """A frame later: less sure by the drift, and with a new error of the frame's own."""
        own = own_error(parameters)
        kept = (~own).to(self.covariance)
        drifted = self.drift.square() if self.trust else torch.zeros_like(self.drift)
        fresh = torch.where(own, parameters.prior_sigma.square(), drifted)
        state = self.state.clone()
        frames = parameters.mechanism.slots.of_frames
        state[frames] = parameters.nominal[frames]
        return replace(
            self,
            parameters=parameters,
            state=state,
            covariance=self.covariance * kept[:, None] * kept + torch.diag(fresh),
        )

    @property
    def _bump(self) -> Tensor:
        """What may have changed at once, as standard deviations: more the longer one is lost."""
        bump = self.drift.new_tensor([BUMP[unit] for unit in self.parameters.units])
        return (1.0 + self.lost) * bump

    def _wide(self) -> Parameters:
        """What a frame is fitted with: the expected state, and a prior that allows for a bump."""
        sigma = (self.covariance.diagonal() + self._bump.square()).sqrt()
        return replace(self.parameters, nominal=self.state, prior_sigma=sigma)

    def _is_far(self, state: Tensor) -> bool:
        """Whether a state is farther from the expected one than a bump explains."""
        return bool(self._wide().contradicts_prior(state))

    def _seen(self, search: FrameSearch) -> Sighting:
        """What a frame tells where it is explained best."""
        if self.trust is None:
            return search.first(self.starts)
        return search.near(self.state, self.trust, self.agreement)

    def _refused(self, seen: Sighting, least: float) -> tuple[TrackStatus, str] | None:
        """Why a frame is not believed; None if it is."""
        row = f"{self.lost + 1} in a row"
        if seen.mistake is not None:
            return TrackStatus.LOST, seen.mistake
        if seen.told.agreement < least or self._is_far(seen.told.state):
            return TrackStatus.LOST, f"The image is not explained, {row}."
        if seen.rivals:
            words = rivals_words(seen.rivals, "the image")
            return TrackStatus.AMBIGUOUS, f"{words}: none of them is believed, {row}."
        return None

    def _believing(self, seen: Sighting, frame: Frame, began: float) -> tuple["Tracker", Tracked]:
        """The tracker after a frame that was explained."""
        told = seen.told
        joined = self._joined(told, self.covariance)
        state, P = self._moved(told, joined), joined.covariance
        usual = max(told.agreement, self.agreement + FORGOTTEN * (told.agreement - self.agreement))
        alarm, words = joined.p_value < CHANCE, expected_words(told.agreement, usual)
        if alarm:
            anew = self._joined(told, self.covariance + torch.diag(self._bump.square()))
            state, P = self._moved(told, anew), anew.covariance
            words = self._what_moved(state)
        after = replace(
            self,
            state=state,
            covariance=P,
            trust=seen.trust,
            agreement=usual,
            frame=frame,
            lost=0,
        )
        return after, Tracked(
            name=frame.image.name,
            status=TrackStatus.TRACKING,
            alarm=alarm,
            message=words,
            p_value=joined.p_value,
            agreement=told.agreement,
            seconds=time.perf_counter() - began,
            **after._belief(),
        )

    def _joined(self, told: Told, covariance: Tensor) -> Innovation:
        offset = self.parameters.difference(told.state, self.state)
        score = told.gradient + told.information @ offset
        return innovation(covariance, told.information, score, self._wide().prior_sigma)

    def _moved(self, told: Told, joined: Innovation) -> Tensor:
        """The joint state: from where the frame was looked at, which it is near."""
        offset = self.parameters.difference(told.state, self.state)
        return self.parameters.retract(told.state, joined.step - offset)

    def _what_moved(self, state: Tensor) -> str:
        step = self.parameters.difference(state, self.state)
        place = int((step.abs() / self.covariance.diagonal().sqrt()).argmax())
        name, unit = self.parameters.names[place], self.parameters.units[place]
        return (
            "The image contradicts what was believed, most of all about "
            f"{parameter_words(name, self.parameters)}: {float(step[place]):+.3g} {unit}."
        )

    def _belief(self) -> dict[str, Any]:
        """The part of ``Tracked`` that does not need an image."""
        J = self.parameters.pose_jacobians(self.state)[0]
        return {
            "names": self.parameters.names,
            "state": self.state.to(self.dtype),
            "corrections": self.parameters.difference(self.state, self.parameters.nominal).to(
                self.dtype
            ),
            "covariance": self.covariance.to(self.dtype),
            "T_world_sensor": self.parameters.sensor_poses(self.state)[0].to(self.dtype),
            "pose_covariance": gaussian.moved_covariance(self.covariance, J).to(self.dtype),
        }

    def _unused(self, name: str, status: TrackStatus, message: str, began: float) -> Tracked:
        return Tracked(
            name=name,
            status=status,
            alarm=status != TrackStatus.UNUSABLE and self.lost >= PATIENCE,
            message=message,
            p_value=1.0,
            agreement=0.0,
            seconds=time.perf_counter() - began,
            **self._belief(),
        )
