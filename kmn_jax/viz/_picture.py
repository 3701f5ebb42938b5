"""The picture of a result: the scan, what was taken for the part, its keypoints and its poses, as the sensor sees them.

It is drawn without a display.
"""

from __future__ import annotations

import io
import textwrap
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from kmn_jax.detection import Detection, Detections, Scene, placed
from kmn_jax.errors import InputError
from kmn_jax.extras import install_command
from kmn_jax.files import write_whole
from kmn_jax.geometry import Camera
from kmn_jax.objects import Part
from kmn_jax.viz._legend import ACCEPTED, NOT_THE_PART, UNEXPLAINED, center_of, draw_list, draw_part, summary
from kmn_jax.viz._raster import Canvas
from kmn_jax.viz._shading import (
    as_bytes,
    brightness,
    distinct_colors,
    image_places,
    shaded,
    spacing,
    surface_hexagons,
    values_at,
)
from kmn_jax.viz._truth import TRUTH_COLORS, truth_codes

_CANVAS_SIDE = 960  # pixels of the panel of poses
_PANEL = 9.6  # inches of its longer side
_SMALL = 1 / 3  # of it are the others, which stand beside it
_SIDE, _HEIGHT = 3.6, 8.4  # inches that the list of poses needs
_WHOLE, _CLOSEST = 0.8, 0.05  # of the scan's width: what fills more is not zoomed in on, and nothing closer than
_MOST_CROP_POINTS = 200_000
_IN_FRONT = 0.05  # of the diameter: what was measured that much nearer hides a pose
_DOTS = 20_000  # of the foreground that no pose explains
_TITLE = 10  # points, of the small panels
_DASH = 7  # pixels of the outlines of unlikely poses


def check_picture(path: str | Path) -> None:
    """Raise InputError for a path that is not that of a PNG file."""
    if Path(path).suffix.lower() != ".png":
        raise InputError(f"{path} cannot be written: pictures are PNG files, name one that ends with .png")


def check_drawing() -> None:
    """Raise InputError if matplotlib is not installed."""
    if find_spec("matplotlib") is None:
        raise InputError(f"pictures need packages that are not installed: {install_command('matplotlib')}")


def save_picture(
    path: str | Path,
    view: Scene,
    part: Part,
    found: Detections,
    truth: Sequence[Float[np.ndarray, "4 4"]] | None = None,
) -> None:
    """Write a PNG of the poses, beside which stand, smaller, the scan, the segmentation and the keypoints.

    With `truth`, the true poses `T_scene_object` of all copies, the segmentation is coded as by `truth_codes`. A result
    without poses makes a picture that says why. Raises InputError if the path is no PNG file's or cannot be written
    to, or if matplotlib is not installed.
    """
    check_picture(path)
    check_drawing()
    from matplotlib.figure import Figure

    part = part.in_unit(found.unit)
    panels = _Panels(view, part, found)
    aspect = float(np.clip(panels.canvas.width / panels.canvas.height, 0.6, 2.0))
    width, height = _PANEL * min(1.0, aspect), _PANEL * min(1.0, 1 / aspect)
    beside = max(_SMALL * width, 0.9 * _SIDE)
    size = width + beside + _SIDE + 0.6, max(height, _HEIGHT) + 1.2
    figure = Figure(figsize=size, dpi=100, layout="constrained")
    figure.get_layout_engine().set(wspace=0.02, hspace=0.03)
    figure.suptitle(f"{part.name}: {summary(found)}", fontsize=15, parse_math=False)
    grid = figure.add_gridspec(3, 3, width_ratios=(width, beside, _SIDE))
    panels.draw_poses(figure.add_subplot(grid[:, 0]))
    panels.draw_scan(figure.add_subplot(grid[0, 1]))
    if truth is None:
        panels.draw_segmentation(figure.add_subplot(grid[1, 1]))
    else:
        panels.draw_truth(figure.add_subplot(grid[1, 1]), truth)
    panels.draw_keypoints(figure.add_subplot(grid[2, 1]))
    side = grid[:, 2].subgridspec(2, 2, height_ratios=(1, 3.2))
    draw_part(figure.add_subplot(side[0, 0]), part, (0.5, 0.6, -0.62), "The object's keypoints")
    draw_part(figure.add_subplot(side[0, 1]), part, (-0.5, -0.6, 0.62), "from behind")
    draw_list(figure.add_subplot(side[1, :]), found)
    content = io.BytesIO()
    figure.savefig(content, format="png")
    write_whole(path, content.getvalue())


