"""Vectors of three numbers in machine code."""

from typing import no_type_check

from torchcal.render.machine_code.compiled import leaf


@leaf
@no_type_check
def plane(a, b, c):
    """Normal of the plane through three points: not normalised."""
    return cross((b[0] - a[0], b[1] - a[1], b[2] - a[2]), (c[0] - a[0], c[1] - a[1], c[2] - a[2]))


@leaf
@no_type_check
def cross(a, b):
    """Vector product."""
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


@leaf
@no_type_check
def dot(a, b):
    """Scalar product, added up in the order of ``facets.dot``."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@leaf
@no_type_check
def row(points, k):
    """One of many points."""
    return points[k, 0], points[k, 1], points[k, 2]
