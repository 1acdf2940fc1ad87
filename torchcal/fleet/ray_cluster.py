"""A Ray cluster: one processor a task, and one GPU where the cluster has any."""

import logging
import os
import socket
from importlib import import_module
from typing import Any

from torchcal.errors import TorchcalError
from torchcal.fleet.processes import ONE_THREAD
from torchcal.fleet.task import End, Ended, Task, Work, attempt

LOCAL = "local"
"""The address that starts a cluster on this machine."""
REACHED_WITHIN = 10.0
"""s"""
AHEAD = 2
"""Tasks given to the cluster for each that it can run: no worker waits for this process."""


class RayCluster:
    """An existing cluster, or one on this machine that ends with this object.

    Args:
        work: Must be importable on every machine of the cluster.
        address: As ``ray.init`` takes it; ``local`` starts a cluster here.
        workers: Most tasks at once; None: as many as the cluster has room for.
        gpus: Whether tasks get a GPU each where there are any.

    Raises:
        TorchcalError: If Ray is not installed or the cluster cannot be reached.
    """

    def __init__(self, work: Work, address: str, *, workers: int | None, gpus: bool):
        self._ray = _connected(address, workers)
        self._workers = workers
        self._gpus = gpus and self._ray.cluster_resources().get("GPU", 0.0) > 0.0
        self._running: dict[Any, Task] = {}
        self._work = work
        # Ray would try again by itself, uncounted, and end a worker after each task with a GPU.
        options = {"num_cpus": 1, "num_gpus": int(self._gpus), "max_retries": 0, "max_calls": 0}
        self._attempt = self._ray.remote(**options)(attempt)

    @property
    def capacity(self) -> int:
        """What was asked for, or all that the cluster has now and as much again."""
        if self._workers is not None:
            return self._workers
        room = self._ray.cluster_resources().get("GPU" if self._gpus else "CPU", 0.0)
        return max(1, AHEAD * int(room))

    def begin(self, task: Task) -> None:
        """Gives the task to the cluster."""
        self._running[self._attempt.remote(self._work, task)] = task

    def next_ended(self) -> Ended:
        """Waits for the first task that ends; a worker or machine that is lost ends its tasks."""
        [reference], _ = self._ray.wait(list(self._running), num_returns=1)
        task = self._running.pop(reference)
        errors = self._ray.exceptions
        try:
            return self._ray.get(reference)
        except errors.RayTaskError as error:
            return Ended(task=task, end=End.ERROR, message=_first_line(error.cause or error))
        except errors.RayError as error:
            words = f"the worker was lost ({type(error).__name__}): {_first_line(error)}"
            return Ended(task=task, end=End.KILLED, message=words)

    def close(self) -> None:
        """Leaves the cluster, which ends what this process still has running there."""
        self._running.clear()
        self._ray.shutdown()


def _connected(address: str, workers: int | None) -> Any:
    """Ray, connected to a cluster."""
    try:
        ray = import_module("ray")
    except ImportError as error:
        words = "found no Ray; expected it to be installed: pip install 'torchcal[fleet]'"
        raise TorchcalError(f"--ray {address}: {words}") from error
    _check_reachable(address)
    options: dict[str, Any] = {"address": address, "runtime_env": {"env_vars": ONE_THREAD}}
    if address == LOCAL:
        os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
        options |= {"num_cpus": workers, "include_dashboard": False}
    try:
        ray.init(**options, log_to_driver=False, logging_level=logging.ERROR)
    except (ray.exceptions.RayError, OSError, RuntimeError, ValueError) as error:
        raise _unreachable(address, error) from error
    return ray


def _check_reachable(address: str) -> None:
    """Raises if nobody listens at a host and port: Ray would try for many minutes."""
    host, _, port = address.rpartition("://")[2].rpartition(":")
    if not host or not port.isdecimal():
        return
    try:
        socket.create_connection((host.strip("[]"), int(port)), timeout=REACHED_WITHIN).close()
    except (OSError, OverflowError) as error:
        raise _unreachable(address, error) from error


def _unreachable(address: str, error: Exception) -> TorchcalError:
    return TorchcalError(
        f"--ray {address}: found {_first_line(error)}; expected the address of a cluster, auto or "
        f"{LOCAL}"
    )


def _first_line(error: BaseException) -> str:
    return (str(error).strip() or type(error).__name__).splitlines()[0]
