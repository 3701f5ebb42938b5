"""The picture of a result: the scan, what was taken for the part, its keypoints and its poses, as the sensor sees them.

It is drawn without a display.
"""

from __future__ import annotations

import io
import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Float32

from kmn_jax.detection import Detection, Detections, Scene, placed
from kmn_jax.errors import InputError
from kmn_jax.files import write_whole
from kmn_jax.geometry import Camera
from kmn_jax.objects import Part
from kmn_jax.viz._legend import LIKELY, NOT_THE_PART, center_of, draw_list, draw_part, ranked, summary
from kmn_jax.viz._raster import Canvas, as_bytes, brightness, distinct_colors, image_places, relief_of, surface_discs
from kmn_jax.viz._truth import TRUTH_COLORS, truth_codes

RELIEF = 0.03  # of the diameter: noise below that is smoothed before surfaces are shaded
_CANVAS_SIDE = 800  # pixels of a panel
_WHOLE, _CLOSEST = 0.8, 0.05  # of the scan's width: what fills more is not zoomed in on, and nothing closer than
_MOST_CROP_POINTS = 200_000
_IN_FRONT = 0.05  # of the diameter: what was measured that much nearer hides a pose
_DASH = 7  # pixels of the outlines of unlikely poses


def check_picture(path: str | Path) -> None:
    """Raise InputError for a path that is not that of a PNG file."""
    if Path(path).suffix.lower() != ".png":
        raise InputError(f"{path} cannot be written: pictures are PNG files, name one that ends with .png")


def save_picture(
    path: str | Path,
    view: Scene,
    part: Part,
    found: Detections,
    truth: Sequence[Float[np.ndarray, "4 4"]] | None = None,
) -> None:
    """Write a PNG with four panels: the scan, the segmentation, the keypoints, and the poses.

    With `truth`, the true poses `T_scene_object` of all copies, the segmentation is coded as by `truth_codes`. A result
    without poses makes a picture that says why. Raises InputError if the path is no PNG file's or cannot be written
    to, or if matplotlib is not installed.
    """
    check_picture(path)
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError:
        raise InputError("pictures need a package that is not installed: pip install 'kmn_jax[plots]'") from None

    part = part.in_unit(found.unit)
    drawing = _Drawing(view, part, found)
    aspect = float(np.clip(drawing.canvas.width / drawing.canvas.height, 0.6, 2.0))
    width, height = 6.4 * min(1.0, aspect), 6.4 * min(1.0, 1 / aspect)
    figure = Figure(figsize=(2 * width + 3.8, 2 * height + 1.2), dpi=100, layout="constrained")
    canvas = FigureCanvasAgg(figure)
    figure.get_layout_engine().set(wspace=0.02, hspace=0.03)
    figure.suptitle(f"{part.name}: {summary(found)}", fontsize=15, parse_math=False)
    grid = figure.add_gridspec(2, 3, width_ratios=(width, width, 3.4))
    panels = [figure.add_subplot(grid[row, column]) for row in range(2) for column in range(2)]
    drawing.draw_scan(panels[0], figure)
    if truth is None:
        drawing.draw_segmentation(panels[1])
    else:
        drawing.draw_truth(panels[1], figure, truth)
    drawing.draw_keypoints(panels[2])
    drawing.draw_poses(panels[3])
    side = grid[:, 2].subgridspec(3, 1, height_ratios=(1, 1, 2.4))
    draw_part(figure.add_subplot(side[0]), part, (0.5, 0.6, -0.62), "The part's keypoints")
    draw_part(figure.add_subplot(side[1]), part, (-0.5, -0.6, 0.62), "from behind")
    draw_list(figure.add_subplot(side[2]), found)
    content = io.BytesIO()
    canvas.print_png(content)
    write_whole(path, content.getvalue())


