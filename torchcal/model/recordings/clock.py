"""Which clock tells when messages of several topics were made at the same time."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from torchcal.model.recordings.bag import Stamps

_DIFFERENT = 0.5
"""s: no driver is later with its messages by so much than another; two clocks differ."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Clock:
    """Whether the senders' stamps can be compared with each other."""

    by_stamp: bool
    """False: the recorder's clock has to do."""
    note: str = ""

    def times(self, stamps: Stamps) -> NDArray[np.int64]:
        """When the messages were made (ns)."""
        return stamps.made if self.by_stamp else stamps.received

    def time(self, made: int, received: int) -> int:
        """When a message was made (ns)."""
        return made if self.by_stamp else received


def common_clock(topics: dict[str, Stamps]) -> Clock:
    """The senders' stamps if they all ran by one clock, else the times of the recorder."""
    for topic, stamps in topics.items():
        if (stamps.made <= 0).any():
            note = f"{topic} has messages without a stamp: times are those of the recorder"
            return Clock(by_stamp=False, note=note)
    late = {topic: _lateness(stamps) for topic, stamps in topics.items()}
    first, last = min(late, key=late.__getitem__), max(late, key=late.__getitem__)
    apart = late[last] - late[first]
    if apart <= _DIFFERENT:
        return Clock(by_stamp=True)
    note = (
        f"the clocks of {first} and {last} differ by {apart:.3g} s: times are those of the "
        "recorder, and pairs of images and joints may be a little late"
    )
    return Clock(by_stamp=False, note=note)


def _lateness(stamps: Stamps) -> float:
    """How long after its stamp a message was received (s, median)."""
    return float(np.median(stamps.received - stamps.made)) * 1e-9
