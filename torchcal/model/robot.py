"""A robot: its kinematics and the meshes of its links, from a URDF.

The kinematics are those of pytorch-kinematics. Its own URDF parser is not used: it keeps origins
and axes in single precision only and knows neither mimic joints nor a robot of one link.
"""

import copy
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import pytorch_kinematics as pk
import torch
import trimesh
from jaxtyping import Bool, Float
from pytorch_kinematics.transforms import Transform3d
from torch import Tensor

from torchcal.errors import JobError, TorchcalError, choices
from torchcal.geometry import se3
from torchcal.model.link_meshes import link_mesh, origin_matrix
from torchcal.model.urdf_reader import read_urdf
from torchcal.model.urdf_tree import Joint, Urdf

_PK_KINDS = {"revolute": "revolute", "continuous": "revolute", "prismatic": "prismatic"}


@dataclass(frozen=True, kw_only=True, slots=True)
class Kinematics:
    """The tree of a URDF for pytorch-kinematics, and how its joints follow the free ones."""

    chains: dict[torch.device, pk.Chain]
    """The same chain on every device that was asked for; always in double precision."""
    link_frames: tuple[int, ...]
    """The chain's frame of each link of ``Robot.link_names``."""
    follow: Float[Tensor, "chain_joint joint"]
    """The chain's joint values are ``follow @ joints + offset``: this resolves mimic joints."""
    offset: Float[Tensor, " chain_joint"]
    child: tuple[int, ...]
    """The link below each joint of the chain, in ``Robot.link_names``."""
    screws: Float[Tensor, "chain_joint 6"]
    """The twist of each joint, per rad or m, in the frame of the link below it."""
    moves: Bool[Tensor, "link chain_joint"]
    """Whether a link hangs below a joint."""

    def chain(self, device: torch.device) -> pk.Chain:
        """The chain on a device; copied there when first asked for."""
        if device not in self.chains:
            source = self.chains[torch.device("cpu")]
            self.chains[device] = copy.deepcopy(source).to(device=device)
        return self.chains[device]


