"""The nearest element of the model for every measured point (3.5 (1)).

The elements are small patches of the model's visible surface: a point and a normal. The trees live
in frames in which the patches stand still, so many hypotheses of the sensor's pose share one tree.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.spatial import KDTree
from torch import Tensor


@dataclass(frozen=True, kw_only=True, slots=True)
class Patches:
    """Oriented patches of a rigid part of the model."""

    points: Float[Tensor, "patch 3"]
    """m"""
    normals: Float[Tensor, "patch 3"]
    """Unit length."""
    tree: KDTree

    @staticmethod
    def of(points: Float[Tensor, "patch 3"], normals: Float[Tensor, "patch 3"]) -> "Patches":
        """Patches with the search tree over their points."""
        return Patches(points=points, normals=normals, tree=KDTree(points.cpu().numpy()))

    def nearest(
        self, queries: Float[Tensor, "*batch 3"]
    ) -> tuple[Float[Tensor, "*batch"], Int[Tensor, "*batch"]]:
        """Distance (m) to the nearest patch and its index.

        Infinite and 0 for queries that are not finite, and for all where there is no patch.
        """
        flat = queries.reshape(-1, 3).cpu().numpy()
        missing, threads = ~np.isfinite(flat), torch.get_num_threads()
        distance, index = self.tree.query(np.where(missing, 0.0, flat), workers=threads)
        distance = np.where(missing.any(1), np.inf, distance)
        index = np.where(np.isfinite(distance), index, 0)
        shape = queries.shape[:-1]
        return (
            torch.as_tensor(distance).to(queries).view(shape),
            torch.as_tensor(index, device=queries.device).view(shape),
        )
