"""``torchcal import``: a job of a recording, and what a person still has to say."""

import math
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console

from torchcal.cli.commands import USABLE, line
from torchcal.cli.console import write
from torchcal.cli.options import Import
from torchcal.cli.output import replaced_folder
from torchcal.cli.progress import progress
from torchcal.cli.result_files import as_json
from torchcal.errors import TorchcalError
from torchcal.model.recordings.import_recording import Imported, import_recording
from torchcal.model.recordings.recorded import Selection


def run_import(command: Import, out: Console, err: Console) -> int:
    """``torchcal import``; returns the exit status."""
    _refuse_to_replace(command.out)
    with replaced_folder(command.out) as folder, progress(err) as report:
        report("import", 0.0)
        imported = import_recording(
            command.source,
            folder,
            selection=_selection(command),
            packages=packages_of(command.package),
            world=command.world,
            like=command.like,
        )
        report("import", 1.0)
    job = command.out / imported.job.name
    if command.options.json:
        write(out, as_json(_as_dict(imported, job)) + "\n")
    else:
        _tell(imported, job, out)
    return USABLE


def packages_of(named: Sequence[str]) -> dict[str, Path]:
    """The folders of packages by name, as a person typed them: NAME=DIR.

    Raises:
        TorchcalError: If one has no name, or its folder is not there.
    """
    found = {}
    for text in named:
        name, _, folder = text.partition("=")
        if not name or not Path(folder).is_dir() or not folder:
            raise TorchcalError(f"--package: found {text}; expected NAME=DIR, a folder")
        found[name] = Path(folder)
    return found


def _refuse_to_replace(folder: Path) -> None:
    """What a person filled in must not be lost."""
    if folder.is_dir() and any(folder.iterdir()):
        raise TorchcalError(
            f"--out {folder}: found a folder with files; expected a new or an empty one, because "
            "what is filled in a job by hand is never replaced"
        )


def _selection(command: Import) -> Selection:
    for option, value in (
        ("--depth-unit", command.depth_unit),
        ("--resolution", command.resolution),
    ):
        if value is not None and not (math.isfinite(value) and value > 0.0):
            raise TorchcalError(f"{option}: found {value:g}; expected a number above 0")
    return Selection(
        frames=command.frames,
        use=command.use,
        urdf=command.urdf,
        link=command.link,
        depth_unit=command.depth_unit,
        resolution_deg=command.resolution,
        position=command.position,
    )


def _as_dict(imported: Imported, job: Path) -> dict[str, object]:
    return {
        "job": str(job),
        "frames": imported.frames,
        "notes": list(imported.notes),
        "to_fill_in": dict(imported.to_fill_in),
    }


def _tell(imported: Imported, job: Path, out: Console) -> None:
    for note in imported.notes:
        line(out, note)
    for key, words in imported.to_fill_in.items():
        line(out, f"FILL IN {key}: {words}")
    line(out, f"{imported.frames} frames are in {job}; next: torchcal check {job}")
