"""Hands tasks to a place where they run, and tries again what failed there."""

from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Protocol, runtime_checkable

from torchcal.fleet.task import End, Ended, Task, Work, attempt

AGAIN = (End.ERROR, End.KILLED)
"""Ends after which another attempt may do better."""


@runtime_checkable
class Place(Protocol):
    """Where tasks run: this process, other processes, a cluster."""

    @property
    def capacity(self) -> int:
        """How many tasks it is given at once; at least 1."""
        ...

    def begin(self, task: Task) -> None:
        """Takes a task; it runs now or as soon as there is room."""
        ...

    def next_ended(self) -> Ended:
        """Waits until one of the tasks that were begun has ended, however it did."""
        ...

    def close(self) -> None:
        """Ends what still runs and gives everything back."""
        ...


class Here:
    """This process, one task after the other."""

    capacity = 1

    def __init__(self, work: Work):
        self._work = work
        self._begun: deque[Task] = deque()

    def begin(self, task: Task) -> None:
        """Keeps the task until somebody waits for it."""
        self._begun.append(task)

    def next_ended(self) -> Ended:
        """Does the task."""
        return attempt(self._work, self._begun.popleft())

    def close(self) -> None:
        """Forgets what was not done."""
        self._begun.clear()


def run_all(tasks: Sequence[Task], place: Place, *, attempts: int) -> Iterator[Ended]:
    """Does every task; yields the last attempt at each exactly once, in the order of their ends.

    Args:
        tasks: With different names.
        place: Where they run.
        attempts: How often a task is tried whose attempts end with an error or a killed worker.
    """
    waiting = deque(tasks)
    running = 0
    while waiting or running:
        while waiting and running < place.capacity:
            place.begin(waiting.popleft())
            running += 1
        ended = place.next_ended()
        running -= 1
        if ended.end in AGAIN and ended.task.attempt < attempts:
            waiting.append(replace(ended.task, attempt=ended.task.attempt + 1))
        else:
            yield ended
