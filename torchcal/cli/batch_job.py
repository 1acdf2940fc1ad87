"""One job of a batch, wherever it runs: read, calibrate, write the result with its record."""

import math
import time
from collections.abc import Iterable
from datetime import UTC, datetime
from pathlib import Path

from torchcal.calibrate import calibrate
from torchcal.calibrate.parameters import Parameters
from torchcal.calibrate.pipeline import build_job_scene
from torchcal.calibrate.result import Calibration, PixelClass, Status
from torchcal.cli.commands import device, generator
from torchcal.cli.options import Options
from torchcal.cli.output import input_files, replaced_folder
from torchcal.cli.result_files import write_results
from torchcal.cli.unfinished import clear_leftovers
from torchcal.display.figures import class_counts
from torchcal.fleet.ledger import finished, write_record
from torchcal.fleet.task import Correction, Record, Task
from torchcal.model.job import Job
from torchcal.model.read_job import read_job


def run_job(task: Task) -> Record:
    """Calibrates one job as ``torchcal calibrate`` does; its folder appears as a whole.

    Raises:
        TorchcalError: If the job cannot be read or its folder may not be replaced.
    """
    began = time.perf_counter()
    if task.attempt > 1:
        clear_leftovers([task.folder])
        if (record := finished(task)) is not None:  # killed before it could say so
            return record
    options = Options(device=task.device, seed=task.seed)
    job = read_job(task.job, device=device(options))
    calibration = calibrate(job, generator=generator(options))
    with replaced_folder(task.folder, input_files(task.job)) as folder:
        write_results(calibration, folder)
        record = record_of(task, job, calibration, time.perf_counter() - began)
        write_record(record, folder)
    return record


def record_of(task: Task, job: Job, calibration: Calibration, seconds: float) -> Record:
    """What the fleet's table says of a calibration.

    Args:
        task: The task that was done.
        job: As it was read.
        calibration: What was found; its own job may have another nominal pose.
        seconds: That it took.
    """
    estimate = calibration.estimate
    counts = [class_counts(comparison) for comparison in calibration.comparisons]
    agree = sum(each[PixelClass.AGREES] for each in counts)
    compared = sum(sum(each.values()) - each[PixelClass.NOT_COMPARED] for each in counts)
    return Record(
        fingerprint=task.fingerprint,
        status=estimate.status.value,
        usable=estimate.status == Status.CONVERGED,
        message=estimate.message,
        attempts=task.attempt,
        seconds=seconds,
        frames=len(job.frames),
        agreement=agree / max(1, compared),
        robot=None if job.robot is None else job.robot.name,
        recorded=_youngest(task.job.parent / frame.image.file for frame in job.frames),
        corrections=_corrections(job, calibration),
    )


def _corrections(job: Job, calibration: Calibration) -> dict[str, Correction]:
    """Differences to the nominal state of the job file, even where the search did not need it."""
    told, estimate = calibration.job, calibration.estimate
    scene = build_job_scene(told)
    parameters, nominal = Parameters.of(told, scene), Parameters.of(job, scene).nominal
    values = parameters.difference(estimate.state, nominal).tolist()
    sigmas = estimate.covariance.diagonal().clamp(min=0.0).sqrt().tolist()
    found = zip(parameters.names, values, sigmas, parameters.units, strict=True)
    return {
        name: Correction(value=value, sigma=sigma, unit=unit)
        for name, value, sigma, unit in found
        if math.isfinite(value) and math.isfinite(sigma)
    }


def _youngest(files: Iterable[Path]) -> str:
    """When the last of these files was written."""
    written = max(file.stat().st_mtime for file in files)
    return datetime.fromtimestamp(written, UTC).isoformat(timespec="seconds")
