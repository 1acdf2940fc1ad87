"""From a job's ``[sensor]`` table to the sensor of the method."""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from torchcal.errors import JobError, TorchcalError, choices
from torchcal.geometry.projection import Pinhole, Projection, Spherical
from torchcal.model.job_schema import SensorTable
from torchcal.model.sensor import PRESETS, Noise, Sensor

_OPTICS = {
    "pinhole": ("width", "height", "fx", "fy", "cx", "cy"),
    "spherical": ("columns", "rows", "azimuth_deg", "elevation_deg"),
}
"""The keys that each model of a sensor needs and no other model has."""


def with_preset(table: Mapping[str, Any]) -> dict[str, Any]:
    """The keys of a ``[sensor]`` table with those of its preset; the table itself wins."""
    name = table.get("preset")
    preset = PRESETS.get(name, {}) if isinstance(name, str) else {}
    return {**preset, **table}


def preset_sensor(name: str) -> Sensor:
    """One of the paper's sensors (2.2), as a job that names nothing else has it.

    Raises:
        TorchcalError: If there is no such preset.
    """
    if name not in PRESETS:
        raise TorchcalError(f"preset: found {name!r}; expected {choices(PRESETS)}")
    table = {"preset": name, **PRESETS[name]}
    return read_sensor(Path(name), SensorTable.model_validate(table))


def read_sensor(file: Path, table: SensorTable) -> Sensor:
    """The sensor that a checked table describes.

    Args:
        file: The job file, for the message of an error.
        table: The ``[sensor]`` table, its preset filled in.

    Raises:
        JobError: If a key that the sensor's model needs is missing, one belongs to another model,
            or the keys contradict each other.
    """
    _check_preset(file, table)
    _check_optics(file, table)
    _check_sigma(file, table)
    _check_beam(file, table)
    return Sensor(
        projection=_pinhole(table) if table.model == "pinhole" else _spherical(file, table),
        noise=_noise(table),
        near=table.range[0],
        far=table.range[1],
        beam=table.beam,
        depth_unit=table.depth_unit,
    )


def _check_preset(file: Path, table: SensorTable) -> None:
    if table.preset is None:
        return
    model = PRESETS[table.preset]["model"]
    if table.model != model:
        expected = f'"{model}", which the preset "{table.preset}" is, or no preset'
        raise JobError(file, "sensor.model", f'"{table.model}"', expected)


def _check_optics(file: Path, table: SensorTable) -> None:
    fields = SensorTable.model_fields
    for model, keys in _OPTICS.items():
        for key in keys:
            value = getattr(table, key)
            if model == table.model and value is None:
                expected = f'{fields[key].description}, for the model "{model}"'
                raise JobError(file, f"sensor.{key}", "nothing", expected)
            if model != table.model and value is not None:
                own = ", ".join(_OPTICS[table.model])
                found = f'{value}, a key of the model "{model}"'
                expected = f'for the model "{table.model}" only {own}'
                raise JobError(file, f"sensor.{key}", found, expected)


def _check_sigma(file: Path, table: SensorTable) -> None:
    """sigma(z) must be positive over the whole range; between its ends a parabola may dip."""
    a, b, c = table.sigma
    near, far = table.range
    dip = -b / (2 * c) if c > 0 else near
    for z in (near, far, min(max(dip, near), far)):
        sigma = a + b * z + c * z * z
        if sigma <= 0:
            found = f"{list(table.sigma)}, which is {sigma:g} m at a range of {z:g} m"
            expected = (
                f"{SensorTable.model_fields['sigma'].description}, above 0 in all of the range"
            )
            raise JobError(file, "sensor.sigma", found, expected)


def _check_beam(file: Path, table: SensorTable) -> None:
    """Around every pixel the square of the beam must not be larger than two images."""
    longer = max(table.width or table.columns or 1, table.height or table.rows or 1)
    if table.beam > 2 * longer + 1:
        expected = f"an odd number of at most {2 * longer + 1} for images of {longer} pixels, or 0"
        raise JobError(file, "sensor.beam", f"{table.beam}", expected)


def _pinhole(table: SensorTable) -> Pinhole:
    return Pinhole(**{key: getattr(table, key) for key in _OPTICS["pinhole"]})


def _spherical(file: Path, table: SensorTable) -> Projection:
    assert table.columns is not None
    assert table.rows is not None
    return Spherical(
        width=table.columns,
        height=table.rows,
        azimuth=_span(file, table, "azimuth_deg", "columns"),
        elevation=_span(file, table, "elevation_deg", "rows"),
    )


def _span(file: Path, table: SensorTable, key: str, count_key: str) -> tuple[float, float]:
    """First and last angle (rad), which are the same where there is one column or row."""
    first, last = getattr(table, key)
    count = getattr(table, count_key)
    if count > 1 and first == last:
        found = f"[{first:g}, {last:g}] for {count} {count_key}"
        raise JobError(file, f"sensor.{key}", found, "two different angles in degrees")
    if count == 1 and first != last:
        found = f"[{first:g}, {last:g}] for sensor.{count_key} = 1"
        raise JobError(file, f"sensor.{key}", found, "twice the same angle in degrees")
    return math.radians(first), math.radians(last)


def _noise(table: SensorTable) -> Noise:
    a, b, c = table.sigma
    return Noise(a=a, b=b, c=c, drift=table.drift.as_drift() if table.drift else None)
