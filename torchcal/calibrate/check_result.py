"""What can be said of a job without estimating anything, as frozen data."""

from dataclasses import dataclass

from torchcal.calibrate.result import NextView, UnobservableDirection


@dataclass(frozen=True, kw_only=True, slots=True)
class FrameCheck:
    """What one frame holds at the nominal pose, before anything is estimated."""

    name: str
    measured_fraction: float
    """The share of all pixels that were measured."""
    usable_fraction: float
    """The share of all pixels that were measured and may be used."""
    model_fraction: float
    """The share of usable pixels in which the model is seen."""
    median_range_m: float
    """Of the usable measurement; NaN where there is none."""
    predicted_median_range_m: float
    """Of the model; NaN where it is not seen."""
    warnings: tuple[str, ...]


@dataclass(frozen=True, kw_only=True, slots=True)
class ParameterCheck:
    """How well the images can tell one parameter, at the nominal pose."""

    name: str
    unit: str
    """``m``, ``rad`` or ``1``"""
    prior_sigma: float
    expected_sigma: float
    """What a calibration may be expected to leave of it."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Foresight:
    """What a job will tell before any image is taken."""

    parameters: tuple[ParameterCheck, ...]
    unobservable: tuple[UnobservableDirection, ...]
    next_view: NextView | None


@dataclass(frozen=True, kw_only=True, slots=True)
class JobCheck:
    """What can be said of a job without estimating anything."""

    frames: tuple[FrameCheck, ...]
    parameters: tuple[ParameterCheck, ...]
    unobservable: tuple[UnobservableDirection, ...]
    warnings: tuple[str, ...]
