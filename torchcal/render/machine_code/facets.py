"""Means over regions of faces' planes in machine code: as in ``facets.py``."""

from typing import no_type_check

from torchcal.render.machine_code.compiled import leaf
from torchcal.render.machine_code.vectors import dot


@leaf
@no_type_check
def mean_hit(normal, offset, frame, spread):
    """What ``Hits.averaged`` finds: the range, the factor of the normal in its derivative, the ray.

    Args:
        normal: Of the face's plane.
        offset: Of that plane.
        frame: The ray of the region's centroid, and how rays turn from column to column and from
            row to row.
        spread: Second moments (uu, uv, vv) of the region about its centroid, over its area.
    """
    (ray, to_u, to_v), (uu, uv, vv) = frame, spread
    scale = 1.0 / dot(normal, ray)
    slope_u, slope_v = dot(normal, to_u) * scale, dot(normal, to_v) * scale
    across_u, across_v = uu * slope_u + uv * slope_v, uv * slope_u + vv * slope_v
    excess = across_u * slope_u + across_v * slope_v
    gain = 1.0 + excess
    share = 1.0 / (gain * gain)
    along, turn_u, turn_v = (
        share * (gain + 2.0 * excess),
        2.0 * share * across_u,
        2.0 * share * across_v,
    )
    mean = (
        along * ray[0] - turn_u * to_u[0] - turn_v * to_v[0],
        along * ray[1] - turn_u * to_u[1] - turn_v * to_v[1],
        along * ray[2] - turn_u * to_u[2] - turn_v * to_v[2],
    )
    return offset * scale * gain, scale * gain, mean
