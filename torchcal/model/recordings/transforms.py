"""The frames of ``tf`` and ``tf_static``: which hangs on which, and what moved."""

import math
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from torchcal.geometry import se3

_SAME = 1e-9
"""m, and of matrix entries: a transform of ``tf`` that is sent again and again without a change."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Edge:
    """How one frame stood in its parent, at each of some times."""

    parent: str
    times: NDArray[np.int64]
    """ns, ascending."""
    Ts_parent_child: Float[Tensor, "sample 4 4"]

    @property
    def fixed(self) -> bool:
        """Whether it never changed."""
        Ts = self.Ts_parent_child
        return bool((Ts - Ts[0]).abs().max() < _SAME)

    def at(self, time: int) -> Float[Tensor, "4 4"]:
        """As it stood at the sample nearest to a time (ns)."""
        return self.Ts_parent_child[int(np.abs(self.times - time).argmin())]


@dataclass(frozen=True, kw_only=True, slots=True)
class Transforms:
    """A tree of frames."""

    edges: Mapping[str, Edge]
    """Of each frame that has a parent."""

    def carried_by(
        self, frame: str, links: Collection[str]
    ) -> tuple[str, Float[Tensor, "4 4"]] | None:
        """The first of some frames on the way up from a frame, through what never moved.

        Returns:
            Its name and T_link_frame; None if there is no such way.
        """
        T = torch.eye(4, dtype=torch.float64)
        for name, edge in self._way_up(frame):
            if name in links:
                return name, T
            if edge is None or not edge.fixed:
                return None
            T = edge.Ts_parent_child[0] @ T
        return None

    def root(self, frame: str) -> str:
        """The frame on which everything hangs that a frame hangs on."""
        return [name for name, _ in self._way_up(frame)][-1]

    def pose(self, frame: str, time: int) -> Float[Tensor, "4 4"]:
        """T_root_frame at a time (ns)."""
        T = torch.eye(4, dtype=torch.float64)
        for _, edge in self._way_up(frame):
            T = T if edge is None else edge.at(time) @ T
        return T

    def offset(self, frame: str, time: int) -> int:
        """From a time to the samples of what moved (ns), where these are farthest from it."""
        moving = [edge for _, edge in self._way_up(frame) if edge and not edge.fixed]
        offsets = [int(edge.times[np.abs(edge.times - time).argmin()]) - time for edge in moving]
        return max(offsets, key=abs, default=0)

    def _way_up(self, frame: str) -> Iterator[tuple[str, Edge | None]]:
        passed: set[str] = set()
        name: str | None = frame
        while name is not None and name not in passed:
            passed.add(name)
            edge = self.edges.get(name)
            yield name, edge
            name = edge.parent if edge else None


def frame_name(name: str) -> str:
    """A frame without the slash that old ROS 1 puts before it."""
    return name.lstrip("/")


def transforms_of(
    messages: Iterable[tuple[int, Any]], stamp: Callable[[int, Any], int]
) -> Transforms:
    """The tree of all ``TFMessage`` of a bag.

    Args:
        messages: Each with when it was received (ns).
        stamp: The time (ns) of a transform, from when it was received and its header.

    Raises:
        ValueError: If no transform of a frame is a rigid motion; single ones are left out, as tf2
            leaves them out.
    """
    samples: dict[tuple[str, str], list[tuple[int, list[float]]]] = {}
    for received, message in messages:
        for each in message.transforms:
            key = frame_name(each.child_frame_id), frame_name(each.header.frame_id)
            shift, turn = each.transform.translation, each.transform.rotation
            numbers = [shift.x, shift.y, shift.z, turn.w, turn.x, turn.y, turn.z]
            samples.setdefault(key, []).append((stamp(received, each.header), numbers))
    edges = {child: _edge(parent, each) for (child, parent), each in samples.items()}
    return Transforms(edges=edges)


def _is_rigid(numbers: list[float]) -> bool:
    """Whether x, y, z and a quaternion are finite, and the quaternion is not 0."""
    return all(map(math.isfinite, numbers)) and any(numbers[3:])


def _edge(parent: str, samples: list[tuple[int, list[float]]]) -> Edge:
    ordered = sorted((s for s in samples if _is_rigid(s[1])), key=lambda sample: sample[0])
    if not ordered:
        raise ValueError(f"a transform from {parent} with {samples[0][1]}; expected a rigid motion")
    numbers = torch.tensor([numbers for _, numbers in ordered], dtype=torch.float64)
    return Edge(
        parent=parent,
        times=np.array([time for time, _ in ordered], np.int64),
        Ts_parent_child=se3.from_quaternion(numbers[:, :3], numbers[:, 3:]),
    )
