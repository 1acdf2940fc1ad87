"""How much each unknown may change from one frame to the next: a random walk."""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Float
from torch import Tensor

from torchcal.calibrate.parameters import AXES, Parameters
from torchcal.errors import TorchcalError, choices
from torchcal.model.job import Job, PosePrior

UNSURE = (0.1, 0.1)
"""m, rad: how unsure of a base one usually is, for jobs whose base may be anywhere."""
SHARE = 0.01
"""Of the prior's sigma: what an unknown changes in a frame if nobody says otherwise."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Wander:
    """Standard deviations of the changes between two frames."""

    share: float = SHARE
    """Of each unknown's sigma in the job, for all that ``blocks`` does not name."""
    blocks: Mapping[str, float | PosePrior] = field(default_factory=dict)
    """``base``, ``mount``, ``objects.NAME``: a ``PosePrior``; ``joints.NAME`` (rad or m),
    ``range.offset`` (m), ``range.scale``: a number."""

    def sigmas(self, parameters: Parameters) -> Float[Tensor, " parameter"]:
        """One for each parameter; 0 for the errors of single frames, which do not last.

        Raises:
            TorchcalError: If a number is negative or not finite, a block is not unknown or its
                entry is of the wrong kind.
        """
        share = _check(self.share, "share")
        known = {_block(name): name for name in parameters.names if not _is_own(name)}
        named: dict[str, float] = {}
        for block, entry in self.blocks.items():
            if block not in known:
                raise TorchcalError(f"drift: found {block!r}; expected {choices(known)}")
            named |= dict(_entries(block, entry, is_pose=known[block] != block))
        return parameters.prior_sigma.new_tensor(
            [
                0.0 if _is_own(name) else named.get(name, share * prior)
                for name, prior in zip(
                    parameters.names, parameters.prior_sigma.tolist(), strict=True
                )
            ]
        )


def usually_unsure(job: Job, parameters: Parameters) -> Parameters:
    """The parameters with sigmas that drifts are shares of: an unlimited search has none."""
    if job.initial != "anywhere":
        return parameters
    sigma = parameters.prior_sigma.clone()
    first = tuple(f"base.{axis}" for axis in AXES)
    assert parameters.names[:6] == first, "all of the base is unknown"
    usual = [value for value in UNSURE for _ in range(3)]
    sigma[:6] = sigma.new_tensor(usual) if job.base is None else job.base.sigma.to(sigma)
    return replace(parameters, prior_sigma=sigma)


def own_error(parameters: Parameters) -> Tensor:
    """Which parameters are the error of a single frame."""
    own = [_is_own(name) for name in parameters.names]
    return torch.tensor(own, device=parameters.prior_sigma.device)


def _is_own(name: str) -> bool:
    return name.startswith("frames.")


def _block(name: str) -> str:
    if name.startswith("joints."):  # whose own names may end like those of axes
        return name
    owner, _, axis = name.rpartition(".")
    return owner if axis in AXES else name


def _entries(block: str, entry: float | PosePrior, *, is_pose: bool) -> Iterator[tuple[str, float]]:
    """Names and sigmas of one block."""
    if is_pose != isinstance(entry, PosePrior):
        expected = "a PosePrior" if is_pose else "a number"
        raise TorchcalError(f"drift: found {entry!r} for {block}; expected {expected}")
    if not isinstance(entry, PosePrior):
        yield block, _check(entry, block)
        return
    for axis, sigma in zip(AXES, entry.sigma.tolist(), strict=True):
        yield f"{block}.{axis}", _check(sigma, block)


def _check(sigma: object, what: str) -> float:
    try:
        number = float(sigma)  # pyright: ignore[reportArgumentType]
    except (TypeError, ValueError) as error:
        raise TorchcalError(f"drift: found {sigma!r} for {what}; expected a number") from error
    if not math.isfinite(number) or number < 0.0:
        raise TorchcalError(f"drift: found {number} for {what}; expected 0 or more")
    return number