@dataclass(frozen=True, kw_only=True, slots=True)
class JointMotion:
    """What an offset does to one joint."""

    value: float
    """rad or m"""
    T: Float[Tensor, "4 4"]
    """On the right of the joint's origin."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Robot:
    """What a URDF says of a robot. Its base is its root link."""

    file: Path
    name: str
    joint_names: tuple[str, ...]
    """Moving joints that follow no other, in the order of the URDF."""
    joint_kinds: tuple[str, ...]
    """``revolute``, ``continuous`` or ``prismatic``, for each of ``joint_names``."""
    joint_limits: Float[Tensor, "joint 2"]
    """Lower and upper (rad; m for prismatic joints); infinite where there are none."""
    mimics: dict[str, str]
    """The joints that follow, each with the one of ``joint_names`` that it follows in the end."""
    link_names: tuple[str, ...]
    """The root first, then in the order of the URDF."""
    link_meshes: dict[str, trimesh.Trimesh]
    """What each link looks like, in its own frame (m), with face colours; without bare links."""
    kinematics: Kinematics

    def forward_kinematics(
        self, joints: Float[Tensor, "*batch joint"]
    ) -> Float[Tensor, "*batch link 4 4"]:
        """T_base_link of every link, in the order of ``link_names``.

        Gradients flow back to the joints through ``backward``; ``torch.func`` does not work on it.

        Args:
            joints: Values (rad, m) in the order of ``joint_names``; limits are not applied.

        Raises:
            ValueError: If there is not one value for every joint.
        """
        if joints.shape[-1] != len(self.joint_names):
            raise ValueError(
                f"forward kinematics: found {joints.shape[-1]} joint values; expected "
                f"{len(self.joint_names)}: {', '.join(self.joint_names)}"
            )
        kinematics = self.kinematics
        follow = kinematics.follow.to(joints.device)
        offset = kinematics.offset.to(joints.device)
        values = joints.double() @ follow.mT + offset
        batch = values.shape[:-1]
        rows = values.reshape(batch.numel(), values.shape[-1])
        frames = kinematics.chain(joints.device).forward_kinematics_tensor(rows)
        poses = frames[list(kinematics.link_frames)].movedim(0, 1).to(joints.dtype)
        return poses.reshape(*batch, len(self.link_names), 4, 4)

    def jacobians(
        self, Ts_base_link: Float[Tensor, "*batch link 4 4"]
    ) -> Float[Tensor, "*batch link 6 joint"]:
        """How every link moves with the joints: the twist on its left, in the base, per rad or m.

        Args:
            Ts_base_link: What ``forward_kinematics`` says of the joints.
        """
        kinematics = self.kinematics
        child = Ts_base_link[..., list(kinematics.child), :, :]
        screws = se3.adjoint(child) @ kinematics.screws.to(child)[..., None]
        moves, follow = kinematics.moves.to(child), kinematics.follow.to(child)
        return torch.einsum("...ci,lc,cj->...lij", screws[..., 0], moves, follow)

    def joint_motions(self, offsets: Mapping[str, float]) -> dict[str, JointMotion]:
        """What offsets of joints (rad, m) do to these and to those that follow them.

        Args:
            offsets: By names of ``joint_names``.

        Returns:
            The motion of every joint that moves, by the name of the link below it.

        Raises:
            TorchcalError: If there is no such joint.
        """
        for name in offsets:
            if name not in self.joint_names:
                expected = choices(self.joint_names)
                raise TorchcalError(f"{self.file}: found joint {name!r}; expected {expected}")
        kinematics = self.kinematics
        free = [offsets.get(name, 0.0) for name in self.joint_names]
        values = kinematics.follow @ torch.tensor(free, dtype=torch.float64)
        motions = se3.exp(values[:, None] * kinematics.screws)
        return {
            self.link_names[child]: JointMotion(value=float(value), T=T)
            for child, value, T in zip(kinematics.child, values, motions, strict=True)
            if value != 0.0
        }

    def joint_unit(self, name: str) -> Literal["m", "rad"]:
        """The unit of the values of one of ``joint_names``."""
        return "m" if self.joint_kinds[self.joint_names.index(name)] == "prismatic" else "rad"

    def link_index(self, name: str) -> int:
        """The place of a link in ``link_names``.

        Raises:
            TorchcalError: If there is no such link.
        """
        if name not in self.link_names:
            expected = choices(self.link_names)
            raise TorchcalError(f"{self.file}: found link {name!r}; expected {expected}")
        return self.link_names.index(name)


def load_robot(urdf: Path) -> Robot:
    """Reads a robot: fixed, revolute, continuous and prismatic joints, meshes and primitives.

    Raises:
        JobError: If the URDF or one of its meshes is missing, broken or not supported.
    """
    tree = read_urdf(urdf)
    free = [joint for joint in tree.joints if joint.kind != "fixed" and joint.mimic is None]
    names = (tree.root, *(link.name for link in tree.links if link.name != tree.root))
    meshes = {link.name: link_mesh(urdf, link) for link in tree.links}
    leaders = {joint.name: _leader(tree, joint) for joint in tree.joints if joint.mimic}
    return Robot(
        file=urdf,
        name=tree.name,
        joint_names=tuple(joint.name for joint in free),
        joint_kinds=tuple(joint.kind for joint in free),
        joint_limits=torch.tensor([j.limits for j in free], dtype=torch.float64).reshape(-1, 2),
        mimics={name: leader for name, (leader, _, _) in leaders.items()},
        link_names=names,
        link_meshes={name: mesh for name, mesh in meshes.items() if mesh is not None},
        kinematics=_kinematics(tree, names, [joint.name for joint in free], leaders),
    )


def _leader(tree: Urdf, joint: Joint) -> tuple[str, float, float]:
    """The free joint that a joint follows in the end, with multiplier and offset."""
    moving = {other.name: other for other in tree.joints if other.kind != "fixed"}
    current, multiplier, offset, passed = joint, 1.0, 0.0, {joint.name}
    while current.mimic is not None:
        key, followed = f"joint.{current.name}.mimic.joint", current.mimic.joint
        if followed not in moving:
            raise JobError(tree.file, key, repr(followed), choices(moving))
        if followed in passed:
            expected = "a joint that does not follow this one"
            raise JobError(tree.file, key, f"{followed!r}, a circle", expected)
        offset += multiplier * current.mimic.offset
        multiplier *= current.mimic.multiplier
        passed.add(followed)
        current = moving[followed]
    return current.name, multiplier, offset


def _kinematics(
    tree: Urdf,
    links: tuple[str, ...],
    free: list[str],
    leaders: dict[str, tuple[str, float, float]],
) -> Kinematics:
    chain = pk.Chain(_frame(tree, tree.root, None), dtype=torch.float64)
    names = chain.get_joint_parameter_names()
    follow = torch.zeros(len(names), len(free), dtype=torch.float64)
    offset = torch.zeros(len(names), dtype=torch.float64)
    for row, name in enumerate(names):
        leader, multiplier, shift = leaders.get(name, (name, 1.0, 0.0))
        follow[row, free.index(leader)] = multiplier
        offset[row] = shift
    joints = {joint.name: joint for joint in tree.joints}
    moving = [joints[name] for name in names]
    above = {joint.child: joint for joint in tree.joints}
    return Kinematics(
        chains={torch.device("cpu"): chain},
        link_frames=tuple(chain.frame_to_idx[link] for link in links),
        follow=follow,
        offset=offset,
        child=tuple(links.index(joint.child) for joint in moving),
        screws=torch.stack([_screw(joint) for joint in moving])
        if moving
        else offset.new_zeros(0, 6),
        moves=torch.tensor(
            [[joint.name in _joints_above(link, above) for joint in moving] for link in links],
            dtype=torch.bool,
        ).reshape(len(links), len(moving)),
    )


def _screw(joint: Joint) -> Tensor:
    """The twist of a joint about or along its axis, per rad or m."""
    axis = torch.nn.functional.normalize(torch.tensor(joint.axis, dtype=torch.float64), dim=0)
    none = torch.zeros_like(axis)
    return torch.cat([axis, none] if joint.kind == "prismatic" else [none, axis])


def _joints_above(link: str, above: dict[str, Joint]) -> set[str]:
    """The joints between a link and the root."""
    passed = set()
    while link in above:
        passed.add(above[link].name)
        link = above[link].parent
    return passed


def _frame(tree: Urdf, link: str, joint: Joint | None) -> pk.frame.Frame:
    """A link, the joint above it and everything below it."""
    frame = pk.frame.Frame(link, link=pk.frame.Link(link), joint=_pk_joint(joint))
    for below in tree.joints:
        if below.parent == link:
            frame.add_child(_frame(tree, below.child, below))
    return frame


def _pk_joint(joint: Joint | None) -> pk.frame.Joint:
    if joint is None:
        return pk.frame.Joint(dtype=torch.float64)
    offset = origin_matrix(joint.origin)[None]
    return pk.frame.Joint(
        joint.name,
        offset=Transform3d(matrix=offset, dtype=torch.float64),
        joint_type=_PK_KINDS.get(joint.kind, "fixed"),
        axis=torch.tensor(joint.axis if any(joint.axis) else (1.0, 0.0, 0.0), dtype=torch.float64),
        dtype=torch.float64,
    )
