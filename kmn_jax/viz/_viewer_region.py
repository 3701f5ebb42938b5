"""A box on a page that is moved, turned and stretched, and the flag that limits a search to it."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float

from kmn_jax.detection import Scene, into, placed
from kmn_jax.viz._viewer_scene import PageScene
from kmn_jax.viz._viewer_text import copy_box, small

_COLOR = (230, 0, 120)
_DIGITS = 7  # of numbers in the flag
_STRAIGHT = 1e-6  # of the entries of a rotation: less is none


class RegionBox:
    """A region of interest, at first around the foreground, in line with the scene's axes."""

    def __init__(self, server: Any, scene: PageScene, view: Scene) -> None:
        """Add its switch, its size and its flag to the panel, and its box to the scene, where it is hidden."""
        gui = server.gui
        self._scene, self._view = scene, view
        inside = placed(view.T_scene_camera, view.points[view.foreground].astype(np.float64))
        low, high = np.percentile(inside, [1, 99], axis=0)
        margin = 0.05 * float(np.linalg.norm(high - low))
        pose = np.eye(4)
        pose[:3, 3] = (low + high) / 2
        self._gizmo = server.scene.add_transform_controls(
            "/region", scale=0.25, line_width=4.0, depth_test=False, visible=False
        )
        self._folder = gui.add_folder("Region of interest", expand_by_default=False)
        with self._folder:
            self.shown = gui.add_checkbox("Box", False, hint="move and turn it by its arrows and arcs")
            self.size = gui.add_vector3(f"Size ({view.unit})", tuple(high - low + 2 * margin), min=(0.0, 0.0, 0.0))
            self._text = gui.add_html("", visible=False)
        self._box = server.scene.add_box("/region/box", color=_COLOR, opacity=0.15, cast_shadow=False)
        self._edges = server.scene.add_box("/region/edges", color=_COLOR, wireframe=True, cast_shadow=False)
        self.place(pose)
        for part in (self.shown, self.size, self._gizmo):
            part.on_update(lambda _: self._tell())

    @property
    def T_scene_box(self) -> Float[np.ndarray, "4 4"]:
        """The box's centre and axes."""
        return self._scene.in_scene(self._gizmo.wxyz, self._gizmo.position)

    @property
    def flag(self) -> str:
        """What `kmn detect` and `kmn view` take to search in this box only."""
        T, size = self.T_scene_box, np.array(self.size.value)
        if np.abs(T[:3, :3] - np.eye(3)).max() < _STRAIGHT:
            numbers = [*(T[:3, 3] - size / 2), *(T[:3, 3] + size / 2)]
        else:
            from scipy.spatial.transform import Rotation

            numbers = [*T[:3, 3], *size, *Rotation.from_matrix(T[:3, :3]).as_rotvec(degrees=True)]
        return "--roi " + ",".join(f"{number + 0.0:.{_DIGITS}g}" for number in numbers)

    def place(self, T_scene_box: Float[np.ndarray, "4 4"]) -> None:
        """Move the box."""
        self._gizmo.wxyz, self._gizmo.position = self._scene.on_page(T_scene_box)
        self._tell()

    def remove(self) -> None:
        """Take it off the panel; the scene's reset takes it out of there."""
        self._folder.remove()

    def _tell(self) -> None:
        """Draw the box as it is, and write its flag."""
        size = np.array(self.size.value)
        for box in (self._box, self._edges):
            box.dimensions = tuple(size / self._scene.size)
        self._gizmo.visible = self._text.visible = self.shown.value
        points = into(self.T_scene_box, placed(self._view.T_scene_camera, self._view.points.astype(np.float64)))
        count = int((np.abs(points) < size / 2).all(axis=1).sum())
        told = f"{count:,} of {len(points):,} points are inside. For kmn detect and kmn view:"
        self._text.content = small(told + copy_box(self.flag, 3))
