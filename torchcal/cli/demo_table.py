"""What the demo found against what is true."""

import numpy as np
from rich.table import Table
from rich.text import Text
from torch import Tensor

from torchcal.calibrate.result import Calibration
from torchcal.demo import DemoTruth
from torchcal.display.summary import axis_sigmas
from torchcal.geometry import se3


def demo_table(calibration: Calibration, truth: DemoTruth) -> Table:
    """Base pose, removed, added and innocent objects: found against true."""
    table = Table(title="Found against true", title_justify="left", title_style="bold")
    for heading in ("what", "found", "truth or claim", ""):
        table.add_column(heading)
    for what, found, true, right in (
        *_pose_rows(calibration, truth.T_world_base),
        _removed_row(calibration, truth),
        *_added_rows(calibration, truth),
        _innocent_row(calibration, truth),
    ):
        mark = Text("✔", style="green") if right else Text("✘", style="red")
        table.add_row(what, found, true, mark)
    return table


Row = tuple[str, str, str, bool]


def _pose_rows(calibration: Calibration, T_world_base: Tensor) -> list[Row]:
    """Errors of the base beside what the calibration claims; right if within three sigma."""
    estimate = calibration.estimate
    error = se3.log(se3.inverse(T_world_base.to(estimate.T_world_base)) @ estimate.T_world_base)
    sigmas = axis_sigmas(estimate.names, estimate.covariance, "base")
    rows = []
    for what, unit, part in (("position", "mm", slice(0, 3)), ("rotation", "mrad", slice(3, 6))):
        off = 1000.0 * float(error[part].norm())
        sigma = 1000.0 * float(np.linalg.norm(sigmas[part]))
        found, claim = f"{off:.3f} {unit} off", f"± {sigma:.3f} {unit} (1σ claimed)"
        rows.append((f"base {what}", found, claim, off <= 3.0 * sigma))
    return rows


def _accused(calibration: Calibration) -> set[str]:
    verdicts = calibration.update.verdicts.items()
    return {name for name, found in verdicts if found.verdict.is_change}


def _removed_row(calibration: Calibration, truth: DemoTruth) -> Row:
    found = _accused(calibration) & set(truth.removed)
    return (
        "removed",
        ", ".join(sorted(found)) or "none",
        ", ".join(truth.removed) or "none",
        found == set(truth.removed),
    )


def _innocent_row(calibration: Calibration, truth: DemoTruth) -> Row:
    accused = _accused(calibration) - set(truth.removed)
    return "wrongly accused", ", ".join(sorted(accused)) or "none", "none", not accused


def _added_rows(calibration: Calibration, truth: DemoTruth) -> list[Row]:
    """Each thing that was added, with the nearest thing that was found."""
    return [
        _added_row(calibration, name, np.asarray(centre), np.asarray(extent))
        for name, (centre, extent) in truth.added.items()
    ]


def _added_row(calibration: Calibration, name: str, centre: np.ndarray, extent: np.ndarray) -> Row:
    true = f"{name}: {' × '.join(f'{side:.2f}' for side in extent)} m"
    offsets = {
        item.name: float(np.linalg.norm(item.mesh.bounds.mean(axis=0) - centre))
        for item in calibration.update.added
    }
    if not offsets:
        return "added", "none", true, False
    nearest = min(offsets, key=lambda key: offsets[key])
    found = f"{nearest}, {1000.0 * offsets[nearest]:.0f} mm off"
    return "added", found, true, offsets[nearest] <= float(extent.max())
