"""``JointState`` messages as a series of samples for each joint."""

from collections.abc import Iterable, Sequence

import numpy as np

from torchcal.model.recordings.bag import Bag, header_stamp
from torchcal.model.recordings.clock import Clock
from torchcal.model.recordings.stillness import Series


def joint_series(
    bag: Bag, topics: Iterable[str], clock: Clock, wanted: Sequence[str]
) -> dict[str, Series]:
    """The samples of some joints, whichever messages they came in.

    Args:
        bag: An open bag.
        topics: Of ``JointState`` messages; each may name other joints.
        clock: Tells when they were made.
        wanted: The names of joints.

    Returns:
        The joints that have any samples, in the order of ``wanted``.
    """
    samples: dict[str, list[tuple[int, float]]] = {name: [] for name in wanted}
    for topic in topics:
        for received, message in bag.messages(topic):
            time = clock.time(header_stamp(message.header), received)
            for name, value in zip(message.name, message.position, strict=False):
                if name in samples:
                    samples[name].append((time, float(value)))
    return {name: _series(each) for name, each in samples.items() if each}


def _series(samples: list[tuple[int, float]]) -> Series:
    times, values = zip(*sorted(samples), strict=True)
    return Series(times=np.array(times, np.int64), values=np.array(values, np.float64))
