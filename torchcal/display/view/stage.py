"""The three-dimensional part of the view, drawn by viser."""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import trimesh
import viser
from torch import Tensor
from viser.transforms import SO3

from torchcal.calibrate.kept_result import FramePlace, Result
from torchcal.display.arrays import as_array
from torchcal.display.view.objects import ShownObject, for_browser, shown_objects
from torchcal.display.view.settings import Settings
from torchcal.display.view.shapes import Points, ellipsoid, frustum
from torchcal.geometry.projection import Projection

MODEL, POINTS, SENSOR = "/model", "/measurement", "/sensor"

FRUSTUM_LENGTH = 0.4
"""m"""
POINT_SIZE = 0.012
"""m"""
SENSOR_COLOUR = (20, 20, 20)
THINNEST = 1e-6
"""m: an axis that is known exactly still needs a size to be drawn."""

Clicked = Callable[[str], None]
"""Told the name of an object."""


@dataclass(kw_only=True, slots=True)
class Stage:
    """Draws a result into a scene.

    Args:
        scene: viser's.
        clicked: Told which object a person clicks.
    """

    scene: viser.SceneApi
    clicked: Clicked
    _objects: list[viser.SceneNodeHandle] = field(default_factory=list)
    _links: dict[str, viser.SceneNodeHandle] = field(default_factory=dict)
    _parents: dict[str, viser.SceneNodeHandle] = field(default_factory=dict)
    _points: viser.PointCloudHandle | None = None

    def open(self, result: Result) -> None:
        """Draws what never changes: the robot's links, the sensor's field of view."""
        self.scene.set_up_direction("+z")
        self.scene.configure_default_lights(cast_shadow=False)
        for name in (MODEL, POINTS, SENSOR):
            self._parents[name] = self.scene.add_frame(name, show_axes=False)
        for index, (link, mesh) in enumerate(result.link_meshes.items()):
            handle = self._own_colours(f"{MODEL}/links/{index}", mesh)
            self._clickable(handle, f"robot/{link}")
            self._links[link] = handle
        self._draw_frustum(result.projection)

    def draw_objects(self, result: Result) -> None:
        """Draws the world as the decisions leave it."""
        for handle in self._objects:
            handle.remove()
        self._objects = [
            self._object(f"{MODEL}/objects/{index}", item)
            for index, item in enumerate(shown_objects(result.transaction))
        ]

    def place(self, frame: FramePlace) -> None:
        """Puts the robot and the sensor where they were."""
        for link, T in frame.Ts_world_link.items():
            _put(self._links[link], as_array(T))
        T_world_sensor = as_array(frame.T_world_sensor)
        for name in (POINTS, SENSOR):
            _put(self._parents[name], T_world_sensor)
        self._draw_ellipsoid(frame.pose_covariance)

    def draw_points(self, points: Points) -> None:
        """Draws points (sensor frame)."""
        self._points = self.scene.add_point_cloud(
            f"{POINTS}/points",
            points.positions,
            points.colours,
            point_size=POINT_SIZE,
            point_shading="flat",
            precision="float32",
        )

    def recolour(self, colours: np.ndarray) -> None:
        """Gives the same points other colours."""
        assert self._points is not None, "there are points"
        self._points.colors = colours

    def show(self, settings: Settings) -> None:
        """Shows what is switched on."""
        self._parents[MODEL].visible = settings.shows_model
        self._parents[POINTS].visible = settings.shows_points

    def _object(self, node: str, item: ShownObject) -> viser.SceneNodeHandle:
        if item.paint is None:
            handle = self._own_colours(node, item.mesh)
        else:
            handle = self.scene.add_mesh_simple(
                node,
                np.asarray(item.mesh.vertices, np.float32),
                np.asarray(item.mesh.faces, np.uint32),
                color=item.paint,
                opacity=None if item.opacity == 1.0 else item.opacity,
                flat_shading=True,
                side="double",
                cast_shadow=False,
            )
        _put(handle, as_array(item.T_world_object))
        self._clickable(handle, item.name)
        return handle

    def _own_colours(self, node: str, mesh: trimesh.Trimesh) -> viser.GlbHandle:
        return self.scene.add_mesh_trimesh(node, for_browser(mesh), cast_shadow=False)

    def _clickable(self, handle: viser.GlbHandle | viser.MeshHandle, name: str) -> None:
        handle.on_click(lambda _: self.clicked(name))

    def _draw_frustum(self, projection: Projection) -> None:
        self.scene.add_line_segments(
            f"{SENSOR}/frustum",
            frustum(projection, FRUSTUM_LENGTH),
            SENSOR_COLOUR,
            thickness=2.0,
            thickness_units="screen",
        )

    def _draw_ellipsoid(self, pose_covariance: Tensor) -> None:
        """True to size: of a good calibration it is smaller than a pixel."""
        shape = ellipsoid(pose_covariance)
        a, b, c = (max(float(radius), THINNEST) for radius in shape.radii)
        self.scene.add_icosphere(
            f"{SENSOR}/ellipsoid",
            color=SENSOR_COLOUR,
            opacity=0.25,
            scale=(a, b, c),
            wxyz=SO3.from_matrix(shape.R_sensor_ellipsoid).wxyz,
            cast_shadow=False,
        )


def _put(handle: viser.SceneNodeHandle, T: np.ndarray) -> None:
    """Places a node in its parent."""
    handle.wxyz = SO3.from_matrix(T[:3, :3]).wxyz
    handle.position = T[:3, 3]
