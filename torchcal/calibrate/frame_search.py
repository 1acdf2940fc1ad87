"""Where a frame may be: near what is expected, or where a search leads, and what speaks against it.

A search may find that several states explain the frame, or that none does so well as if the image
were read in another way.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from torchcal.calibrate.fits import Choice, choose_found, choose_start
from torchcal.calibrate.frame_fit import FrameFit, Told, Trust
from torchcal.calibrate.readings import EXPLAINED, misreadings
from torchcal.model.job import Job
from torchcal.model.scene import Scene

SUDDEN = 0.9
"""With less than this share of the usual agreement, other states are tried, too."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Sighting:
    """What a frame tells at the state that explains it best."""

    told: Told
    trust: Trust
    """How far to believe it."""
    rivals: int = 0
    """Other states that explain the frame as well."""
    mistake: str | None = None
    """A sentence: how the image was probably meant instead."""


@dataclass(frozen=True, kw_only=True, slots=True)
class FrameSearch:
    """A frame, and all that is needed to look for it."""

    job: Job
    """Of this frame alone."""
    scene: Scene
    fit: FrameFit
    """Its prior is where a search goes."""
    generator: torch.Generator
    """Draws the starts; on the CPU."""

    def first(self, starts: Float[Tensor, "start slot 4 4"] | None) -> Sighting:
        """Before anything is known of the noise, or of where the sensor usually is.

        Args:
            starts: Where to look; None: all over the prior.
        """
        choice = self._sought() if starts is None else self._found(starts)
        state = self.fit.told(choice.state, 1.0).state
        trust = self.fit.trust(state)
        told = self.fit.trusting(trust).told(state, trust.share)
        return Sighting(
            told=told, trust=trust, rivals=len(choice.rivals), mistake=self._mistake(told)
        )

    def near(self, expected: Float[Tensor, "slot 4 4"], trust: Trust, usual: float) -> Sighting:
        """Near the expected state, or where a search leads if far less agrees there than usual.

        Args:
            expected: The state.
            trust: What is known of the noise.
            usual: Agreement of the frames before.
        """
        told = self.fit.told(self.fit.near(expected), trust.share)
        if told.agreement >= SUDDEN * usual:
            return Sighting(told=told, trust=trust)
        choice = self._sought()
        found = self.fit.told(choice.state, trust.share)
        if found.agreement <= told.agreement:
            return Sighting(told=told, trust=trust)
        return Sighting(told=found, trust=trust, rivals=len(choice.rivals))

    def _sought(self) -> Choice:
        return choose_start(self.job, self.scene, self.fit.fit.parameters, self.generator)

    def _found(self, starts: Tensor) -> Choice:
        return choose_found(self.job, self.scene, self.fit.fit.parameters, starts)

    def _mistake(self, told: Told) -> str | None:
        """What a person may have got wrong, if the model explains little of the frame."""
        if told.agreement >= EXPLAINED:
            return None
        parameters = self.fit.fit.parameters
        return next(iter(misreadings(self.job, self.scene, parameters, told.state)), None)
