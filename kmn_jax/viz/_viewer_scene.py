"""What a page shows in space: the scan, and for every pose the part, a label, and the points of its crop.

It is shown in a frame of its own: the sensor's directions (x right, y down, z forward), the scan's centre as origin and
the scan's size as unit of length.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

from kmn_jax.detection import Detection, Scene, into, placed
from kmn_jax.objects import Part
from kmn_jax.viz._legend import ACCEPTED, NOT_THE_PART, center_of
from kmn_jax.viz._mesh import PartMesh
from kmn_jax.viz._shading import (
    as_bytes,
    distinct_colors,
    image_places,
    shaded,
    spacing,
    surface_hexagons,
    values_at,
)

VIEWS = {  # from which a page can look: what that is
    "camera": "from the sensor",
    "front": "from the side that is below in the sensor's image",
    "top": "straight along the sensor's axis",
}
_FIELD_OF_VIEW = np.radians(40)
_FRONT = np.array([0.0, 1.0, -0.3])  # towards the eye, from a little above
_MOST_SCAN_POINTS = 300_000  # that are sent
_MOST_HEXAGONS = 60_000  # of all poses' surfaces
_REACH = np.radians(1.5)  # from a click, in which the nearest point of the scan has to be
_SAME_RAY = np.radians(0.3)  # points so near to the clicked ray hide each other
# Of the diameter: so much nearer to the sensor are surfaces and points of crops drawn, to be seen before the scan.
_SURFACE_LIFT, _CROP_LIFT = 0.006, 0.012
_FINGERS = 0.35  # of the diameter, their length where a grasp is drawn, which knows its width only
_GRASP = (1.0, 0.0, 0.9)
_PALE = 0.6  # share of white in the colours of unlikely poses


@dataclass(frozen=True)
class PoseNodes:
    """Viser's handles of a pose: a node that holds its frame, and by layer what is below it."""

    frame: Any
    layers: dict[str, Any]


