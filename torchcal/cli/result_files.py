"""What a calibration writes: the face that other programs read (``result.json`` and the rest)."""

import json
import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from torch import Tensor

from torchcal.calibrate.check_result import Foresight, JobCheck
from torchcal.calibrate.kept_result import kept
from torchcal.calibrate.result import (
    AddedObject,
    Calibration,
    Estimate,
    FrameComparison,
    ObjectVerdict,
    PixelClass,
    UnobservableDirection,
)
from torchcal.calibrate.result_folder import write_kept
from torchcal.display import canvas, figures
from torchcal.display.decided import REPORT
from torchcal.display.report import FramePictures, pictured_frames, report
from torchcal.display.summary import axis_sigmas
from torchcal.model.job import Job
from torchcal.model.unique_names import unique_names
from torchcal.model.urdf import write_urdf


def result_dict(calibration: Calibration) -> dict[str, Any]:
    """The contents of ``result.json``: metres and radians; no NaN (None instead)."""
    estimate, update = calibration.estimate, calibration.update
    result = {
        "status": estimate.status.value,
        "message": estimate.message,
        "parameters": _parameters(calibration),
        "names": list(estimate.names),
        "covariance": _numbers(estimate.covariance),
        "unobservable": _directions(estimate.unobservable),
        "alternatives": [
            {"Ts_world_sensor": _numbers(other.Ts_world_sensor), "score": other.score}
            for other in estimate.alternatives
        ],
        "frames": [_frame(calibration, index) for index in range(len(calibration.comparisons))],
        "objects": {name: _verdict(verdict) for name, verdict in update.verdicts.items()},
        "added": [_added(item) for item in update.added],
        "timing": calibration.timing,
        "next_view": None if calibration.next_view is None else asdict(calibration.next_view),
        "warnings": list(calibration.warnings),
        "pixels": {"used": estimate.used_pixels, "independent": estimate.independent_pixels},
    }
    return without_nan(result)


def check_dict(check: JobCheck) -> dict[str, Any]:
    """A check as plain data: metres and radians; no NaN (None instead)."""
    frames = [asdict(frame) for frame in check.frames]
    return without_nan({"frames": frames, **_expected(check), "warnings": list(check.warnings)})


def foresight_dict(found: Foresight) -> dict[str, Any]:
    """A foresight as plain data: metres and radians; no NaN (None instead)."""
    view = None if found.next_view is None else asdict(found.next_view)
    return without_nan({**_expected(found), "next_view": view})


def as_json(data: dict[str, Any]) -> str:
    """Strict JSON with every number to its last digit."""
    return json.dumps(data, indent=2, allow_nan=False, ensure_ascii=False)


def without_nan(data: Any) -> Any:
    """The same nested data with None for every number that is not finite; tuples become lists."""
    if isinstance(data, dict):
        return {key: without_nan(value) for key, value in data.items()}
    if isinstance(data, list | tuple):
        return [without_nan(value) for value in data]
    if isinstance(data, float) and not math.isfinite(data):
        return None
    return data


def write_results(calibration: Calibration, folder: Path | str) -> None:
    """Writes everything that a calibration leaves behind into a folder."""
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    shown = pictured_frames(calibration.comparisons)
    written = enumerate(_write_pictures(calibration, folder))
    pictures = {index: each for index, each in written if index in shown}
    _write_robot(calibration, folder)
    write_kept(kept(calibration), folder)
    (folder / REPORT).write_text(report(calibration, pictures), encoding="utf-8")
    text = as_json(result_dict(calibration))
    (folder / "result.json").write_text(text + "\n", encoding="utf-8")


def _parameters(calibration: Calibration) -> dict[str, Any]:
    """The estimated values, each with its standard deviation; known blocks are empty."""
    job, estimate = calibration.job, calibration.estimate
    poses: dict[str, Any] = {}
    if job.robot is None:
        sigmas = _pose_sigmas(estimate.pose_covariances[0])
        first = estimate.Ts_world_sensor[0]
        poses["sensor"] = {"T_world_sensor": _numbers(first), **sigmas}
    else:
        for group, key, T in (
            ("base", "T_world_base", estimate.T_world_base),
            ("mount", "T_link_sensor", estimate.T_link_sensor),
        ):
            sigmas = _split(axis_sigmas(estimate.names, estimate.covariance, group))
            poses[group] = {key: _numbers(T), **sigmas}
    sigmas = dict(zip(estimate.names, estimate.covariance.diagonal().sqrt().tolist(), strict=True))
    joints = {
        name: {"offset": offset, "sigma": sigmas.get(f"joints.{name}", 0.0)}
        for name, offset in estimate.joint_offsets.items()
    }
    objects = {
        name: {
            "T_world_object": _numbers(T),
            **_split(axis_sigmas(estimate.names, estimate.covariance, f"objects.{name}")),
        }
        for name, T in estimate.Ts_world_object.items()
    }
    return poses | {"joints": joints, "objects": objects, "range": _range(job, estimate, sigmas)}


