"""A hand-made calibration for the tests of everything that displays one."""

import dataclasses
from pathlib import Path

import torch
import trimesh

from torchcal.calibrate.decisions import Transaction
from torchcal.calibrate.result import (
    AddedObject,
    Alternative,
    Calibration,
    Estimate,
    Evidence,
    FrameComparison,
    NextView,
    ObjectVerdict,
    PixelClass,
    Status,
    UnobservableDirection,
    Update,
    Verdict,
)
from torchcal.geometry import se3
from torchcal.geometry.projection import Pinhole
from torchcal.model.job import Frame, Job, PosePrior
from torchcal.model.range_image import RangeImage
from torchcal.model.sensor import Noise, Sensor
from torchcal.model.world import World, WorldObject

HEIGHT, WIDTH = 48, 64


def block(rows: slice, columns: slice) -> torch.Tensor:
    """A mask of the small image."""
    mask = torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)
    mask[rows, columns] = True
    return mask


REGIONS = {
    PixelClass.NEARER: block(slice(10, 22), slice(8, 22)),
    PixelClass.FARTHER: block(slice(24, 40), slice(36, 52)),
    PixelClass.MISSING: block(slice(4, 14), slice(30, 44)),
    PixelClass.UNMODELLED: block(slice(2, 9), slice(52, 62)),
    PixelClass.NOT_COMPARED: block(slice(44, 48), slice(0, 64)),
}
"""Everything else agrees."""


def comparison(name: str = "0001", dtype: torch.dtype = torch.float64) -> FrameComparison:
    """A tilted wall at 2 to 3 m with one region of every class."""
    generator = torch.Generator().manual_seed(4)
    wall = torch.linspace(2.0, 3.0, WIDTH, dtype=dtype).expand(HEIGHT, WIDTH)
    predicted, nan = wall.clone(), torch.full_like(wall, torch.nan)
    noise = torch.randn(HEIGHT, WIDTH, generator=generator, dtype=torch.float64).to(dtype)
    measured = wall + 0.01 * noise
    measured = torch.where(REGIONS[PixelClass.NEARER], measured - 0.6, measured)
    measured = torch.where(REGIONS[PixelClass.FARTHER], measured + 0.5, measured)
    measured = torch.where(REGIONS[PixelClass.MISSING], nan, measured)
    empty = REGIONS[PixelClass.UNMODELLED] | REGIONS[PixelClass.NOT_COMPARED]
    predicted = torch.where(empty, nan, predicted)
    measured = torch.where(REGIONS[PixelClass.NOT_COMPARED], nan, measured)
    label = torch.full((HEIGHT, WIDTH), int(PixelClass.AGREES), dtype=torch.uint8)
    for member, mask in REGIONS.items():
        label[mask] = int(member)
    facing = torch.tensor([0.6, 0.0, -0.8], dtype=torch.float16)
    painted = torch.tensor([179, 166, 153], dtype=torch.uint8)
    return FrameComparison(
        name=name,
        measured=measured,
        predicted=predicted,
        sigma=torch.where(empty, nan, torch.full_like(wall, 0.012)),
        label=label,
        body=torch.where(empty, -1, 0).int(),
        colour=torch.where(empty[..., None], torch.zeros_like(painted), painted),
        normal=torch.where(empty[..., None], torch.zeros_like(facing), facing),
        usable=~block(slice(44, 48), slice(0, 64)),
    )


