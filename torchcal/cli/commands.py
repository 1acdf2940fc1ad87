"""What the commands do: a call or two of the library each, then files and a screenful of text."""

from pathlib import Path

import numpy as np
import torch
from rich.console import Console

from torchcal.calibrate import calibrate, check, predict
from torchcal.calibrate.result import Calibration, Status
from torchcal.cli.console import write
from torchcal.cli.demo_table import demo_table
from torchcal.cli.options import Calibrate, Check, Demo, Options, Render
from torchcal.cli.output import input_files, replaced_folder
from torchcal.cli.progress import Report, progress
from torchcal.cli.result_files import (
    as_json,
    check_dict,
    result_dict,
    write_results,
)
from torchcal.cli.tables import calibration_view, check_view
from torchcal.demo import make_demo
from torchcal.display import canvas, figures
from torchcal.errors import TorchcalError
from torchcal.model.job import Job
from torchcal.model.read_job import read_job
from torchcal.model.unique_names import unique_names

USABLE, UNREADABLE, NOT_USABLE, INTERRUPTED = 0, 2, 3, 130
"""What the exit status says."""


def run_calibrate(command: Calibrate, out: Console, err: Console) -> int:
    """``torchcal calibrate``; returns the exit status."""
    job = _read(command.job, command.options)
    with replaced_folder(command.out, input_files(command.job)) as folder:
        with progress(err) as report:
            calibration = _calibrate(job, command.options, report, estimate=command.estimate)
            report("write results", 0.0)
            write_results(calibration, folder)
            report("write results", 1.0)
    _tell(calibration, command.options, command.out, out)
    return exit_status(calibration)


def run_render(command: Render, out: Console, err: Console) -> int:
    """``torchcal render``; returns the exit status."""
    job = _read(command.job, command.options)
    names = unique_names([frame.image.name for frame in job.frames])
    with replaced_folder(command.out, input_files(command.job)) as folder:
        with progress(err) as report:
            report("render", 0.0)
            for part in ("depth", "preview"):
                (folder / part).mkdir()
            for done, (name, ranges) in enumerate(zip(names, predict(job), strict=True), start=1):
                _write_prediction(folder, name, ranges)
                report("render", done / len(names))
    if command.options.json:
        files = [{"depth": f"depth/{name}.npy", "preview": f"preview/{name}.png"} for name in names]
        print_json({"frames": files}, out)
    else:
        line(out, f"{len(names)} predicted range images (m) are in {command.out / 'depth'}")
        line(out, f"Pictures of them are in {command.out / 'preview'}")
    return USABLE


def run_check(command: Check, out: Console, err: Console) -> int:
    """``torchcal check``; returns the exit status."""
    with progress(err) as report:
        report("check", 0.0)
        found = check(_read(command.job, command.options))
        report("check", 1.0)
    if command.options.json:
        print_json(check_dict(found), out)
    else:
        out.print(check_view(found))
    return USABLE


def run_demo(command: Demo, out: Console, err: Console) -> int:
    """``torchcal demo``; returns the exit status."""
    options = command.options
    with replaced_folder(command.out) as folder:
        with progress(err) as report:
            truth = make_demo(folder, seed=options.seed, progress=report)
            calibration = _calibrate(_read(truth.job, options), options, report)
            (folder / "result").mkdir()
            write_results(calibration, folder / "result")
    _tell(calibration, options, command.out / "result", out)
    (err if options.json else out).print(demo_table(calibration, truth))
    return exit_status(calibration)


def exit_status(calibration: Calibration) -> int:
    """0 only when the answer can be used."""
    return USABLE if calibration.estimate.status == Status.CONVERGED else NOT_USABLE


def device(options: Options) -> torch.device:
    """Where to compute.

    Raises:
        TorchcalError: If cuda is asked for and there is none.
    """
    if options.device == "cuda" and not torch.cuda.is_available():
        raise TorchcalError("--device: found cuda; expected cpu, because torch sees no GPU")
    return torch.device(options.device or ("cuda" if torch.cuda.is_available() else "cpu"))


def generator(options: Options) -> torch.Generator:
    """The random numbers of a run."""
    return torch.Generator().manual_seed(options.seed % 2**63)


def _read(file: Path, options: Options) -> Job:
    return read_job(file, device=device(options))


def _calibrate(job: Job, options: Options, report: Report, *, estimate: bool = True) -> Calibration:
    return calibrate(job, estimate=estimate, generator=generator(options), progress=report)


def _write_prediction(folder: Path, name: str, ranges: torch.Tensor) -> None:
    """One predicted range image (m) and its picture."""
    np.save(folder / "depth" / f"{name}.npy", ranges.detach().cpu().float().numpy())
    figure = figures.range_figure(ranges, f"Predicted range of frame {name}")
    canvas.pixels(figure).save(folder / "preview" / f"{name}.png")


def _tell(calibration: Calibration, options: Options, folder: Path, out: Console) -> None:
    """The answer on standard output."""
    if options.json:
        print_json(result_dict(calibration), out)
        return
    out.print(calibration_view(calibration))
    line(out, f"Open {folder / 'report.html'}")


def line(out: Console, words: str) -> None:
    """Prints words as they are: no markup, no line breaks of our own."""
    out.print(words, markup=False, highlight=False, soft_wrap=True)


def print_json(data: dict, out: Console) -> None:
    """Exactly the JSON, without colours or line breaks of our own."""
    write(out, as_json(data) + "\n")
