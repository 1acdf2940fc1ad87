"""Exact areas: silhouettes -> lines -> pieces -> cells -> the face seen in each -> the layer.

A pixel that lines cross is cut into cells within which one face is seen. Which lines there are and
what is seen in a cell are indices; positions and planes are differentiable. Cells fill their pixel
whatever is seen, so hidden lines, lines that coincide and gaps need no care: where both sides of a
line show the same surface nothing changes.
"""

import torch
from torch import Tensor

from torchcal.geometry.projection import Projection
from torchcal.model.scene import Surface
from torchcal.model.sensor import Sensor
from torchcal.render.cells import Cells, cells_of, joined
from torchcal.render.facets import Facets
from torchcal.render.layer import BorderPlanes, Layer, with_regions
from torchcal.render.motion import BodyMotion
from torchcal.render.pieces import Lines, Pieces, find_pieces, with_seams
from torchcal.render.regions import range_of_regions, regions_of, rims_of, shows_several
from torchcal.render.seams import seams_missed, seams_of
from torchcal.render.silhouette import borders_of
from torchcal.render.squares import Squares
from torchcal.render.visibility import faces_at_points


def share_pixels(
    layer: Layer,
    vertices: Tensor,
    soup: Surface,
    facets: Facets,
    soup_face: Tensor,
    sensor: Sensor,
    motion: BodyMotion | None,
) -> Layer:
    """Shares the pixels that lines cross among the faces that are seen in them.

    Args:
        layer: The layer in which every pixel shows the face at its centre.
        vertices: Points in the sensor's frame of their view (m).
        soup: The triangles of all views.
        facets: Their planes.
        soup_face: The face at the centre of every pixel.
        sensor: Optics and limits.
        motion: How bodies move with the parameters.
    """
    projection, views = sensor.projection, len(soup_face)
    exact = vertices.double()
    still = exact.detach()
    borders = borders_of(vertices.detach(), soup, facets, projection)
    edges = soup.edges[borders.edge]
    seams, of_seams = seams_of(soup_face, still, soup, projection)
    lines = Lines(
        ends=torch.cat([still[edges], seams]),
        view=torch.cat([edges[:, 0] // (len(still) // views), of_seams]),
        jumps=torch.cat([borders.jumps, borders.jumps.new_zeros(len(seams))]),
    )
    squares, pieces = find_pieces(lines, soup_face, still, soup, projection)
    cells, seen, pieces = _seen_cells(squares, pieces, still, soup, projection, views)
    mixed = shows_several(cells, seen, len(squares.view))
    squares, several = squares.select(mixed), mixed[cells.square]
    cells, seen = cells.select(several).renumbered(mixed), seen[several]
    regions = regions_of(cells, seen)
    hits = range_of_regions(regions, squares, vertices, soup, projection)
    hits = hits.between(sensor.near, sensor.far)
    first, last = exact[edges].unbind(1)
    planes = BorderPlanes(
        normal=torch.linalg.cross(first, last - first),
        along=last - first,
        body=soup.vertex_body[edges[:, 0]],
    )
    rims = rims_of(cells, seen, pieces, squares, still, soup, borders, sensor)
    return with_regions(layer, squares, regions, hits, rims, planes, motion)


def _seen_cells(
    squares: Squares,
    pieces: Pieces,
    vertices: Tensor,
    soup: Surface,
    projection: Projection,
    views: int,
) -> tuple[Cells, Tensor, Pieces]:
    """The cells of all squares, the faces seen in them, and the pieces between them."""
    faces = soup.faces[: len(soup.faces) // views]

    def seen_in(cells: Cells) -> Tensor:
        rays = squares.rays(cells.square, *cells.centroids())
        own = vertices.view(views, -1, 3)
        seen = faces_at_points(own, faces, projection, squares, cells.square, rays)
        return torch.where(seen < 0, seen, seen + squares.view[cells.square] * len(faces))

    cells = cells_of(pieces, len(squares.view))
    seen = seen_in(cells)
    square, ends = seams_missed(cells, seen, vertices, soup)
    if not len(square):
        return cells, seen, pieces
    more = with_seams(pieces, squares, square, ends, int(pieces.line.max()) + 1 + len(soup.edges))
    again = cells_of(more, len(squares.view))
    keep = ~torch.isin(cells.square, again.square)
    again_seen = seen_in(again)
    cells, order = joined(cells.select(keep), again, len(pieces.square))
    return cells, torch.cat([seen[keep], again_seen])[order], pieces.and_then(more)
