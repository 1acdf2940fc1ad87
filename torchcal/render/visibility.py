"""The hard z-buffer: which face every pixel's central ray meets first.

It answers with indices only; ranges and derivatives are then closed forms of the faces' planes
(``facets.py``), so nothing here needs to be differentiable.
"""

from jaxtyping import Float, Int
from torch import Tensor

from torchcal.geometry.projection import Projection
from torchcal.render import zbuffer
from torchcal.render.machine_code import machine_code_for


def visible_faces(
    vertices: Float[Tensor, "view vertex 3"], faces: Int[Tensor, "face 3"], projection: Projection
) -> Int[Tensor, "view h w"]:
    """The index of the face that each pixel's central ray meets first; -1 where there is none.

    Of faces at the same range, rounded to single precision, it is the one with the least index.
    On the CPU it is done in machine code where numba is installed, else by tensors: same answer.

    Args:
        vertices: Points (m) in the sensor's frame of each view.
        faces: Vertices of each triangle; both sides of a face are seen.
        projection: The sensor's optics.
    """
    module = machine_code_for(vertices, "zbuffer") or zbuffer
    return module.visible_faces(vertices.detach(), faces, projection)
