"""Every task ends exactly once, whatever becomes of it on the way."""

import random
from pathlib import Path

import fleet_work
import pytest
from hypothesis import given
from hypothesis import strategies as st

from torchcal.fleet.schedule import Here, run_all
from torchcal.fleet.task import End, Ended, Task

FOLDER = Path("jobs")


def tasks(*names: str) -> list[Task]:
    return [fleet_work.task(name, FOLDER) for name in names]


def ends(*names: str, attempts: int = 3) -> dict[str, Ended]:
    """How tasks end in this process, by name."""
    found = list(run_all(tasks(*names), Here(fleet_work.work), attempts=attempts))
    assert len(found) == len(names)
    return {each.task.name: each for each in found}


def test_a_task_that_fails_is_tried_as_often_as_was_said_and_then_reported():
    found = ends("fine", "broken", "also-fine", attempts=4)
    assert found["broken"].end is End.ERROR
    assert found["broken"].task.attempt == 4
    assert found["broken"].message == "RuntimeError: out of luck"


def test_a_task_that_fails_does_not_keep_others_from_being_done():
    found = ends("broken", "fine", "also-fine")
    assert [found[name].end for name in ("fine", "also-fine")] == [End.DONE, End.DONE]


def test_a_mistake_of_the_caller_is_reported_at_once():
    found = ends("wrong")["wrong"]
    assert found.end is End.UNREADABLE
    assert found.task.attempt == 1
    assert "glass eye" in found.message


def test_nothing_to_do_is_done_at_once():
    assert list(run_all([], Here(fleet_work.work), attempts=3)) == []


class Chance:
    """A place where attempts end in any order and any way."""

    def __init__(self, capacity: int, seed: int):
        self.capacity = capacity
        self.most = 0
        self._random = random.Random(seed)
        self._begun: list[Task] = []

    def begin(self, task: Task) -> None:
        self._begun.append(task)
        self.most = max(self.most, len(self._begun))

    def next_ended(self) -> Ended:
        task = self._begun.pop(self._random.randrange(len(self._begun)))
        return Ended(task=task, end=self._random.choice(list(End)))

    def close(self) -> None:
        self._begun.clear()


@given(count=st.integers(0, 12), capacity=st.integers(1, 4), attempts=st.integers(1, 3))
def test_every_task_is_accounted_for_once_whatever_happens(count, capacity, attempts):
    place = Chance(capacity, seed=count)
    given_tasks = tasks(*(f"task-{k}" for k in range(count)))
    found = list(run_all(given_tasks, place, attempts=attempts))
    assert sorted(each.task.name for each in found) == sorted(each.name for each in given_tasks)
    assert all(each.task.attempt <= attempts for each in found)
    given_up = [each for each in found if each.end in (End.ERROR, End.KILLED)]
    assert all(each.task.attempt == attempts for each in given_up)
    assert place.most <= capacity


@pytest.mark.parametrize("attempts", [1, 2])
def test_attempts_count_from_one(attempts):
    assert ends("broken", attempts=attempts)["broken"].task.attempt == attempts