class _Drawing:
    """What the panels share: the scan's shading, the crops' points, and the raster they are drawn on."""

    def __init__(self, view: Scene, part: Part, found: Detections) -> None:
        self.view, self.part, self.found = view, part, found
        self.T_view_scene = np.linalg.inv(view.T_scene_camera)
        self.pose_colors = distinct_colors(max(1, len(found.poses)))
        self.surface = surface_discs(part.points, part.normals)
        self.step, self.depth, self.shade = relief_of(view.depth, view.camera, RELIEF * part.diameter)
        self.box = _measured_box(view)
        self.canvas = _zoomed(view.camera, self.box, self._places())
        self.dot = self._dot()

    def _places(self) -> Float[np.ndarray, "n 2"]:
        """Return where the image has the crops and the corners of the poses."""
        corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)])
        corners = self.part.minimum + corners * (self.part.maximum - self.part.minimum)
        clouds = [self._in_view(placed(pose.T_scene_object, corners)) for pose in self.found.poses]
        clouds += [self._in_view(pose.prediction.points) for pose in self.found.poses]
        return image_places(self.view.camera, np.concatenate(clouds)) if clouds else np.zeros((0, 2))

    def _dot(self) -> int:
        """Return the size of a crop's points in pixels, so that they nearly cover what they stand for."""
        from scipy.spatial import cKDTree

        apart = []
        for pose in self.found.poses[:5]:
            places = image_places(self.view.camera, self._in_view(pose.prediction.points))
            if len(places) > 1:
                apart.append(float(np.median(cKDTree(places).query(places, k=2)[0][:, 1])))
        return int(np.clip(round(1.6 * self.canvas.scale * float(np.median(apart))), 3, 12)) if apart else 3

    def _in_view(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        return placed(self.T_view_scene, points.astype(np.float64))

    def draw_scan(self, axis: Any, figure: Any) -> None:
        from matplotlib import colormaps
        from matplotlib.cm import ScalarMappable
        from matplotlib.colors import Normalize
        from matplotlib.patches import Rectangle

        left, right, bottom, top = self.box
        measured = self.depth[self.depth > 0]
        low, high = (float(x) for x in np.percentile(measured, [0.5, 99.5])) if measured.size else (0.0, 1.0)
        norm, cmap = Normalize(low, max(high, low + 1e-9 * (1 + abs(low)))), colormaps["viridis_r"]
        colors = cmap(norm(self.depth))[..., :3] * (0.5 + 0.5 * self.shade[..., None])
        self._backdrop(axis, colors)
        axis.set_xlim(left, right)
        axis.set_ylim(bottom, top)
        bar = figure.colorbar(ScalarMappable(norm, cmap), ax=axis, fraction=0.03, pad=0.01)
        bar.ax.invert_yaxis()  # near is above, as bright as in the panel
        title = f"Scan: depth in {self.found.unit}"
        left, right, bottom, top = self.canvas.extent
        if right - left < 0.97 * (self.box[1] - self.box[0]):
            axis.add_patch(Rectangle((left, top), right - left, bottom - top, fill=False, color="black", ls="--"))
            title += "; the other panels show what is framed"
        axis.set_title(title)

    def draw_segmentation(self, axis: Any) -> None:
        self._backdrop(axis)
        crops = [(pose.prediction.points, pose.prediction.on_object) for pose in self.found.poses]
        colors = [
            np.where(on[:, None], color, NOT_THE_PART) for (_, on), color in zip(crops, self.pose_colors, strict=False)
        ]
        self._points(axis, [points for points, _ in crops], colors, [on.astype(int) for _, on in crops])
        share = sum(int(on.sum()) for _, on in crops) / max(1, sum(len(on) for _, on in crops))
        axis.set_title(f"Segmentation: {share:.0%} of the crops' points are on a copy (coloured)")

    def draw_truth(self, axis: Any, figure: Any, truth: Sequence[Float[np.ndarray, "4 4"]]) -> None:
        from matplotlib.patches import Patch

        self._backdrop(axis, dark=True)
        poses = self.found.poses
        codes = [truth_codes(self.part, pose, truth) for pose in poses]
        table = np.array(list(TRUTH_COLORS.values()))
        # Where crops overlap, faults are shown rather than what is right.
        order = np.array([0, 4, 3, 2, 1])
        self._points(
            axis, [pose.prediction.points for pose in poses], [table[code] for code in codes], [order[c] for c in codes]
        )
        counts = np.bincount(np.concatenate(codes), minlength=5) if codes else np.zeros(5, dtype=int)
        shares = counts / max(1, counts.sum())
        patches = [
            Patch(facecolor=color, edgecolor="black", lw=0.5, label=f"{share:4.0%} {name}")
            for (name, color), share in zip(TRUTH_COLORS.items(), shares, strict=True)
        ]
        figure.legend(handles=patches, loc="outside lower center", ncols=len(patches), fontsize=10, frameon=False)
        axis.set_title("Points of the crops against the truth")

    def draw_keypoints(self, axis: Any) -> None:
        self._backdrop(axis)
        table = distinct_colors(self.part.num_keypoints)
        chosen = [pose.prediction for pose in self.found.poses]
        self._points(
            axis,
            [prediction.points[prediction.on_object] for prediction in chosen],
            [table[prediction.keypoint[prediction.on_object]] for prediction in chosen],
            [np.zeros(int(prediction.on_object.sum()), dtype=int) for prediction in chosen],
        )
        axis.set_title("Likeliest keypoint of points on a copy")

    def draw_poses(self, axis: Any) -> None:
        import matplotlib.patheffects as effects

        self._backdrop(axis)
        canvas = self.canvas
        image = np.zeros((canvas.height, canvas.width, 4))
        nearest = np.full(image.shape[:2], np.inf)
        measured = canvas.measured(self.view.depth)
        # Likely poses come last: they are in front of all others, whatever their depth.
        for rank, pose in sorted(ranked(self.found), key=lambda row: row[1].probability >= LIKELY):
            self._paint(pose, self.pose_colors[rank - 1], image, nearest, measured)
            likely = pose.probability >= LIKELY
            center = self._in_view(placed(pose.T_scene_object, center_of(self.part)[None]))
            axis.annotate(
                f"{rank}: {pose.probability:.2f}",
                image_places(canvas.camera, center)[0],
                ha="center",
                va="center",
                fontsize=10 if likely else 8.5,
                weight="bold" if likely else "normal",
                color="black" if likely else "0.25",
                path_effects=[effects.withStroke(linewidth=2.5, foreground="white")],
                annotation_clip=True,
            )
        axis.imshow(as_bytes(image), extent=canvas.extent, interpolation="nearest")
        self._limits(axis)
        axis.set_title(f"Poses with rank and probability; dashed below {LIKELY}")
        if not self.found.poses:
            self._say(axis)

    def _paint(
        self,
        pose: Detection,
        color: Float[np.ndarray, "3"],
        image: Float[np.ndarray, "h w 4"],
        nearest: Float[np.ndarray, "h w"],
        measured: Float32[np.ndarray, "h w"],
    ) -> None:
        """Paint a pose into an image, paler where the scan has something in front of it."""
        T_view_object = self.T_view_scene @ pose.T_scene_object
        points, normals, radii = self.surface
        normals = normals @ T_view_object[:3, :3].T
        index, depth = self.canvas.seen_discs(placed(T_view_object, points), normals, radii)
        rows, columns = np.flatnonzero((index >= 0).any(axis=1)), np.flatnonzero((index >= 0).any(axis=0))
        if not len(rows):
            return
        window = np.s_[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
        index, depth, nearest, image = index[window], depth[window], nearest[window], image[window]
        shown = (index >= 0) & (depth < nearest)
        hidden = (measured[window] > 0) & (measured[window] < depth - _IN_FRONT * self.part.diameter)
        edge = shown & ~_eroded(shown)
        likely = pose.probability >= LIKELY
        if likely:
            nearest[shown] = depth[shown]
            edge = shown & ~_eroded(_eroded(shown))
            opacity = np.where(hidden, 0.35, 0.85)
        else:
            edge &= np.add.outer(np.arange(len(edge)), np.arange(len(edge[0]))) // _DASH % 2 == 0
            opacity = np.where(hidden, 0.08, 0.2)
        image[shown, :3] = color * (0.3 + 0.7 * brightness(normals))[index[shown], None]
        image[shown, 3] = opacity[shown]
        image[edge] = (*(0.75 * color), 1.0)

    def _points(self, axis: Any, clouds: list[Any], colors: list[Any], ranks: list[Any]) -> None:
        """Draw points of crops; where they overlap, those of the highest rank."""
        if not clouds:
            self._say(axis)
            return
        points, color, rank = np.concatenate(clouds), np.concatenate(colors), np.concatenate(ranks)
        if len(points) > _MOST_CROP_POINTS:
            kept = np.random.default_rng(0).choice(len(points), _MOST_CROP_POINTS, replace=False)
            points, color, rank = points[kept], color[kept], rank[kept]
        canvas = self.canvas
        image = np.zeros((canvas.height, canvas.width, 4))
        for level in np.unique(rank):
            index, _ = canvas.seen(self._in_view(points[rank == level]), self.dot)
            image[index >= 0, :3] = color[rank == level][index[index >= 0]]
            image[index >= 0, 3] = 1
        axis.imshow(as_bytes(image), extent=canvas.extent, interpolation="nearest")
        self._limits(axis)

    def _backdrop(self, axis: Any, colors: Float[np.ndarray, "h w 3"] | None = None, dark: bool = False) -> None:
        if colors is None:
            low, high = (0.18, 0.55) if dark else (0.55, 0.93)
            colors = np.repeat((low + (high - low) * self.shade)[..., None], 3, axis=2)
        colors = np.where(np.isnan(colors), 0.10 if dark else 0.98, colors)
        height, width = self.shade.shape
        extent = (-0.5, width * self.step - 0.5, height * self.step - 0.5, -0.5)
        axis.imshow(as_bytes(colors), extent=extent, interpolation="nearest")
        axis.set_facecolor("0.10" if dark else "0.98")
        axis.set(xticks=[], yticks=[])
        self._limits(axis)

    def _limits(self, axis: Any) -> None:
        left, right, bottom, top = self.canvas.extent
        axis.set_xlim(left, right)
        axis.set_ylim(bottom, top)

    def _say(self, axis: Any) -> None:
        text = textwrap.fill(self.found.reason or "no pose was found", 40)
        box = {"facecolor": "white", "edgecolor": "0.4", "boxstyle": "round,pad=0.6"}
        axis.text(
            0.5, 0.5, text, ha="center", va="center", transform=axis.transAxes, fontsize=12, bbox=box, parse_math=False
        )


def _eroded(mask: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    padded = np.pad(mask, 1)
    return mask & padded[:-2, 1:-1] & padded[2:, 1:-1] & padded[1:-1, :-2] & padded[1:-1, 2:]


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
