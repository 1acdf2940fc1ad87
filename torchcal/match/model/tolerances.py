"""How flat, how sharp and how large the elements of a model are."""

import math
from dataclasses import dataclass

SHARE = 0.01
"""Of a model's size, for the shortest line of interest."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Tolerances:
    """What counts as a plane and as a line of a model."""

    distance: float
    """m: how far triangles and pieces of a line may be from their plane or line."""
    angle: float = math.radians(3.0)
    """rad: between neighbouring triangles of a plane, and between pieces of a line."""
    crease: float = math.radians(20.0)
    """rad: the least dihedral angle of a line; less is part of a curved surface."""
    least_area: float
    """m^2 of a plane."""
    least_length: float
    """m of a line."""

    def __post_init__(self) -> None:
        for name in ("distance", "angle", "crease", "least_area", "least_length"):
            if not getattr(self, name) > 0.0:
                raise ValueError(f"{name} is {getattr(self, name)}; it must be above 0")
        if self.angle >= self.crease:
            raise ValueError(
                f"angle is {self.angle} and crease {self.crease}; triangles of a plane must meet "
                "at less than the angle of a line"
            )

    @staticmethod
    def of_size(size: float) -> "Tolerances":
        """For a clean model of a size (m): its largest extent."""
        length = SHARE * size
        return Tolerances(distance=1e-4 * size, least_area=length**2, least_length=length)
