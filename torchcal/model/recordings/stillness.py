"""Which images to take: those during which nothing moved, and one of each posture."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

STILL = 0.002
"""rad, m: encoders of an arm that stands still tremble by less, and 2 mm blur no image."""
HALF_WINDOW = 250_000_000
"""ns before and after an image in which nothing may move: exposure, driver and stamps need less."""
FARTHEST = 500_000_000
"""ns: a sample that is farther from an image says nothing of it."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Motion:
    """What is known of the moving parts at the time of each image."""

    values: NDArray[np.float64]
    """(image channel): joints (rad, m), or the entries of a pose."""
    change: NDArray[np.float64]
    """(image): how much the channels changed about that time, at most; infinite: nobody knows."""
    offset: NDArray[np.float64]
    """(image): s from the image to the sample that is nearest to it."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Series:
    """Samples of one channel: ns, ascending, and rad or m."""

    times: NDArray[np.int64]
    values: NDArray[np.float64]

    def about(self, time: int) -> tuple[float, float, float]:
        """Median and change within the window about a time (ns), and s to the nearest sample."""
        low = max(int(np.searchsorted(self.times, time - HALF_WINDOW, "right")) - 1, 0)
        high = int(np.searchsorted(self.times, time + HALF_WINDOW, "left")) + 1
        window, away = self.values[low:high], self.times[low:high] - time
        offset = int(away[np.abs(away).argmin()])
        change = float(np.ptp(window)) if abs(offset) <= FARTHEST else np.inf
        return float(np.median(window)), change, offset * 1e-9


def motion_of(channels: list[Series], times: NDArray[np.int64]) -> Motion:
    """What samples say of the times of images (ns); with no channels, that nothing can move."""
    if not channels:
        none = np.zeros(len(times))
        return Motion(values=none[:, None][:, :0], change=none, offset=none)
    found = np.array([[each.about(int(time)) for each in channels] for time in times])
    values, change, offset = found.reshape(len(times), len(channels), 3).transpose(2, 0, 1)
    worst = np.abs(offset).argmax(1)
    return Motion(values=values, change=change.max(1), offset=offset[np.arange(len(times)), worst])


def choose(motion: Motion, count: int) -> list[int]:
    """At most ``count`` images, one for each posture: those that differ most from each other.

    Where nothing ever stood still, the tenth of the images during which least moved is looked at.
    """
    still = motion.change <= STILL
    if not still.any():
        changes = np.sort(motion.change[np.isfinite(motion.change)])
        still = motion.change <= changes[: max(count, len(changes) // 10)].max(initial=0.0)
    return spread(motion.values, _one_of_each(motion.values, still), count)


def evenly(images: int, count: int) -> list[int]:
    """At most ``count`` of so many images, from the first to the last at equal steps."""
    return sorted({round(k) for k in np.linspace(0, images - 1, min(images, count))})


def spread(values: NDArray[np.float64], candidates: list[int], count: int) -> list[int]:
    """Candidates that are far from each other: each next one is the farthest from all before."""
    if len(candidates) <= count:
        return candidates
    taken = [0]
    rows = values[candidates]
    away = np.linalg.norm(rows - rows[0], axis=1)
    while len(taken) < count:
        taken.append(int(away.argmax()))
        away = np.minimum(away, np.linalg.norm(rows - rows[taken[-1]], axis=1))
    return sorted(candidates[k] for k in taken)


def _one_of_each(values: NDArray[np.float64], still: NDArray[np.bool_]) -> list[int]:
    """The middle image of each time during which nothing moved."""
    groups: list[list[int]] = []
    for k in np.flatnonzero(still).tolist():
        near = groups and np.abs(values[k] - values[groups[-1][0]]).max(initial=0.0) <= 2.0 * STILL
        if near and groups[-1][-1] == k - 1:
            groups[-1].append(k)
        else:
            groups.append([k])
    return [group[len(group) // 2] for group in groups]
