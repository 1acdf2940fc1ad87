"""The folder of a result: what ``Result`` holds, written and read, and what a person decided.

Beside ``result.json`` and ``robot.urdf``: ``model/world.glb`` is the job's model,
``model/added.glb`` holds the meshes that are proposed, ``model/record.json`` the numbers,
``frames/*.npz`` the comparison of each frame. Of these only ``world.glb`` ever changes. Its extras
hold the decisions, so that a model and what was decided about it can never differ, whenever a
program is stopped.
"""

import json
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from filelock import FileLock
from torch import Tensor

from torchcal.calibrate.comparison_files import read_comparison, write_comparison
from torchcal.calibrate.decisions import Decision, Transaction
from torchcal.calibrate.kept_result import FramePlace, OnDemand, Result
from torchcal.calibrate.result import AddedObject, Evidence, ObjectVerdict, Status, Update, Verdict
from torchcal.errors import TorchcalError
from torchcal.geometry.projection import Pinhole, Projection, Spherical
from torchcal.model.robot import load_robot
from torchcal.model.unique_names import unique_names
from torchcal.model.world import World, WorldObject, load_world, read_extras, write_world

DECISIONS = "torchcal_decisions"
"""The key in the extras of ``world.glb``."""

RECORD = "model/record.json"
OLD_WORLD = "model/world.glb"
ADDED = "model/added.glb"
NEW_WORLD = "world.glb"
ROBOT = "robot.urdf"
LOCK = "model/update.lock"

_PROJECTIONS: Mapping[str, type[Pinhole] | type[Spherical]] = {
    "pinhole": Pinhole,
    "spherical": Spherical,
}


def write_kept(result: Result, folder: Path) -> None:
    """Writes a result, but for what ``read_result`` finds in ``result.json`` and ``robot.urdf``."""
    for part in ("model", "frames"):
        (folder / part).mkdir(parents=True, exist_ok=True)
    transaction = result.transaction
    if transaction.world is not None:
        write_world(transaction.world, folder / OLD_WORLD)
    eye = torch.eye(4, dtype=torch.float64)
    added = tuple(
        WorldObject(name=item.name, mesh=item.mesh, T_world_object=eye)
        for item in transaction.update.added
    )
    if added:
        write_world(World(objects=added), folder / ADDED)
    files = unique_names([frame.name for frame in result.frames])
    for file, comparison in zip(files, result.comparisons, strict=True):
        write_comparison(comparison, folder / "frames" / f"{file}.npz")
    text = json.dumps(_record(result, files), ensure_ascii=False)
    (folder / RECORD).write_text(text + "\n", encoding="utf-8")
    write_corrected(transaction, folder)


def write_corrected(transaction: Transaction, folder: Path) -> None:
    """Writes ``world.glb`` anew: the corrected model and, in its extras, the decisions.

    Nothing is written where there is neither a model nor a proposal.
    """
    if transaction.world is not None or transaction.decisions:
        decisions = {name: decision.value for name, decision in transaction.decisions.items()}
        write_world(transaction.corrected(), folder / NEW_WORLD, {DECISIONS: decisions})


def read_result(folder: Path | str) -> Result:
    """Reads what ``torchcal calibrate`` or ``write_results`` left in a folder.

    Raises:
        TorchcalError: If the folder holds no such result, or a part of it cannot be read.
    """
    folder = Path(folder)
    record, result = _read_json(folder, RECORD), _read_json(folder, "result.json")
    with _named_mistakes(folder):
        robot = folder / ROBOT
        return Result(
            status=Status(result["status"]),
            message=result["message"],
            estimated=record["estimated"],
            alpha=record["alpha"],
            projection=_projection(record["projection"]),
            bodies=tuple(record["bodies"]),
            transaction=_transaction(folder, record, result),
            link_meshes=load_robot(robot).link_meshes if robot.exists() else {},
            frames=tuple(
                _place(*each) for each in zip(record["frames"], result["frames"], strict=True)
            ),
            comparisons=OnDemand(
                partial(read_comparison, folder / "frames" / each["file"], each["name"])
                for each in record["frames"]
            ),
        )


def read_transaction(folder: Path | str) -> Transaction:
    """The part of ``read_result`` that deciding needs.

    Raises:
        TorchcalError: As ``read_result``.
    """
    folder = Path(folder)
    record, result = _read_json(folder, RECORD), _read_json(folder, "result.json")
    with _named_mistakes(folder):
        return _transaction(folder, record, result)


def read_status(folder: Path | str) -> tuple[Status, str]:
    """Whether a result can be used, and a sentence about it.

    Raises:
        TorchcalError: As ``read_result``.
    """
    result = _read_json(Path(folder), "result.json")
    with _named_mistakes(Path(folder)):
        return Status(result["status"]), result["message"]


def decide(
    folder: Path | str,
    *,
    accept: Collection[str] = (),
    reject: Collection[str] = (),
    then: Callable[[Transaction], None] | None = None,
) -> Transaction:
    """Accepts and rejects proposals of a result, and writes its ``world.glb`` anew.

    Stopped at any moment, the folder holds the old model and decisions, or the new ones.

    Args:
        folder: What ``torchcal calibrate`` wrote.
        accept: Names of proposals, or ``all`` for those that are not named.
        reject: Likewise.
        then: Told what is decided, before anyone else can decide.

    Raises:
        TorchcalError: As ``read_result``; and if there is no such proposal, or one is to be both.
    """
    folder = Path(folder)
    _read_json(folder, RECORD)  # where there is no result there is no place for a lock
    # Whoever decides at the same time waits, and then decides on top of this.
    with FileLock(folder / LOCK):
        transaction = read_transaction(folder).decided(accept=accept, reject=reject)
        write_corrected(transaction, folder)
        if then is not None:
            then(transaction)
    return transaction


