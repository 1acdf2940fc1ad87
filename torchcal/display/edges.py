"""Figure 3 of the paper: lines of a range image and edges of the model where it was estimated."""

import torch
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from torch import Tensor

from torchcal.calibrate.site import Site
from torchcal.display.canvas import Box, axes_at, blank
from torchcal.geometry import se3
from torchcal.geometry.projection import Projection
from torchcal.match.features import Lines
from torchcal.model.sensor import Sensor

WIDTH = 900
"""Pixels."""
HEADING = 40
JUMP = 0.1
"""m: a smaller step of the range is no edge."""
SHORTEST = 10.0
"""Pixels: shorter pieces of edges are not drawn."""
MODEL, IMAGE = "#35c4ff", "#ffb000"


def edges_figure(
    range_image: Float[Tensor, "h w"],
    lines: Lines,
    site: Site,
    sensor: Sensor,
    T_world_sensor: Float[Tensor, "4 4"],
) -> Figure:
    """Extracted lines and the visible edges of the model over a range image.

    Args:
        range_image: As it was measured (m).
        lines: Extracted from it, in the sensor's frame.
        site: The model.
        sensor: Its optics.
        T_world_sensor: Where the model is drawn from.
    """
    rows, columns = range_image.shape
    height = round(WIDTH * rows / columns)
    figure = blank(WIDTH, height + HEADING)
    axes = axes_at(figure, Box(left=0, top=HEADING, width=WIDTH, height=height))
    axes.imshow(range_image.numpy(), cmap="gray")
    edges = _model_edges(site, sensor, T_world_sensor)
    _draw(axes, edges, sensor.projection, MODEL, 1.2)
    _draw(axes, lines.ends, sensor.projection, IMAGE, 2.4)
    axes.set_xlim(-0.5, columns - 0.5)
    axes.set_ylim(rows - 0.5, -0.5)
    axes.set_axis_off()
    words = (
        (f"{len(lines.kind)} lines of the image", IMAGE),
        ("edges of the estimated model", MODEL),
    )
    for place, (text, colour) in zip((0.02, 0.4), words, strict=True):
        at = 1.0 - 0.5 * HEADING / (height + HEADING)
        figure.text(place, at, f"\u2014 {text}", color=colour, size=13, va="center", weight="bold")
    return figure


def _model_edges(site: Site, sensor: Sensor, T_world_sensor: Tensor) -> Float[Tensor, "edge 2 3"]:
    """Visible pieces of edges in the sensor's frame."""
    seen = site.seen_from(T_world_sensor, sensor, jump=JUMP)
    pieces = [part.piece_ends[part.piece_pixels >= SHORTEST] for part in (seen.lines, seen.limbs)]
    return se3.transform(se3.inverse(T_world_sensor), torch.cat(pieces))


def _draw(axes: Axes, ends: Tensor, projection: Projection, colour: str, width: float) -> None:
    for u, v in projection.pixels(ends).mT.tolist():
        axes.plot(u, v, color=colour, linewidth=width, solid_capstyle="round")
