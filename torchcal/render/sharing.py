"""Exact areas: silhouettes -> lines -> pieces -> cells -> the face seen in each -> the layer.

A pixel that lines cross is cut into cells within which one face is seen. Which lines there are and
what is seen in a cell are indices; positions and planes are differentiable. Cells fill their pixel
whatever is seen, so hidden lines, lines that coincide and gaps need no care: where both sides of a
line show the same surface nothing changes.
"""

import torch
from jaxtyping import Int
from torch import Tensor

from torchcal.render.integrals import sums_of
from torchcal.render.layer import Layer, with_squares
from torchcal.render.motion import BodyMotion
from torchcal.render.pieces import Lines, find_pieces
from torchcal.render.regions import divide
from torchcal.render.seams import seams_of
from torchcal.render.silhouette import borders_of
from torchcal.render.soup import Views


def share_pixels(
    layer: Layer, face: Int[Tensor, "view h w"], views: Views, motion: BodyMotion | None
) -> Layer:
    """Shares the pixels that lines cross among the faces that are seen in them.

    Args:
        layer: The layer in which every pixel shows the face at its centre.
        face: That face, of the triangles of all views.
        views: What is seen from where.
        motion: How bodies move with the parameters.
    """
    exact = views.exact()
    still = exact.still()
    borders = borders_of(views.still())
    edges = views.surface.edges[borders.edge]
    seams, of_seams = seams_of(face, still)
    lines = Lines(
        ends=torch.cat([still.vertices[edges], seams]),
        view=torch.cat([edges[:, 0] // (len(still.vertices) // views.count), of_seams]),
        jumps=torch.cat([borders.jumps, borders.jumps.new_zeros(len(seams))]),
    )
    divided = divide(*find_pieces(lines, face, still), borders, still)
    return with_squares(layer, divided.squares, sums_of(divided, borders, exact, motion))