def _record(result: Result, files: list[str]) -> dict[str, Any]:
    """What neither ``result.json`` nor a mesh file says."""
    transaction = result.transaction
    return {
        "source": transaction.source,
        "estimated": result.estimated,
        "alpha": result.alpha,
        "projection": _projection_dict(result.projection),
        "bodies": list(result.bodies),
        "modelled": transaction.world is not None,
        "complete": transaction.world is not None and transaction.world.complete,
        "evidence": {item.name: asdict(item.evidence) for item in transaction.update.added},
        "frames": [
            {
                "name": frame.name,
                "file": f"{file}.npz",
                "pose_covariance": frame.pose_covariance.tolist(),
                "Ts_world_link": {link: T.tolist() for link, T in frame.Ts_world_link.items()},
            }
            for file, frame in zip(files, result.frames, strict=True)
        ],
    }


def _place(record: dict[str, Any], frame: dict[str, Any]) -> FramePlace:
    return FramePlace(
        name=record["name"],
        T_world_sensor=_tensor(frame["T_world_sensor"]),
        pose_covariance=_tensor(record["pose_covariance"]),
        Ts_world_link={link: _tensor(T) for link, T in record["Ts_world_link"].items()},
    )


def _transaction(folder: Path, record: dict[str, Any], result: dict[str, Any]) -> Transaction:
    update = Update(
        verdicts={name: _verdict(entry) for name, entry in result["objects"].items()},
        added=_added(folder, record, result),
    )
    world = None
    if record["modelled"]:
        world = _world(folder, OLD_WORLD, complete=record["complete"])
    start = Transaction.undecided(record["source"], world, update)
    new = folder / NEW_WORLD
    said = read_extras(new).get(DECISIONS, {}) if new.exists() else {}
    decisions = {name: Decision(said.get(name, old)) for name, old in start.decisions.items()}
    return replace(start, decisions=decisions)


def _verdict(entry: dict[str, Any]) -> ObjectVerdict:
    T = entry.get("T_world_object")
    return ObjectVerdict(
        verdict=Verdict(entry["verdict"]),
        agree=entry["agree"],
        seen_through=entry["seen_through"],
        hidden=entry["hidden"],
        T_world_object=None if T is None else _tensor(T),
        frames=tuple(entry["frames"]),
    )


def _added(folder: Path, record: dict[str, Any], result: dict[str, Any]) -> tuple[AddedObject, ...]:
    meshes = {}
    if result["added"]:
        meshes = {item.name: item.mesh for item in _world(folder, ADDED, complete=False).objects}
    return tuple(
        AddedObject(
            name=entry["name"],
            frames=tuple(entry["frames"]),
            mesh=meshes[entry["name"]],
            evidence=Evidence(**record["evidence"][entry["name"]]),
        )
        for entry in result["added"]
    )


def _world(folder: Path, name: str, *, complete: bool) -> World:
    """A world that ``write_world`` wrote."""
    if not (folder / name).is_file():
        raise _unreadable(folder, f"no {name}")
    eye = torch.eye(4, dtype=torch.float64)
    return load_world(folder / name, unit=1.0, T_world_file=eye, complete=complete)


def _projection_dict(projection: Projection) -> dict[str, Any]:
    for kind, lens in _PROJECTIONS.items():
        if isinstance(projection, lens):
            return {"kind": kind, **asdict(projection)}
    raise TorchcalError(f"found a {type(projection).__name__}; expected a pinhole or spherical one")


def _projection(entry: dict[str, Any]) -> Projection:
    numbers: dict[str, Any] = {
        key: tuple(value) if isinstance(value, list) else value for key, value in entry.items()
    }
    return _PROJECTIONS[numbers.pop("kind")](**numbers)


def _read_json(folder: Path, name: str) -> dict[str, Any]:
    try:
        return json.loads((folder / name).read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise _unreadable(folder, f"no {name}") from error
    except (ValueError, RecursionError) as error:
        raise _unreadable(folder, f"{name}, which is no JSON ({error})") from error


@contextmanager
def _named_mistakes(folder: Path) -> Iterator[None]:
    """Contents that another program or version wrote are an error that names the folder."""
    try:
        yield
    except (LookupError, TypeError, ValueError, AttributeError, RecursionError) as error:
        found = f"{type(error).__name__}: {error}"
        raise _unreadable(
            folder, f"{RECORD}, result.json or {NEW_WORLD} with other contents ({found})"
        ) from error


def _unreadable(folder: Path, found: str) -> TorchcalError:
    return TorchcalError(
        f"{folder}: found {found}; expected a folder that this version's torchcal calibrate wrote"
    )


def _tensor(numbers: Any) -> Tensor:
    """Numbers of a file; None, which stands for those that are not finite, becomes NaN."""
    return torch.from_numpy(np.array(numbers, dtype=np.float64))
