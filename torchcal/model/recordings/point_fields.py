"""The points of binary records: ``PointCloud2`` messages and PCD files name their fields."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchcal.errors import choices
from torchcal.model.recordings.layout import sound

_KINDS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
"""``sensor_msgs/PointField``"""


def cloud_points(message: Any) -> NDArray[np.float64]:
    """The points ``(h w 3)`` (m) of a ``PointCloud2``.

    Raises:
        ValueError: If it has no x, y and z, or fewer bytes than it says.
    """
    order = ">" if message.is_bigendian else "<"
    named = {field.name: field for field in message.fields if field.datatype in _KINDS}
    if not {"x", "y", "z"} <= named.keys():
        raise ValueError(f"a cloud with the fields {', '.join(named)}; expected x, y and z")
    kind = np.dtype(
        {
            "names": ["x", "y", "z"],
            "formats": [order + _KINDS[named[name].datatype] for name in "xyz"],
            "offsets": [named[name].offset for name in "xyz"],
            "itemsize": message.point_step,
        }
    )
    rows = np.asarray(message.data, np.uint8)[: message.height * message.row_step]
    rows = rows.reshape(message.height, message.row_step)
    bare = np.ascontiguousarray(rows[:, : message.width * message.point_step])
    return xyz(bare.view(kind))


def xyz(records: np.ndarray) -> NDArray[np.float64]:
    """The coordinates ``(*batch 3)`` of records with the fields x, y and z; NaN: not measured.

    Raises:
        ValueError: If a field is missing.
    """
    names = records.dtype.names or ()
    for name in "xyz":
        if name not in names:
            raise ValueError(f"no field {name}; expected x, y and z, found {choices(names)}")
    return sound(np.stack([records[name].astype(np.float64) for name in "xyz"], -1))
