"""Where the sensor of a bag is mounted, and how it moved: what ``tf`` says beyond the URDF."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from torchcal.errors import JobError, choices
from torchcal.model.job import WORLD_LINK
from torchcal.model.recordings.bag import Bag, header_stamp
from torchcal.model.recordings.clock import Clock
from torchcal.model.recordings.recorded import Carrier, RobotSource
from torchcal.model.recordings.robot_files import urdf_links
from torchcal.model.recordings.stillness import FARTHEST, HALF_WINDOW, Motion
from torchcal.model.recordings.transforms import Transforms, transforms_of

_STATIC = "tf_static"


@dataclass(frozen=True, kw_only=True, slots=True)
class Mount:
    """Which link of a robot carries a frame."""

    link: str
    T_link_frame: Float[Tensor, "4 4"] | None
    """None: the bag does not say."""
    T_world_base: Float[Tensor, "4 4"] | None
    """None: the bag does not say."""

    def carrier(self, robot: RobotSource, T_frame_sensor: Float[Tensor, "4 4"]) -> Carrier:
        """The same for a sensor that stands in the frame."""
        eye = torch.eye(4, dtype=torch.float64)
        T_link_frame = eye if self.T_link_frame is None else self.T_link_frame
        return Carrier(
            robot=robot,
            link=self.link,
            T_link_sensor=T_link_frame @ T_frame_sensor,
            T_world_base=self.T_world_base,
        )


def find_mount(bag: Bag, clock: Clock, robot: RobotSource, frame: str, link: str | None) -> Mount:
    """The link that carries a frame, through transforms that never changed.

    Args:
        bag: An open bag.
        clock: Tells when transforms were made.
        robot: Its links may carry the frame, and so may the world.
        frame: The one that the images name.
        link: The one that a person names; None: the first on the way up from the frame.

    Raises:
        JobError: If the frame hangs on no link and nobody names one, or ``link`` is none.
    """
    links = urdf_links(robot)
    if link is not None and link not in (*links, WORLD_LINK):
        raise JobError(bag.file, "--link", link, choices([*links, WORLD_LINK]))
    wanted = (*links, WORLD_LINK) if link is None else (link,)
    tree = transforms(bag, clock, static=True)
    found = tree.carried_by(frame, wanted)
    if found is None:
        # Old drivers send what never changes on tf, again and again.
        tree = transforms(bag, clock, static=False)
        found = tree.carried_by(frame, wanted)
    if found is None and link is None:
        said = f"the frame {frame!r}, which no link of the URDF carries by tf_static"
        raise JobError(bag.file, "", said, f"--link: {choices([*links, WORLD_LINK])}")
    base = tree.carried_by(links[0], (WORLD_LINK,)) if links[0] != WORLD_LINK else None
    return Mount(
        link=found[0] if found else str(link),
        T_link_frame=found[1] if found else None,
        T_world_base=base[1] if base else None,
    )


def transforms(bag: Bag, clock: Clock, *, static: bool) -> Transforms:
    """The frames of a bag; only those of ``tf_static``, or all.

    Raises:
        JobError: If a frame has no transform that is a rigid motion.
    """
    topics = bag.of_type("TFMessage", "tfMessage")
    topics = [topic for topic in topics if not static or topic.endswith(_STATIC)]
    messages = (each for topic in topics for each in bag.messages(topic))
    try:
        return transforms_of(
            messages, lambda received, header: clock.time(header_stamp(header), received)
        )
    except ValueError as error:
        found, _, expected = str(error).partition("; expected ")
        raise JobError(bag.file, ", ".join(topics), found, expected) from error


def poses_of(
    tree: Transforms, frame: str, times: NDArray[np.int64]
) -> tuple[Float[Tensor, "time 4 4"], Motion]:
    """T_root_frame at some times (ns), and how it moved about each."""
    Ts = torch.stack([tree.pose(frame, int(time)) for time in times])
    about = [
        torch.stack([tree.pose(frame, int(time) + step) for time in times])
        for step in (-HALF_WINDOW, HALF_WINDOW)
    ]
    change = torch.stack([(each - Ts).abs().amax((1, 2)) for each in about]).amax(0).numpy()
    offset = np.array([tree.offset(frame, int(time)) for time in times])
    motion = Motion(
        values=Ts[:, :3].flatten(1).numpy(),
        change=np.where(np.abs(offset) <= FARTHEST, change, np.inf),
        offset=offset * 1e-9,
    )
    return Ts, motion