def _range(job: Job, estimate: Estimate, sigmas: dict[str, float]) -> dict[str, float]:
    if job.range is None:
        return {}
    return {
        "offset_m": estimate.range_offset,
        "scale": estimate.range_scale,
        "offset_sigma_m": sigmas.get("range.offset", 0.0),
        "scale_sigma": sigmas.get("range.scale", 0.0),
    }


def _verdict(verdict: ObjectVerdict) -> dict[str, Any]:
    """One entry of ``objects``."""
    counts = {"verdict": verdict.verdict.value, "agree": verdict.agree}
    counts |= {"seen_through": verdict.seen_through, "hidden": verdict.hidden}
    counts |= {"frames": list(verdict.frames)}
    if verdict.T_world_object is None:
        return counts
    return counts | {"T_world_object": _numbers(verdict.T_world_object)}


def _expected(found: JobCheck | Foresight) -> dict[str, Any]:
    """How well each unknown can be told, and what cannot."""
    parameters = [asdict(parameter) for parameter in found.parameters]
    return {"parameters": parameters, "unobservable": _directions(found.unobservable)}


def _directions(directions: Sequence[UnobservableDirection]) -> list[dict[str, Any]]:
    return [{"words": each.words, "vector": _numbers(each.vector)} for each in directions]


def _frame(calibration: Calibration, index: int) -> dict[str, Any]:
    """One entry of ``frames``."""
    estimate, comparison = calibration.estimate, calibration.comparisons[index]
    counts = figures.class_counts(comparison)
    return {
        "depth": calibration.job.frames[index].image.file,
        "T_world_sensor": _numbers(estimate.Ts_world_sensor[index]),
        **_pose_sigmas(estimate.pose_covariances[index]),
        "measured": int((comparison.measured.isfinite() & comparison.usable).sum()),
        "agree": counts[PixelClass.AGREES],
        "nearer": counts[PixelClass.NEARER],
        "farther": counts[PixelClass.FARTHER],
        "unmodelled": counts[PixelClass.UNMODELLED],
        "missing": counts[PixelClass.MISSING],
    }


def _added(item: AddedObject) -> dict[str, Any]:
    """One entry of ``added``."""
    return {
        "name": item.name,
        "frames": list(item.frames),
        "extent_m": item.mesh.extents.tolist(),
        "bounds_m": item.mesh.bounds.tolist(),
    }


def _pose_sigmas(covariance: Tensor) -> dict[str, list[float]]:
    return _split(covariance.diagonal().clamp(min=0.0).sqrt().tolist())


def _split(sigmas: list[float]) -> dict[str, list[float]]:
    return {"position_sigma_m": sigmas[:3], "rotation_sigma_rad": sigmas[3:]}


def _numbers(tensor: Tensor) -> Any:
    return tensor.detach().cpu().double().tolist()


def _write_pictures(calibration: Calibration, folder: Path) -> Iterator[FramePictures]:
    """Draws and writes the figures of every frame."""
    for part in ("hybrid", "comparison"):
        (folder / part).mkdir()
    names = unique_names([comparison.name for comparison in calibration.comparisons])
    for name, comparison in zip(names, calibration.comparisons, strict=True):
        pictures = _pictures(comparison, calibration.job.alpha)
        pictures.hybrid.save(folder / "hybrid" / f"{name}.png")
        pictures.comparison.save(folder / "comparison" / f"{name}.png")
        yield pictures


def _pictures(comparison: FrameComparison, alpha: float) -> FramePictures:
    return FramePictures(
        hybrid=canvas.pixels(figures.hybrid_figure(comparison)),
        comparison=canvas.pixels(figures.comparison_figure(comparison, alpha)),
    )


def _write_robot(calibration: Calibration, folder: Path) -> None:
    job, estimate = calibration.job, calibration.estimate
    if job.robot is not None and job.link is not None:
        write_urdf(
            job.robot,
            folder / "robot.urdf",
            T_world_base=estimate.T_world_base,
            link=job.link,
            T_link_sensor=estimate.T_link_sensor,
            joint_offsets=estimate.joint_offsets,
        )
