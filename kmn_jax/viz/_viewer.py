"""A page of estimates in the browser: the scan, the poses, what the network predicted, and a search at a picked point.

The page comes from a server on this machine and fetches nothing else.
"""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from kmn_jax.detection import Detections, Scene
from kmn_jax.errors import InputError
from kmn_jax.objects import Part
from kmn_jax.units import METRES, place_text
from kmn_jax.viz._mesh import PartMesh
from kmn_jax.viz._viewer_poses import PoseList, rank_of_same
from kmn_jax.viz._viewer_region import RegionBox
from kmn_jax.viz._viewer_scene import VIEWS, PageScene
from kmn_jax.viz._viewer_server import start_server, stop_server
from kmn_jax.viz._viewer_text import heading
from kmn_jax.web import address

_PICK, _CANCEL = "Pick a point to search at", "Cancel picking"
_LAYERS = {  # what can be switched: whether it is shown at first, and what it is
    "Scan": (True, "the measured points"),
    "Depth colours": (False, "colour the scan by depth: yellow is near"),
    "Surfaces": (True, "the object at its poses"),
    "Labels": (True, "rank and probability"),
    "Grasps": (True, "the first free grasp of each pose: fingers, and where they come from"),
    "Axes": (False, "the object's frames: x red, y green, z blue"),
    "Segmentation": (False, "points around the seeds: in the pose's colour if taken for the object, else dark"),
    "Keypoints": (False, "points taken for the object, in the colours of their likeliest keypoints"),
}


