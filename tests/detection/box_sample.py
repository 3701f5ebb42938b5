"""A scan of two boxes on a wall, seen straight on, and a result for it: what every pixel shows is known."""

from __future__ import annotations

import jax
import numpy as np

from kmn_jax.detection import CropPrediction, Detection, Detections, Scene, Timing, make_scene
from kmn_jax.geometry import Camera, farthest_point_indices
from kmn_jax.io import Scan
from kmn_jax.objects import Part, Symmetries
from kmn_jax.viz._truth import nearest_keypoint
from tests.reference.meshes import box, pose, surface_points

CAMERA = Camera(150.0, 150.0, 79.5, 59.5, 160, 120)
SIZES = (1.0, 0.7, 0.4)  # of a box along x, y and z
WALL = 3.5  # its distance
FRONT = 2.8  # that of the boxes' fronts
POSES = (pose((-0.75, 0.0, 3.0)), pose((0.75, 0.0, 3.0)))  # T_camera_object, the boxes float before the wall

_farthest = jax.jit(farthest_point_indices, static_argnums=1)


def box_part(keypoints: int = 8, unit: str = "m") -> Part:
    many, directions = surface_points(box(*SIZES), 5000)
    rows = np.asarray(_farthest(many.astype(np.float32), 1200))
    points, normals = many[rows], directions[rows]
    x, y, z = SIZES
    return Part(
        name="box",
        unit=unit,
        points=points.astype(np.float32),
        normals=normals.astype(np.float32),
        features=np.zeros((keypoints, 4), dtype=np.float32),
        diameter=float(np.linalg.norm(SIZES)),
        minimum=-np.array(SIZES) / 2,
        maximum=np.array(SIZES) / 2,
        area=2 * (x * y + y * z + z * x),
        symmetries=Symmetries(np.eye(3)[None], np.zeros((0, 3)), np.zeros(3), 0.02),
        source_digest="0",
        model_digest="0",
    )


def box_view() -> Scene:
    """Return the depth image of the boxes in front of the wall."""
    rows, columns = np.mgrid[: CAMERA.height, : CAMERA.width]
    x, y = (columns - CAMERA.cx) / CAMERA.fx, (rows - CAMERA.cy) / CAMERA.fy
    rays = np.stack([x, y, np.ones(x.shape)], axis=-1)
    z = np.full(rows.shape, WALL)
    for T in POSES:
        low, high = T[:3, 3] - np.array(SIZES) / 2, T[:3, 3] + np.array(SIZES) / 2
        near, far = np.minimum(low / rays, high / rays).max(axis=2), np.maximum(low / rays, high / rays).min(axis=2)
        z = np.where(near < far, np.minimum(z, near), z)
    points = (rays * z[..., None]).reshape(-1, 3).astype(np.float32)
    scan = Scan(points, None, z.astype(np.float32), CAMERA, "m")
    return make_scene(scan, box_part().diameter, inside=np.ones(len(points), dtype=bool))


def crop_of(part: Part, view: Scene, T: np.ndarray) -> CropPrediction:
    """Return a crop around the front of a box, with true predictions; points are in the camera's frame."""
    seed = T[:3, 3] - [0, 0, SIZES[2] / 2]
    points = view.points[np.linalg.norm(view.points - seed, axis=1) < 1.3]
    on = (np.abs(points - T[:3, 3]) < np.array(SIZES) / 2 + 1e-3).all(axis=1) & (points[:, 2] < WALL - 1e-3)
    return CropPrediction(points, on, nearest_keypoint(part, points.astype(np.float64) - T[:3, 3]))


def detection(part: Part, view: Scene, T: np.ndarray, probability: float, warnings: tuple[str, ...] = ()) -> Detection:
    return Detection(
        T_scene_object=T,
        probability=probability,
        num_inliers=123,
        visible_fraction=0.81,
        runner_up_gap=0.4,
        explained=0.75,
        violated=0.05,
        occluded=0.15,
        unknown=0.05,
        seed=T[:3, 3] - [0, 0, SIZES[2] / 2],
        prediction=crop_of(part, view, T),
        warnings=warnings,
    )


def both_boxes(part: Part, view: Scene) -> Detections:
    """Return the left box as likely, the right one as not."""
    poses = (
        detection(part, view, POSES[0], 0.93),
        detection(part, view, POSES[1], 0.31, ("few of its matches <agree>",)),
    )
    return Detections("box", "m", poses, Timing({"search": 0.5}, 1.0))