class PageScene:
    """The scan and the poses on the page of a viser server."""

    def __init__(self, server: Any, view: Scene, part: Part, mesh: PartMesh | None = None) -> None:
        """Add the scan, and set the camera on the sensor's side, as near as the scan fills the page.

        Poses are shown by the mesh of the part, in its frame and the scan's unit, or else by pieces of its surface.
        """
        from matplotlib import colormaps
        from matplotlib.colors import Normalize

        self._scene, self._view, self._part = server.scene, view, part.centred()
        self._origin = part.origin
        self._mesh = None if mesh is None else PartMesh(mesh.vertices - part.origin, mesh.triangles)
        self._T_view_scene = np.linalg.inv(view.T_scene_camera)
        low, high = np.percentile(view.points, [1, 99], axis=0).astype(np.float64)
        self._center = (low + high) / 2
        self.size = max(float(np.linalg.norm(high - low)), 0.5 * part.diameter)
        self._points = self._on_page(view.points).astype(np.float32)
        self._scene.set_up_direction("-y")
        towards = -_unit(self._center)
        width, height, depth = (high - low) / self.size
        distance = depth / 2 + 0.55 * max(height, width / 1.3) / np.tan(_FIELD_OF_VIEW / 2)
        self._distance = max(distance, 0.1)
        server.initial_camera.position = towards * self._distance
        server.initial_camera.look_at = np.zeros(3)
        server.initial_camera.fov = _FIELD_OF_VIEW
        self._add_lights()
        rows = np.arange(len(view.points))
        if len(rows) > _MOST_SCAN_POINTS:
            rows = np.random.default_rng(0).choice(rows, _MOST_SCAN_POINTS, replace=False)
        points = view.points[rows]
        scan = shaded(view.depth, view.camera, part.diameter)
        brightness = values_at(scan.brightness, image_places(view.camera, points) / scan.step)
        shade = np.where(np.isnan(brightness), 0.7, brightness)[:, None]
        colors = colormaps["viridis_r"](Normalize(*np.percentile(points[:, 2], [0.5, 99.5]))(points[:, 2]))
        self._dot = float(np.clip(1.3 * spacing(self._points[rows]), 6.5e-4, 0.065))
        self._grey = as_bytes(np.repeat(0.25 + 0.6 * shade, 3, axis=1))
        self._by_depth = as_bytes(colors[:, :3] * (0.4 + 0.6 * shade))
        self._scan = self._add_points("/scan", self._points[rows], self._grey)
        radius = 0.04 * part.diameter / self.size
        self.mark = self._scene.add_icosphere("/picked", radius=radius, color=(230, 0, 120), visible=False)

    def show_scan(self, shown: bool, by_depth: bool) -> None:
        """Show or hide the scan, in the colours of depth or in grey."""
        self._scan.visible = shown
        self._scan.colors = self._by_depth if by_depth else self._grey

    def add_pose(self, rank: int, pose: Detection, color: Float[np.ndarray, "3"], count: int) -> PoseNodes:
        """Add one of `count` poses: Surfaces, Labels, Segmentation, Keypoints and, if a grasp is free, Grasps."""
        from viser.transforms import SO3

        scene, part, name = self._scene, self._part, f"/poses/{rank}"
        T = self._T_view_scene @ pose.T_scene_object
        T[:3, 3] += T[:3, :3] @ self._origin
        frame = scene.add_frame(
            name,
            show_axes=False,
            axes_length=0.5 * part.diameter / self.size,
            axes_radius=0.012 * part.diameter / self.size,
            wxyz=SO3.from_matrix(T[:3, :3]).wxyz,
            position=self._on_page(T[:3, 3]),
        )
        accepted = pose.probability >= ACCEPTED
        vertices, triangles = self._mesh or _hexagon_mesh(part, int(np.clip(_MOST_HEXAGONS // count, 400, 3000)))
        surface = scene.add_mesh_simple(
            f"{name}/surface",
            (vertices / self.size).astype(np.float32),
            triangles.astype(np.uint32),
            color=tuple(int(value) for value in as_bytes(color if accepted else _PALE + (1 - _PALE) * color)),
            position=-_SURFACE_LIFT * part.diameter / self.size * _unit(T[:3, 3]) @ T[:3, :3],
            flat_shading=self._mesh is not None,
            side="double",
            cast_shadow=False,
            receive_shadow=False,
        )
        label = scene.add_label(
            f"{name}/label",
            f"{rank}: {pose.probability:.2f}",
            position=center_of(part) / self.size,
            anchor="center-center",
        )
        prediction = pose.prediction
        on = prediction.on_object
        seen = placed(self._T_view_scene, prediction.points.astype(np.float64))
        seen -= _CROP_LIFT * part.diameter * _unit(seen)
        points = into(T, seen) / self.size
        colors = np.where(on[:, None], color, NOT_THE_PART)
        keypoints = distinct_colors(part.num_keypoints)[prediction.keypoint[on]]
        layers = {
            "Surfaces": surface,
            "Labels": label,
            "Segmentation": self._add_points(f"{name}/segmentation", points, as_bytes(colors)),
            "Keypoints": self._add_points(f"{name}/keypoints", points[on], as_bytes(keypoints)),
        }
        if pose.grasps:
            first = pose.grasps[0]
            ends = placed(self._T_view_scene @ first.T_scene_grasp, _fork(first.width, _FINGERS * part.diameter))
            layers["Grasps"] = scene.add_line_segments(
                f"{name}/grasp",
                (into(T, ends) / self.size).astype(np.float32),
                as_bytes(np.array(_GRASP)),
                thickness=4.0,
                thickness_units="screen",
            )
        return PoseNodes(frame, layers)

    def picked(
        self, origin: Float[np.ndarray, "3"], direction: Float[np.ndarray, "3"]
    ) -> Float[np.ndarray, "3"] | None:
        """Return the point of the scan that a ray of the page meets, in the scene's frame; None if it meets none."""
        row = nearest_to_ray(self._points, origin, direction)
        if row is None:
            return None
        return placed(self._view.T_scene_camera, self._view.points[row].astype(np.float64))

    def eye(self, view: str) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"], float]:
        """Return where one of the `VIEWS` looks from, towards the origin, what is up there, and its vertical angle."""
        upright = np.array([0.0, -1.0, 0.0])
        if view == "camera":
            camera = self._view.camera
            angle = 2 * np.arctan(camera.height / 2 / camera.fy)
            return -self._center / self.size, upright, float(np.clip(angle, 0.05, 2.5))
        if view == "front":
            return self._distance * _unit(_FRONT), np.array([0.0, 0.0, -1.0]), float(_FIELD_OF_VIEW)
        return np.array([0.0, 0.0, -self._distance]), upright, float(_FIELD_OF_VIEW)

    def in_scene(self, wxyz: Float[np.ndarray, "4"], position: Float[np.ndarray, "3"]) -> Float[np.ndarray, "4 4"]:
        """Return a frame of the page in the scene's frame and unit."""
        from viser.transforms import SO3

        T_view_frame = np.eye(4)
        T_view_frame[:3, :3] = SO3(np.asarray(wxyz)).as_matrix()
        T_view_frame[:3, 3] = np.asarray(position) * self.size + self._center
        return self._view.T_scene_camera @ T_view_frame

    def on_page(self, T_scene_frame: Float[np.ndarray, "4 4"]) -> tuple[Any, Float[np.ndarray, "3"]]:
        """Return rotation (wxyz) and position of a frame of the scene on the page."""
        from viser.transforms import SO3

        T = self._T_view_scene @ T_scene_frame
        return SO3.from_matrix(T[:3, :3]).wxyz, self._on_page(T[:3, 3])

    def show_mark(self, point: Float[np.ndarray, "3"]) -> None:
        """Mark a point of the scene's frame, in place of the one that was marked before."""
        self.mark.position = self._on_page(placed(self._T_view_scene, point))
        self.mark.visible = True

    def _add_lights(self) -> None:
        """Light the scene from the sensor's side; the light of a room, which viser has, takes long without a GPU."""
        self._scene.configure_environment_map(None)
        self._scene.configure_default_lights(False)
        self._scene.add_light_ambient("/lights/ambient", intensity=1.2)
        for name, position, intensity in (("front", (-0.4, -0.5, -0.8), 2.4), ("back", (0.4, 0.5, 0.8), 1.0)):
            self._scene.add_light_directional(f"/lights/{name}", position=position, intensity=intensity)

    def _add_points(self, name: str, places: Float[np.ndarray, "n 3"], colors: UInt8[np.ndarray, "n 3"]) -> Any:
        return self._scene.add_point_cloud(
            name,
            places.astype(np.float32),
            colors,
            point_size=self._dot,
            point_shape="circle",
            point_shading="flat",
            precision="float32",
        )

    def _on_page(self, points: Float[np.ndarray, "*s 3"]) -> Float[np.ndarray, "*s 3"]:
        """Return points of the view's frame in the page's."""
        return (points - self._center) / self.size


def _hexagon_mesh(part: Part, most: int) -> PartMesh:
    """Return hexagons that cover a part of which there is no mesh."""
    _, corners = surface_hexagons(part, most)
    fan = np.array([[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 5]])
    return PartMesh(corners.reshape(-1, 3), (6 * np.arange(len(corners))[:, None, None] + fan).reshape(-1, 3))


def _fork(width: float, length: float) -> Float[np.ndarray, "4 2 3"]:
    """Return lines of a gripper in its frame: two fingers, tips beside the origin, and where it comes from."""
    left, right = np.array([-width / 2, 0, 0]), np.array([width / 2, 0, 0])
    back = np.array([0, 0, -length])
    return np.array([[left, left + back], [right, right + back], [left + back, right + back], [back, 2 * back]])


def nearest_to_ray(
    points: Float[np.ndarray, "n 3"], origin: Float[np.ndarray, "3"], direction: Float[np.ndarray, "3"]
) -> int | None:
    """Return the row of the point that a ray meets first, None if it passes all at more than 1.5 degrees."""
    offsets = points - origin
    along = offsets @ (direction / np.linalg.norm(direction))
    aside = np.sqrt(np.maximum((offsets**2).sum(axis=1) - along**2, 0))
    angles = np.where(along > 0, np.arctan2(aside, along), np.inf)
    nearest = float(angles.min())
    if nearest > _REACH:
        return None
    return int(np.where(angles <= nearest + _SAME_RAY, along, np.inf).argmin())


def _unit(vectors: Float[np.ndarray, "*s 3"]) -> Float[np.ndarray, "*s 3"]:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-12)