class Viewer:
    """A page that is being served, until `stop` or the end of a `with` block.

    `on_pick` is given a point of the scan that was clicked on, in the scene's frame; the poses that it returns are
    added to those that are shown. `on_next` returns the next scan and its result. An InputError of either is shown as a
    message. They run in a thread of the server, one at a time.
    """

    def __init__(
        self,
        view: Scene,
        part: Part,
        found: Detections,
        host: str = "127.0.0.1",
        port: int = 8080,
        on_pick: Callable[[np.ndarray], Detections] | None = None,
        on_next: Callable[[], tuple[Scene, Detections]] | None = None,
        mesh: PartMesh | None = None,
    ) -> None:
        """Start the server.

        Poses are shown by the part's mesh, see `part_mesh`, or by pieces of its surface if there is none. Port 0 takes
        any that is free. Raises InputError if the port is in use, the host is not this machine's, or
        viser is not installed.
        """
        self._part, self._on_pick, self._on_next = part.in_unit(found.unit), on_pick, on_next
        scale = METRES[part.unit] / METRES[found.unit]
        self._mesh = None if mesh is None else PartMesh(mesh.vertices * scale, mesh.triangles)
        self._view, self._first = view, found
        self.found = found  # what is shown
        self._lock = threading.RLock()  # of all that follows: callbacks come from several threads
        self._stopped = threading.Event()
        self._picking = "off"  # then "armed", then "searching"
        self._list: PoseList  # these two come with the scan
        self.region: RegionBox
        self._server, self._token = start_server(host, port)
        try:
            self._add_controls()
            with self._lock, self._server.atomic():
                self._fill(view, found)
        except BaseException:
            self.stop()
            raise

    @property
    def url(self) -> str:
        """Where the page is, with the token that it asks for."""
        return f"{address(self._server.get_host(), self._server.get_port())}/?token={self._token}"

    def is_shown(self, rank: int, layer: str | None = None) -> bool:
        """Tell whether the pose of a rank, from 1 on, is switched on; with a layer, whether that is too."""
        nodes = self._list.nodes[rank - 1]
        return bool(nodes.frame.visible) and (layer is None or bool(nodes.layers[layer].visible))

    @property
    def chosen(self) -> int | None:
        """The rank of the pose whose numbers are shown."""
        return self._list.chosen

    def show_scan(self, view: Scene, found: Detections) -> None:
        """Show another scan with its poses, in place of all that is shown; its unit must be that of the first one."""
        with self._lock, self._server.atomic():
            self._list.remove()
            self.region.remove()
            self._server.scene.reset()
            self._fill(view, found)

    def show(self, found: Detections) -> None:
        """Show other poses of the same part, in place of those that are shown."""
        with self._lock, self._server.atomic():
            self._list.remove()
            self._list_poses(found)

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
        self._back = gui.add_button("Remove picked poses", visible=False)
        self._back.on_click(lambda _: self.show(self._first))
        self._next = gui.add_button("Next scan", hint="of the same folder", visible=self._on_next is not None)
        self._next.on_click(self._go_on)
        self._views = gui.add_button_group(
            "View", tuple(VIEWS), hint="; ".join(": ".join(row) for row in VIEWS.items())
        )
        self._views.on_click(self._look)
        self._least = gui.add_slider("Least probability", 0.0, 1.0, 0.01, 0.0, hint="less probable poses are hidden")
        self._least.on_update(lambda _: self._show_from())
        self._layers = {}
        with gui.add_folder("Show"):
            for name, (shown, hint) in _LAYERS.items():
                self._layers[name] = gui.add_checkbox(name, shown, hint=hint)
                self._layers[name].on_update(lambda _: self._switch_layers())

    def _fill(self, view: Scene, found: Detections) -> None:
        """Add all that belongs to a scan."""
        self._view, self._first = view, found
        self._scene = PageScene(self._server, view, self._part, self._mesh)
        self.region = RegionBox(self._server, self._scene, view)
        self._list_poses(found)

    def _list_poses(self, found: Detections) -> None:
        """Add the poses of a result."""
        self.found = found
        self._list = PoseList(self._server, self._scene, self._part, found, float(self._least.value), self._on_pose)
        self._back.visible = found is not self._first
        self._layers["Grasps"].visible = any(pose.grasps for pose in found.poses)
        if found is self._first:
            self._scene.mark.visible = False
        self._header.content = self._heading()
        self._switch_layers()

    def _switch_layers(self) -> None:
        """Show and hide layers as their switches say."""
        with self._lock, self._server.atomic():
            on = {name: bool(switch.value) for name, switch in self._layers.items()}
            self._scene.show_scan(on["Scan"], on["Depth colours"])
            self._list.show_layers(on)

    def _show_from(self) -> None:
        with self._lock, self._server.atomic():
            self._list.show_from(float(self._least.value))

    def _look(self, event: Any) -> None:
        """Let the page that asked look from somewhere else."""
        position, up, angle = self._scene.eye(self._views.value)
        camera = event.client.camera
        with event.client.atomic():
            camera.up_direction, camera.position, camera.look_at, camera.fov = up, position, np.zeros(3), angle

    def _heading(self, doing: str = "") -> str:
        name = None if self._view.source is None else Path(self._view.source).name
        return heading(self.found, name, len(self._view.points), doing)

    def _on_pose(self, rank: int, event: Any) -> None:
        """Take a click on a pose for one on the scan before it if a point is to be picked, else choose the pose."""
        if self._picking == "armed":
            self._clicked(event)
        elif self._picking == "off":
            self._list.choose(rank)

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
        self._pick.disabled = self._next.disabled = state == "searching"
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
        with self._told(notify, "The search failed"):
            self._add(self._on_pick(point), notify)

    def _add(self, picked: Detections, notify: Callable[..., Any]) -> None:
        """Show picked poses beside the others."""
        if not picked.poses:
            notify("No pose there", picked.reason or "no pose was found", auto_close_seconds=8.0, color="orange")
            return
        new = []
        for pose in picked.poses:
            rank = rank_of_same(pose, self.found, self._part)
            if rank is None:
                new.append(pose)
            else:
                notify("Found again", f"That is pose {rank}.", auto_close_seconds=5.0, color="blue")
        if new:
            warnings = tuple(dict.fromkeys((*self.found.warnings, *picked.warnings)))
            self.show(replace(self.found, poses=(*self.found.poses, *new), reason=None, warnings=warnings))

    def _go_on(self, event: Any) -> None:
        """Search the next scan."""
        with self._lock:
            if self._picking == "searching" or self._on_next is None:
                return
            if self._picking == "armed":
                self._toggle_picking()
            self._set_picking("searching", "Searching the next scan ...")
        with self._told(event.client.add_notification, "There is no next scan"):
            self.show_scan(*self._on_next())

    @contextlib.contextmanager
    def _told(self, notify: Callable[..., Any], what: str) -> Iterator[None]:
        """Tell what goes wrong meanwhile, and let the page be used again."""
        try:
            yield
        except InputError as error:
            notify(what, str(error), color="red")
        except Exception as error:
            notify(what, f"{type(error).__name__}: {error}", color="red")
            raise  # to the server's log
        finally:
            with self._lock:
                self._set_picking("off")