class _Panels:
    """What the panels share: the shaded scan, all crops' points, and the part of the image that is shown."""

    def __init__(self, view: Scene, part: Part, found: Detections) -> None:
        self.view, self.part, self.found = view, part, found
        self.T_view_scene = np.linalg.inv(view.T_scene_camera)
        self.pose_colors = distinct_colors(len(found.poses))
        self.surface = surface_hexagons(part)
        self.scan = shaded(view.depth, view.camera, part.diameter)
        crops = [pose.prediction for pose in found.poses]
        self.crop_of = np.repeat(np.arange(len(crops)), [len(crop.points) for crop in crops])
        self.on_object = np.concatenate([np.zeros(0, dtype=bool), *(crop.on_object for crop in crops)])
        self.keypoint = np.concatenate([np.zeros(0, dtype=int), *(crop.keypoint for crop in crops)])
        self.points = self._in_view(np.concatenate([np.zeros((0, 3)), *(crop.points for crop in crops)]))
        copies = [self._in_view(placed(pose.T_scene_object, part.points)) for pose in found.poses]
        self.grey = 0.55 + 0.38 * self.scan.brightness[..., None]
        self.box = _measured_box(view)
        self.canvas = _zoomed(view.camera, self.box, image_places(view.camera, np.concatenate([self.points, *copies])))

    def _in_view(self, points: Float[np.ndarray, "*s 3"]) -> Float[np.ndarray, "*s 3"]:
        return placed(self.T_view_scene, points.astype(np.float64))

    def draw_scan(self, axis: Any) -> None:
        from matplotlib import colormaps
        from matplotlib.cm import ScalarMappable
        from matplotlib.colors import Normalize
        from matplotlib.patches import Rectangle

        measured = self.scan.depth[self.scan.depth > 0]
        norm = Normalize(*np.percentile(measured if measured.size else [0.0, 1.0], [0.5, 99.5]))
        cmap = colormaps["viridis_r"]
        self._draw_scan(axis, cmap(norm(self.scan.depth))[..., :3] * (0.5 + 0.5 * self.scan.brightness[..., None]))
        left, right, bottom, top = self.box
        axis.set(xlim=(left, right), ylim=(bottom, top))
        bar = axis.figure.colorbar(ScalarMappable(norm, cmap), ax=axis, fraction=0.03, pad=0.01)
        bar.ax.invert_yaxis()  # near is above, as bright as in the panel
        title = f"Scan: depth in {self.found.unit}"
        left, right, bottom, top = self.canvas.extent
        if right - left < 0.97 * (self.box[1] - self.box[0]):
            axis.add_patch(Rectangle((left, top), right - left, bottom - top, fill=False, color="black", ls="--"))
            title += "; framed: what others show"
        axis.set_title(title, fontsize=_TITLE)

    def draw_segmentation(self, axis: Any) -> None:
        self._draw_scan(axis, self.grey)
        colors = np.where(self.on_object[:, None], self.pose_colors[self.crop_of], NOT_THE_PART)
        self._draw_points(axis, colors, self.on_object)
        share = self.on_object.sum() / max(1, len(self.on_object))
        axis.set_title(f"Segmentation: {share:.0%} of points on a copy (coloured)", fontsize=_TITLE)

    def draw_truth(self, axis: Any, truth: Sequence[Float[np.ndarray, "4 4"]]) -> None:
        from matplotlib.patches import Patch

        self._draw_scan(axis, 0.18 + 0.37 * self.scan.brightness[..., None], background=0.10)
        codes = [truth_codes(self.part, pose, truth) for pose in self.found.poses]
        code = np.concatenate([np.zeros(0, dtype=int), *codes])
        # Where crops overlap, faults are shown rather than what is right.
        self._draw_points(axis, np.array(list(TRUTH_COLORS.values()))[code], np.array([0, 4, 3, 2, 1])[code])
        shares = np.bincount(code, minlength=5) / max(1, len(code))
        patches = [
            Patch(facecolor=color, edgecolor="black", lw=0.5, label=f"{share:4.0%} {name}")
            for (name, color), share in zip(TRUTH_COLORS.items(), shares, strict=True)
        ]
        axis.figure.legend(handles=patches, loc="outside lower center", ncols=5, fontsize=10, frameon=False)
        axis.set_title("Points of the crops against the truth", fontsize=_TITLE)

    def draw_keypoints(self, axis: Any) -> None:
        self._draw_scan(axis, self.grey)
        colors = distinct_colors(self.part.num_keypoints)[self.keypoint]
        self._draw_points(axis, colors, np.where(self.on_object, 0, -1))
        axis.set_title("Likeliest keypoint of points on a copy", fontsize=_TITLE)

    def draw_poses(self, axis: Any) -> None:
        import matplotlib.patheffects as effects

        self._draw_scan(axis, self.grey)
        image = np.zeros((self.canvas.height, self.canvas.width, 4))
        nearest = np.full(image.shape[:2], np.inf)
        ranked = enumerate(zip(self.found.poses, self.pose_colors, strict=True), start=1)
        # Likely poses come last: they are in front of all others, whatever their depth.
        for rank, (pose, color) in sorted(ranked, key=lambda row: row[1][0].probability >= ACCEPTED):
            accepted = pose.probability >= ACCEPTED
            self._paint(pose, color, image, nearest)
            center = self._in_view(placed(pose.T_scene_object, center_of(self.part)))
            axis.annotate(
                f"{rank}: {pose.probability:.2f}",
                image_places(self.canvas.camera, center),
                ha="center",
                va="center",
                fontsize=10 if accepted else 8.5,
                weight="bold" if accepted else "normal",
                color="black" if accepted else "0.25",
                path_effects=[effects.withStroke(linewidth=2.5, foreground="white")],
                annotation_clip=True,
            )
        self._draw_unexplained(axis)
        axis.imshow(as_bytes(image), extent=self.canvas.extent, interpolation="nearest")
        title = f"Poses with rank and probability; dashed below {ACCEPTED}"
        if self.found.unexplained is not None:
            title += f"; {self.found.unexplained:.0%} on none (brown)"
        axis.set_title(title)
        if not self.found.poses:
            self._tell_why_not(axis)

    def _draw_unexplained(self, axis: Any) -> None:
        """Dot the foreground that lies on no pose that counts as found."""
        if self.found.unexplained_points is not None:
            points = self._in_view(self.found.unexplained_points)[:: 1 + len(self.found.unexplained_points) // _DOTS]
            axis.scatter(*image_places(self.view.camera, points).T, s=4, c=[UNEXPLAINED], marker="s", lw=0)

    def _paint(
        self,
        pose: Detection,
        color: Float[np.ndarray, "3"],
        image: Float[np.ndarray, "h w 4"],
        nearest: Float[np.ndarray, "h w"],
    ) -> None:
        """Paint a pose into an image, paler where the scan has something in front of it."""
        from scipy.ndimage import binary_erosion

        T_view_object = self.T_view_scene @ pose.T_scene_object
        normals, corners = self.surface
        normals = normals @ T_view_object[:3, :3].T
        corners = placed(T_view_object, corners)
        centers = corners.mean(axis=1)
        depth = centers[:, 2]
        index = self.canvas.seen(normals, corners)
        shown = (index >= 0) & (depth[index] < nearest)
        measured = values_at(self.view.depth, image_places(self.view.camera, centers))
        hidden = (measured > 0) & (measured < depth - _IN_FRONT * self.part.diameter)
        if pose.probability >= ACCEPTED:
            nearest[shown] = depth[index[shown]]
            outline = shown & ~binary_erosion(shown, iterations=2)
            opacity = np.where(hidden, 0.35, 0.85)
        else:
            dashes = np.add.outer(np.arange(len(image)), np.arange(len(image[0]))) // _DASH % 2 == 0
            outline = shown & ~binary_erosion(shown) & dashes
            opacity = np.where(hidden, 0.08, 0.2)
        colors = np.column_stack([color * (0.3 + 0.7 * brightness(normals))[:, None], opacity])
        image[shown] = colors[index[shown]]
        image[outline] = (*(0.75 * color), 1.0)

    def _draw_points(
        self, axis: Any, colors: Float[np.ndarray, "n 3"], rank: Int[np.ndarray, " n"] | Bool[np.ndarray, " n"]
    ) -> None:
        """Draw the crops' points; where they overlap those of the highest rank, and of a negative one none."""
        if not self.found.poses:
            return
        rows = np.random.default_rng(0).permutation(len(rank))[:_MOST_CROP_POINTS]
        rows = rows[(rank[rows] >= 0) & (self.points[rows, 2] > 0)]
        rows = rows[np.lexsort([-self.points[rows, 2], rank[rows]])]
        places = image_places(self.view.camera, self.points)
        # So large that they nearly cover what they stand for.
        pixels = np.clip(1.6 * self.canvas.scale * spacing(places[self.crop_of == 0]), 4, 14)
        points = pixels / _CANVAS_SIDE * _SMALL * _PANEL * 72
        axis.scatter(*places[rows].T, s=points**2, c=colors[rows], marker="s", lw=0)

    def _draw_scan(self, axis: Any, colors: Float[np.ndarray, "h w c"], background: float = 0.98) -> None:
        """Draw the scan in colours, of one channel or three, that are NaN where nothing was measured."""
        height, width = self.scan.brightness.shape
        colors = np.broadcast_to(np.where(np.isnan(colors), background, colors), (height, width, 3))
        extent = (-0.5, width * self.scan.step - 0.5, height * self.scan.step - 0.5, -0.5)
        axis.imshow(as_bytes(colors), extent=extent, interpolation="nearest")
        left, right, bottom, top = self.canvas.extent
        axis.set(xlim=(left, right), ylim=(bottom, top), xticks=[], yticks=[], facecolor=str(background))

    def _tell_why_not(self, axis: Any) -> None:
        text = textwrap.fill(self.found.reason or "no pose was found", 40)
        box = {"facecolor": "white", "edgecolor": "0.4", "boxstyle": "round,pad=0.6"}
        told = axis.text(
            0.5, 0.5, text, ha="center", va="center", transform=axis.transAxes, fontsize=12, bbox=box, parse_math=False
        )
        told.set_in_layout(False)


def _measured_box(view: Scene) -> tuple[float, float, float, float]:
    """Return left, right, bottom and top of what was measured, in pixels; few strays are left out."""
    rows, columns = np.nonzero(view.depth > 0)
    if not len(rows):
        return -0.5, view.camera.width - 0.5, view.camera.height - 0.5, -0.5
    (left, right), (top, bottom) = (np.percentile(values, [0.1, 99.9]) for values in (columns, rows))
    margin = 0.02 * max(right - left, bottom - top) + 1
    return float(left - margin), float(right + margin), float(bottom + margin), float(top - margin)


def _zoomed(camera: Camera, box: tuple[float, float, float, float], places: Float[np.ndarray, "n 2"]) -> Canvas:
    """Return a raster, of the shape of the box, around places in it; over all of it if they fill most of it."""
    left, right, bottom, top = box
    width, height = right - left, bottom - top
    inside = places[((places > [left, top]) & (places < [right, bottom])).all(axis=1)]
    share = 1.0
    if len(inside):
        low, high = inside.min(axis=0), inside.max(axis=0)
        share = 1.15 * float(((high - low) / [width, height]).max())
    if share < _WHOLE:
        share = max(share, _CLOSEST)
        width, height = width * share, height * share
        x, y = (low + high) / 2 - [width / 2, height / 2]
        left, top = float(np.clip(x, left, right - width)), float(np.clip(y, top, bottom - height))
    scale = _CANVAS_SIDE / max(width, height)
    return Canvas(camera, left, top, scale, max(1, round(width * scale)), max(1, round(height * scale)))
