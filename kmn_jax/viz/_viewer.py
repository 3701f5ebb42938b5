"""A page of estimates in the browser: the scan, the poses, what the network predicted, and a search at a picked point.

The page comes from a server on this machine and fetches nothing else.
"""

from __future__ import annotations

import contextlib
import html
import threading
from collections.abc import Callable
from typing import Any

import numpy as np
from jaxtyping import Float

from kmn_jax.detection import Detection, Detections, Scene
from kmn_jax.errors import InputError
from kmn_jax.objects import Part
from kmn_jax.units import place_text
from kmn_jax.viz._legend import LIKELY, summary
from kmn_jax.viz._shading import as_bytes, distinct_colors
from kmn_jax.viz._viewer_scene import PageScene, PoseNodes
from kmn_jax.viz._viewer_server import start_server, stop_server
from kmn_jax.web import address

_PICK, _CANCEL = "Pick a point to search at", "Cancel picking"
_LAYERS = {  # what can be switched: whether it is shown at first, and what it is
    "Scan": (True, "the measured points"),
    "Depth colours": (False, "colour the scan by depth: yellow is near"),
    "Surfaces": (True, "the object at its poses"),
    "Labels": (True, "rank and probability"),
    "Axes": (False, "the object's frames: x red, y green, z blue"),
    "Segmentation": (False, "points around the seeds: in the pose's colour if taken for the object, else dark"),
    "Keypoints": (False, "points taken for the object, in the colours of their likeliest keypoints"),
}