def estimate(frames: int, status: Status = Status.CONVERGED) -> Estimate:
    """A sensor that is held by its z axis and found 10 mm and 2 degrees off."""
    turn = torch.tensor([0.01, 0.0, 0.0, 0.0, 0.0, 0.0349], dtype=torch.float64)
    sigmas = torch.tensor([0.001, 0.002, 0.0003, 0.0004, 0.0005], dtype=torch.float64)
    poses = se3.exp(turn).expand(frames, 4, 4)
    full = torch.diag(torch.tensor([1e-6, 4e-6, 0.0, 9e-8, 1.6e-7, 2.5e-7], dtype=torch.float64))
    problems = status != Status.CONVERGED
    return Estimate(
        status=status,
        message="The images do not fix the height <z> & more." if problems else "All is well.",
        names=("base.x", "base.y", "base.rx", "base.ry", "base.rz"),
        covariance=torch.diag(sigmas.square()),
        T_world_base=torch.eye(4, dtype=torch.float64),
        T_link_sensor=torch.eye(4, dtype=torch.float64),
        Ts_world_sensor=poses,
        pose_covariances=full.expand(frames, 6, 6),
        state=torch.eye(4, dtype=torch.float64).repeat(2, 1, 1),
        joint_offsets={},
        Ts_world_object={},
        range_offset=0.0,
        range_scale=0.0,
        moved=(),
        sigma_scale=1.2,
        drift_sigma=0.002,
        drift_pixels=25.0,
        score=0.8,
        unobservable=(
            UnobservableDirection(
                words="movement along the wall",
                vector=torch.tensor([0.0, 1.0, 0.0, 0.0, 0.0], dtype=torch.float64),
            ),
        )
        if problems
        else (),
        alternatives=(Alternative(Ts_world_sensor=poses, score=0.85),) if problems else (),
    )


def job(names: tuple[str, ...]) -> Job:
    """A hand-held sensor before a wall and a crate."""
    eye = torch.eye(4, dtype=torch.float64)
    blank = torch.ones(HEIGHT, WIDTH, dtype=torch.float64)
    box = trimesh.creation.box((1.0, 2.0, 3.0))
    world = World(
        objects=tuple(
            WorldObject(name=name, mesh=box, T_world_object=eye) for name in ("wall", "crate")
        )
    )
    frames = tuple(
        Frame(
            image=RangeImage(name=name, file=f"depth/{name}.png", range=blank, usable=blank.bool()),
            joints=None,
            T_world_sensor=eye,
        )
        for name in names
    )
    sigma = torch.tensor([0.1, 0.1, 0.0, 0.05, 0.05, 0.05], dtype=torch.float64)
    lens = Pinhole(width=WIDTH, height=HEIGHT, fx=60.0, fy=60.0, cx=31.5, cy=23.5)
    return Job(
        file=Path("cell/job.toml"),
        world=world,
        robot=None,
        sensor=Sensor(projection=lens, noise=Noise(a=0.01), near=0.3, far=10.0, beam=1),
        link=None,
        T_world_base=eye,
        T_link_sensor=eye,
        frames=frames,
        base=PosePrior(sigma=sigma),
        mount=None,
    )


def calibration(
    names: tuple[str, ...] = ("0001", "0002"), status: Status = Status.CONVERGED
) -> Calibration:
    """A finished calibration of so many frames: a crate is gone, something was added."""
    added = trimesh.creation.box((0.2, 0.3, 0.4))
    added.apply_translation([1.0, 0.0, 0.0])
    return Calibration(
        job=job(names),
        estimate=estimate(len(names), status),
        comparisons=tuple(comparison(name) for name in names),
        update=Update(
            verdicts={
                "wall": ObjectVerdict(verdict=Verdict.AGREES, agree=900, seen_through=0, hidden=20),
                "crate": ObjectVerdict(
                    verdict=Verdict.REMOVED, agree=0, seen_through=256, hidden=0, frames=names[:1]
                ),
            },
            added=(
                AddedObject(
                    name="added-1",
                    frames=names[:1],
                    mesh=added,
                    evidence=Evidence(supporting=120, contradicting=0, hidden=0),
                ),
            ),
        ),
        next_view=NextView(joints={"elbow": 0.25}, gain=1.5, sigma={"base.x": 0.001}),
        warnings=(),
        timing={"read": 0.5, "estimate": 12.25},
    )


MOVED = se3.exp(torch.tensor([0.1, 0.2, 0.3, 0.1, 0.0, 0.2], dtype=torch.float64))


def transaction_of_all_kinds() -> Transaction:
    """The wall has moved, the crate is gone and one thing is new."""
    whole = calibration()
    wall = ObjectVerdict(
        verdict=Verdict.MOVED, agree=90, seen_through=5, hidden=2, T_world_object=MOVED
    )
    update = dataclasses.replace(whole.update, verdicts={**whole.update.verdicts, "wall": wall})
    return Transaction.undecided("job.toml", whole.job.world, update)
