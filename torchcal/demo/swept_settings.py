"""What a benchmark sweeps: one thing at a time gets worse, from a standard that is easy."""

from dataclasses import dataclass, replace


@dataclass(frozen=True, kw_only=True, slots=True)
class Setting:
    """What a job is like; the defaults are those of all factors that are not swept."""

    sigma: float = 0.01
    """m: the noise of every pixel, independent of its neighbours'."""
    beam: int = 3
    """Side of the box of eq. 18 (pixels)."""
    start: tuple[float, float] | None = (0.05, 3.0)
    """How far off the nominal pose is (m, degrees); also the prior. None: it is not told."""
    missing: int = 0
    """Boxes of the model that are not there."""
    extra: int = 0
    """Boxes that are there and not in the model."""
    folds: int = 1
    """Turns about the middle of the room after which it looks the same."""
    planes: int | None = None
    """Nothing but so many planes; None: a whole room."""
    outliers: float = 0.0
    """Share of the pixels that hold any range."""
    dropouts: float = 0.0
    """Share of the image in patches that hold none."""
    joints_deg: float = 0.0
    """Offsets of an arm's joints (one sigma), which then carries the sensor through a cell."""


STANDARD = Setting()

FACTORS: dict[str, dict[str, Setting]] = {
    "noise": {f"{1e3 * s:g} mm": replace(STANDARD, sigma=s) for s in (0.002, 0.01, 0.05)},
    "beam": {f"{b} pixels": replace(STANDARD, beam=b) for b in (1, 7, 15)},
    "start": {
        f"{1e3 * m:g} mm, {d:g} degrees": replace(STANDARD, start=(m, d))
        for m, d in ((0.02, 1.0), (0.1, 5.0), (0.3, 15.0))
    },
    "missing objects": {f"{n} of 8": replace(STANDARD, missing=n) for n in (1, 2, 4)},
    "extra objects": {f"{n}": replace(STANDARD, extra=n) for n in (1, 2, 4)},
    "symmetric room, no start": {
        f"{n}-fold": replace(STANDARD, folds=n, start=None) for n in (1, 2, 4)
    },
    "planes": {f"{n}": replace(STANDARD, planes=n) for n in (1, 2, 3)},
    "outliers": {f"{s:.0%}": replace(STANDARD, outliers=s) for s in (0.05, 0.2, 0.4)},
    "dropouts": {f"{s:.0%}": replace(STANDARD, dropouts=s) for s in (0.2, 0.5, 0.8)},
    "joint offsets": {f"{d:g} degrees": replace(STANDARD, joints_deg=d) for d in (0.5, 1.0, 2.0)},
}
"""What is swept, by level."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Tier:
    """How large a benchmark is."""

    side: int
    """Pixels of the images."""
    seeds: int
    """Jobs for each level of each factor."""


TIERS = {
    "tiny": Tier(side=32, seeds=1),
    "small": Tier(side=96, seeds=5),
    "full": Tier(side=256, seeds=20),
}