class Viewer:
    """A page that is being served, until `stop` or the end of a `with` block.

    `on_pick` is given a point of the scan that was clicked on, in the scene's frame, and returns the poses that are
    shown from then on; an InputError of it is shown as a message. It runs in a thread of the server, one at a time.
    """

    def __init__(
        self,
        view: Scene,
        part: Part,
        found: Detections,
        host: str = "127.0.0.1",
        port: int = 8080,
        on_pick: Callable[[np.ndarray], Detections] | None = None,
    ) -> None:
        """Start the server.

        Port 0 takes any that is free. Raises InputError if the port is in use, the host is not this machine's, or
        viser is not installed.
        """
        self._part, self._first, self._on_pick = part.in_unit(found.unit), found, on_pick
        self.found = found  # what is shown
        self._num_points = len(view.points)
        self._lock = threading.RLock()  # of all that follows: callbacks come from several threads
        self._stopped = threading.Event()
        self._picking = "off"  # then "armed", then "searching"
        self._nodes: list[PoseNodes] = []
        self._list: Any = None
        self._server, self._token = start_server(host, port)
        try:
            self._scene = PageScene(self._server, view, self._part)
            self._add_controls()
            self.show(found)
        except BaseException:
            self.stop()
            raise

    @property
    def url(self) -> str:
        """Where the page is, with the token that it asks for."""
        return f"{address(self._server.get_host(), self._server.get_port())}/?token={self._token}"

    def is_shown(self, rank: int, layer: str | None = None) -> bool:
        """Tell whether the pose of a rank, from 1 on, is switched on; with a layer, whether that is too."""
        nodes = self._nodes[rank - 1]
        return bool(nodes.frame.visible) and (layer is None or bool(nodes.layers[layer].visible))

    def show(self, found: Detections) -> None:
        """Show other poses of the same part, in place of those that are shown."""
        with self._lock, self._server.atomic():
            for nodes in self._nodes:
                nodes.frame.remove()
            if self._list is not None:
                self._list.remove()
            self.found = found
            self._list = self._server.gui.add_folder("Poses", visible=bool(found.poses))
            with self._list:
                self._add_poses()
            self._back.visible = found is not self._first
            if found is self._first:
                self._scene.mark.visible = False
            self._header.content = self._heading()
            self._switch_layers()

    def wait(self) -> None:
        """Return when the page is stopped, or the user interrupts the program (Ctrl-C)."""
        with contextlib.suppress(KeyboardInterrupt):
            while not self._stopped.wait(1.0):  # some systems interrupt no longer wait
                pass

    def stop(self) -> None:
        """Stop the server; pages that are open lose their connection."""
        self._stopped.set()
        stop_server(self._server)

    def __enter__(self) -> Viewer:
        """Return itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Stop the server."""
        self.stop()

    def _add_controls(self) -> None:
        """Add what stays beside the scene, whatever is shown."""
        gui = self._server.gui
        gui.configure_theme(show_logo=False, show_share_button=False, control_width="large")
        gui.set_panel_label(self._part.name)
        gui.main_panel.dock_right()
        self._header = gui.add_html("")
        self._pick = gui.add_button(_PICK, hint="search around a point of the scan", visible=self._on_pick is not None)
        self._pick.on_click(lambda _: self._toggle_picking())
        self._back = gui.add_button("Show the first result again", visible=False)
        self._back.on_click(lambda _: self.show(self._first))
        self._layers = {}
        with gui.add_folder("Show"):
            for name, (shown, hint) in _LAYERS.items():
                self._layers[name] = gui.add_checkbox(name, shown, hint=hint)
                self._layers[name].on_update(lambda _: self._switch_layers())

    def _add_poses(self) -> None:
        """Add every pose to the scene, a switch and a line of facts for each, and buttons that switch several."""
        gui, poses = self._server.gui, self.found.poses
        choice = gui.add_button_group("Switch on", ("all", "likely", "none"), visible=len(poses) > 1)
        self._nodes, switches = [], []
        for rank, (pose, color) in enumerate(zip(poses, distinct_colors(len(poses)), strict=True), start=1):
            nodes = self._scene.add_pose(rank, pose, color, len(poses))
            switch = gui.add_checkbox(f"Pose {rank}", True, hint=_details(pose, self.found.unit))
            gui.add_html(_facts(pose, color))

            def update(_: Any, nodes: PoseNodes = nodes, switch: Any = switch) -> None:
                nodes.frame.visible = switch.value

            switch.on_update(update)
            self._nodes.append(nodes)
            switches.append(switch)

        def choose(_: Any) -> None:
            for switch, pose in zip(switches, poses, strict=True):
                switch.value = choice.value == "all" or (choice.value == "likely" and pose.probability >= LIKELY)

        choice.on_click(choose)

    def _switch_layers(self) -> None:
        """Show and hide layers as their switches say."""
        with self._lock, self._server.atomic():
            on = {name: bool(switch.value) for name, switch in self._layers.items()}
            self._scene.show_scan(on["Scan"], on["Depth colours"])
            for nodes in self._nodes:
                nodes.frame.show_axes = on["Axes"]
                for name, layer in nodes.layers.items():
                    layer.visible = on[name]

    def _heading(self, doing: str = "") -> str:
        found = self.found
        facts = f"scan of {self._num_points:,} points, searched in {found.timing.total:.2f} s"
        lines = [f"<b>{html.escape(summary(found))}</b>", facts]
        lines += [_warning(text) for text in found.warnings]
        if doing:
            lines.append(f"<b>{html.escape(doing)}</b>")
        return _small("<br>".join(lines))

    def _toggle_picking(self) -> None:
        with self._lock:
            if self._picking == "off":
                self._set_picking("armed", "Click on a point of the scan.")
                self._server.scene.on_click()(self._clicked)
            elif self._picking == "armed":
                self._server.scene.remove_click_callback(self._clicked)
                self._set_picking("off")

    def _set_picking(self, state: str, doing: str = "") -> None:
        self._picking = state
        self._pick.label = _CANCEL if state == "armed" else _PICK
        self._pick.disabled = state == "searching"
        self._header.content = self._heading(doing)

    def _clicked(self, event: Any) -> None:
        """Search at the point of the scan that was clicked on."""
        point = self._scene.picked(np.array(event.ray_origin), np.array(event.ray_direction))
        notify = event.client.add_notification
        with self._lock:
            if self._picking != "armed" or self._on_pick is None:
                return  # a second click
            if point is None:
                text = "Nothing was measured where you clicked: click on a point of the scan."
                notify("No point there", text, auto_close_seconds=5.0, color="orange")
                return
            self._server.scene.remove_click_callback(self._clicked)
            self._scene.show_mark(point)
            place = ", ".join(place_text(point, self.found.unit))
            self._set_picking("searching", f"Searching around ({place}) {self.found.unit} ...")
        try:
            self.show(self._on_pick(point))
        except InputError as error:
            notify("The search failed", str(error), color="red")
        except Exception as error:
            notify("The search failed", f"{type(error).__name__}: {error}", color="red")
            raise  # to the server's log
        finally:
            with self._lock:
                self._set_picking("off")


def _small(content: str) -> str:
    return f'<div style="font-size: 0.8rem; line-height: 1.35; padding: 0 0.75em 0.4em">{content}</div>'


def _warning(text: str) -> str:
    return f'<span style="color: #b34700">{html.escape(text)}</span>'


def _facts(pose: Detection, color: Float[np.ndarray, "3"]) -> str:
    red, green, blue = as_bytes(color)
    swatch = f'<span style="color: rgb({red}, {green}, {blue})">&#9632;</span>'
    numbers = f"probability {pose.probability:.2f}, {pose.visible_fraction:.0%} visible, {pose.num_inliers} inliers"
    return _small("<br>".join([f"{swatch} {numbers}", *(_warning(text) for text in pose.warnings)]))


def _details(pose: Detection, unit: str) -> str:
    place = ", ".join(place_text(pose.T_scene_object[:3, 3], unit))
    return (
        f"at ({place}) {unit}; explained {pose.explained:.0%}, violated {pose.violated:.0%}, occluded"
        f" {pose.occluded:.0%}, unknown {pose.unknown:.0%}; runner-up gap {pose.runner_up_gap:.2f}"
    )
