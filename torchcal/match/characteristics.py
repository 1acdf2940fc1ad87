"""Which elements of a model may be which of an image: the matrix C of eq. 6, and likelihoods.

Elements are compared by their characteristic values, and where there is a starting value by what
it expects. Both sides are in the order planes, lines, vertexes.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchcal.match.elements import Elements
from torchcal.match.features import Features, LineKind, Lines, Planes, Vertices
from torchcal.match.invariants import GAMMA
from torchcal.match.prior_gate import Expectation, Match, Prior, moved_to_sensor
from torchcal.match.wholes import whole_areas, whole_lengths

SEEN_AS = (
    (0.6, 0.0, 0.4),
    (0.0, 1.0, 0.0),
    (0.0, 0.0, 1.0),
)
"""How often (in share) a line of the model (row) is seen as what (column), as ``LineKind`` counts:
a convex edge of which one side is hidden is a jump, a concave one hides nothing."""
JOINED_AREA, JOINED_LENGTH = 0.15, 0.1
"""Share (standard deviation) of what is seen that may be a neighbour's: the blur joins them."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Candidates:
    """Pairs that may belong together."""

    matrix: Bool[Tensor, "model measured"]
    """C of eq. 6."""
    log_likelihood: Float[Tensor, "model measured"]
    """Up to a constant for each measured element; -inf where C is 0."""


def all_elements(features: Features) -> Elements:
    """Planes, lines and vertexes, in the order of the rows and columns of C."""
    return Elements.join(
        features.planes.elements, features.lines.elements, features.vertices.elements
    )


def candidate_pairs(
    model: Features, measured: Features, *, prior: Prior | None = None, gamma: float = GAMMA
) -> Candidates:
    """Compares characteristic values: C_ij = 1 where |u_mi - u_rj| < gamma (eq. 6).

    The values are in units of their standard deviations. What an image shows only in part may be
    smaller than the model's but not larger.

    Args:
        model: Of the model, in the world's frame.
        measured: Of the image, in the sensor's frame.
        prior: The starting value; pairs that it does not expect are no candidates. None: anywhere.
        gamma: Threshold of the characteristic values, and of the prior's residuals.

    Raises:
        ValueError: If ``gamma`` is not positive.
    """
    if not gamma > 0.0:
        raise ValueError(f"gamma is {gamma}; it must be above 0")
    parts = (
        _compare_planes(model.planes, measured.planes),
        _compare_lines(model.lines, measured.lines),
        _compare_vertices(model.vertices, measured.vertices),
    )
    values = Match(
        distance=_block_diagonal([part.distance for part in parts], torch.inf),
        log_likelihood=_block_diagonal([part.log_likelihood for part in parts], -torch.inf),
    )
    matrix = values.distance < gamma
    likelihood = torch.where(matrix, values.log_likelihood, -torch.inf)
    found = Candidates(matrix=matrix, log_likelihood=likelihood)
    return found if prior is None else within(found, model, measured, prior, gamma)


def within(
    found: Candidates, model: Features, measured: Features, prior: Prior, gamma: float = GAMMA
) -> Candidates:
    """Those candidates that a starting value expects, with what it says of their likelihoods."""
    own, other = found.matrix.nonzero(as_tuple=True)
    T, P = moved_to_sensor(prior)
    match = Expectation.of(model, measured).at(T[None], P[None], own, other).match
    likelihood = found.log_likelihood[own, other] + match.log_likelihood[0]
    likelihood = torch.where(match.distance[0] < gamma, likelihood, -torch.inf)
    both = torch.full_like(found.log_likelihood, -torch.inf).index_put((own, other), likelihood)
    return Candidates(matrix=both > -torch.inf, log_likelihood=both)


def _block_diagonal(blocks: list[Tensor], empty: float) -> Tensor:
    rows, columns = (sum(block.shape[side] for block in blocks) for side in (0, 1))
    whole = blocks[0].new_full((rows, columns), empty)
    row = column = 0
    for block in blocks:
        height, width = block.shape
        whole[row : row + height, column : column + width] = block
        row, column = row + height, column + width
    return whole


def _compared(*errors: Tensor) -> Match:
    """From errors in standard deviations; NaN where there is nothing to compare."""
    squared = torch.stack([error.nan_to_num(0.0, torch.inf).square() for error in errors]).sum(0)
    return Match(distance=squared.sqrt(), log_likelihood=-0.5 * squared)


def _compare_planes(model: Planes, measured: Planes) -> Match:
    more = (measured.area - whole_areas(model)[:, None]).clamp(min=0.0)
    return _compared(more / torch.hypot(measured.area_sigma, JOINED_AREA * measured.area))


def _compare_lines(model: Lines, measured: Lines) -> Match:
    """By kind, dihedral angle and length; the length of what is cut is only a lower bound.

    Jumps end for many reasons, so their ends tell nothing.
    """
    length, whole = model.length[:, None], whole_lengths(model)[:, None]
    ends = model.is_end.all(1)[:, None] & measured.is_end.all(1)
    ends = ends & (measured.kind != LineKind.JUMP)
    shorter = torch.where(ends, (length - measured.length).clamp(min=0.0), 0.0)
    longer = (measured.length - whole).clamp(min=0.0)
    values = _compared(
        shorter / measured.length_sigma,
        longer / torch.hypot(measured.length_sigma, JOINED_LENGTH * measured.length),
        (model.dihedral[:, None] - measured.dihedral) / measured.dihedral_sigma,
    )
    chance = torch.tensor(SEEN_AS, dtype=length.dtype, device=length.device)
    seen_as = chance[model.kind[:, None], measured.kind].log()
    return Match(
        distance=torch.where(seen_as.isfinite(), values.distance, torch.inf),
        log_likelihood=values.log_likelihood + seen_as,
    )


def _compare_vertices(model: Vertices, measured: Vertices) -> Match:
    errors = (model.angles[:, None] - measured.angles) / measured.angles_sigma
    return _compared(*errors.unbind(-1))
