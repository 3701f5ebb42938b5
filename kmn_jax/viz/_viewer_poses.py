"""The poses on a page: a switch and a line for each, a filter by probability, and the numbers of the one chosen."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from kmn_jax.detection import Detection, Detections, placed, warnings_once
from kmn_jax.objects import Part
from kmn_jax.viz._legend import ACCEPTED
from kmn_jax.viz._shading import distinct_colors
from kmn_jax.viz._viewer_scene import PageScene, PoseNodes
from kmn_jax.viz._viewer_text import details, facts

_NONE = "none"
_SAME = 0.02  # of the diameter: poses whose points differ by less on average are one


class PoseList:
    """The poses of a result, in space and in the panel, until `remove`."""

    def __init__(
        self,
        server: Any,
        scene: PageScene,
        part: Part,
        found: Detections,
        least: float,
        on_click: Callable[[int, Any], None],
    ) -> None:
        """Add them; those that are less probable than `least` are hidden; `on_click` gets ranks and clicks on them."""
        self._gui, self._part, self._found, self._least = server.gui, part, found, least
        self.nodes: list[PoseNodes] = []
        self._switches: list[Any] = []
        self._lines: list[Any] = []
        self.chosen: int | None = None  # the rank of the pose whose numbers are shown
        poses = found.poses
        self._folder = self._gui.add_folder("Poses", visible=bool(poses))
        with self._folder:
            ranks = (_NONE, *(str(rank) for rank in range(1, len(poses) + 1)))
            self._choice = self._gui.add_dropdown("Numbers of pose", ranks, hint="or click on a pose")
            self._choice.on_update(lambda _: self._show_numbers())
            self._numbers = self._gui.add_html("", visible=False)
            several = self._gui.add_button_group("Switch on", ("all", "found", "none"), visible=len(poses) > 1)
            several.on_click(lambda _: self._switch_several(several.value))
            _, own = warnings_once(found)
            colors = distinct_colors(len(poses))
            for rank, (pose, color, warnings) in enumerate(zip(poses, colors, own, strict=True), start=1):
                nodes = scene.add_pose(rank, pose, color, len(poses))
                nodes.layers["Surfaces"].on_click(lambda event, rank=rank: on_click(rank, event))
                switch = self._gui.add_checkbox(f"Pose {rank}", True)
                switch.on_update(lambda _: self._apply())
                self.nodes.append(nodes)
                self._switches.append(switch)
                self._lines.append(self._gui.add_html(facts(pose, color, warnings)))
        self._apply()

    def choose(self, rank: int | None) -> None:
        """Show the numbers of a pose, or of none."""
        self._choice.value = _NONE if rank is None else str(rank)
        self._show_numbers()

    def show_from(self, least: float) -> None:
        """Hide the poses that are less probable."""
        self._least = least
        self._apply()

    def show_layers(self, on: Mapping[str, bool]) -> None:
        """Show and hide what is below the poses."""
        for nodes in self.nodes:
            nodes.frame.show_axes = on["Axes"]
            for name, layer in nodes.layers.items():
                layer.visible = on[name]

    def remove(self) -> None:
        """Take them off the page."""
        for nodes in self.nodes:
            nodes.frame.remove()
        self._folder.remove()

    def _apply(self) -> None:
        rows = zip(self._found.poses, self.nodes, self._switches, self._lines, strict=True)
        for pose, nodes, switch, line in rows:
            passes = pose.probability >= self._least
            nodes.frame.visible = passes and switch.value
            switch.visible = line.visible = passes

    def _switch_several(self, which: str) -> None:
        for switch, pose in zip(self._switches, self._found.poses, strict=True):
            switch.value = which == "all" or (which == "found" and pose.probability >= ACCEPTED)

    def _show_numbers(self) -> None:
        value = self._choice.value
        self.chosen = None if value == _NONE else int(value)
        if self.chosen is not None:
            self._numbers.content = details(self._found.poses[self.chosen - 1], self._part.name, self._found.unit)
        self._numbers.visible = self.chosen is not None


def rank_of_same(pose: Detection, found: Detections, part: Part) -> int | None:
    """Return the rank of the pose of a result that is the same as another one, None if there is none."""
    points = part.points[:200]
    there = placed(pose.T_scene_object, points)
    for rank, one in enumerate(found.poses, start=1):
        away = np.linalg.norm(placed(one.T_scene_object, points) - there, axis=1).mean()
        if away < _SAME * part.diameter:
            return rank
    return None
