"""Small scenes with exact depth images, from formulas, and a box with symmetries: what the BOP tests write and read."""

from __future__ import annotations

import io
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float
from PIL import Image

from kmn_jax.bop import BopFrame, BopInstance, write_camera, write_models, write_scene
from kmn_jax.geometry import Camera
from kmn_jax.objects import ObjectModel, Symmetries
from kmn_jax.simulate import Bin

CAMERA = Camera(fx=80.0, fy=82.0, cx=31.5, cy=23.0, width=64, height=48)
RADIUS = 0.02  # metres
STEP = 0.02  # mm


def rotation(generator: np.random.Generator) -> Float[np.ndarray, "3 3"]:
    q, r = np.linalg.qr(generator.normal(size=(3, 3)))
    q = q * np.sign(np.diag(r))
    return q * np.linalg.det(q)


def sphere_depth(camera: Camera, center: Float[np.ndarray, "3"], radius: float) -> Float[np.ndarray, "h w"]:
    """Return the depth of a sphere, infinite beside it."""
    x = (np.arange(camera.width)[None, :] - camera.cx) / camera.fx
    y = (np.arange(camera.height)[:, None] - camera.cy) / camera.fy
    a, b = x**2 + y**2 + 1, x * center[0] + y * center[1] + center[2]
    root = b**2 - a * (center @ center - radius**2)
    return np.where(root > 0, (b - np.sqrt(np.maximum(root, 0))) / a, np.inf)


def sample_frame(seed: int, num_objects: int = 3) -> BopFrame:
    """Return balls above a floor 0.3 m below the camera, in metres, with silhouettes and visible masks."""
    generator = np.random.default_rng(seed)
    poses = np.tile(np.eye(4), (num_objects, 1, 1))
    for pose in poses:
        pose[:3, :3] = rotation(generator)
        pose[:3, 3] = generator.uniform([-0.04, -0.03, 0.2], [0.04, 0.03, 0.26])
    layers = [sphere_depth(CAMERA, pose[:3, 3], RADIUS) for pose in poses]
    stack = np.stack([*layers, np.full((CAMERA.height, CAMERA.width), 0.3)])
    nearest = stack.argmin(axis=0)
    masks: Bool[np.ndarray, "n h w"] = np.isfinite(stack[:-1])
    depth = stack.min(axis=0).astype(np.float32)
    depth[:2, :3] = 0  # nothing measured
    T_camera_bin = np.diag([1.0, -1.0, -1.0, 1.0])
    T_camera_bin[2, 3] = 0.3
    T_camera_world = np.eye(4)
    T_camera_world[:3, :3], T_camera_world[:3, 3] = rotation(generator), generator.normal(size=3)
    return BopFrame(
        CAMERA,
        depth,
        tuple(BopInstance(1 + index % 2, pose) for index, pose in enumerate(poses)),
        T_camera_world,
        Bin(0.2, 0.15, 0.08, 0.004),
        T_camera_bin,
        masks,
        nearest[None] == np.arange(num_objects)[:, None, None],
    )


def box_model(name: str = "box") -> ObjectModel:
    """Return a box of 20 x 20 x 40 mm, off the origin, in metres, with the quarter turns about its z axis."""
    center = np.array([0.01, -0.02, 0.03])
    corners = np.array([[i >> axis & 1 for axis in range(3)] for i in range(8)]) - 0.5
    vertices = center + corners * [0.02, 0.02, 0.04]
    quads = np.array([[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]])
    triangles = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]]).astype(np.int32)
    quarter = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    rotations = np.stack([np.linalg.matrix_power(quarter, turn) for turn in range(4)])
    return ObjectModel(
        name=name,
        unit="m",
        vertices=vertices,
        triangles=triangles,
        points=vertices.astype(np.float32),
        normals=(corners / 0.75**0.5).astype(np.float32),
        minimum=vertices.min(axis=0),
        maximum=vertices.max(axis=0),
        diameter=float(np.sqrt(24) / 100),
        area=4e-3,
        hidden_share=0.0,
        symmetries=Symmetries(rotations, np.zeros((0, 3)), center, 0.02),
        digest="0" * 64,
    )


def turned_model(name: str = "turned") -> ObjectModel:
    """Return a box that claims to be a turned part: every angle about its z axis."""
    box = box_model(name)
    symmetries = Symmetries(np.eye(3)[None], np.array([[0.0, 0, 1]]), box.symmetries.center, 0.02)
    return replace(box, symmetries=symmetries)


def write_sample(folder: Path, num_frames: int = 3) -> Path:
    """Write a dataset of two scenes in the split test, two models, and camera.json."""
    write_models(folder, {1: box_model(), 2: turned_model()})
    write_camera(folder, CAMERA, STEP)
    for scene_id in (0, 3):
        frames = (sample_frame(10 * scene_id + index) for index in range(num_frames))
        write_scene(folder, "test", scene_id, frames, "m", STEP)
    return folder


def write_blenderproc(folder: Path) -> Path:
    """Write what BlenderProc writes without masks: millimetres, steps of 0.1 mm, background saturated, no models."""
    chunk = folder / "train_pbr" / "000000"
    for name in ("depth", "rgb"):
        (chunk / name).mkdir(parents=True)
    cameras: dict[str, Any] = {}
    truths: dict[str, Any] = {}
    for image in range(12):  # three frames of each of four scenes, one after the other
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = rotation(np.random.default_rng(image)), [10.0, -5.0, 600.0 + image]
        depth = sphere_depth(CAMERA, pose[:3, 3], 60.0)
        steps = np.round(np.minimum(depth / 0.1, 65535)).astype(np.uint16)
        save_image(chunk / "depth" / f"{image:06d}.png", steps)
        save_image(chunk / "rgb" / f"{image:06d}.jpg", np.zeros((*steps.shape, 3), np.uint8))
        cameras[str(image)] = {
            "cam_K": [80.0, 0.0, 31.5, 0.0, 82.0, 23.0, 0.0, 0.0, 1.0],
            "cam_R_w2c": np.diag([1.0, -1, -1]).ravel().tolist(),
            "cam_t_w2c": [0.0, 0.0, 700.0],
            "depth_scale": 0.1,
        }
        truths[str(image)] = [
            {"cam_R_m2c": pose[:3, :3].ravel().tolist(), "cam_t_m2c": pose[:3, 3].tolist(), "obj_id": 5}
        ]
    (chunk / "scene_camera.json").write_text(json.dumps(cameras))
    (chunk / "scene_gt.json").write_text(json.dumps(truths))
    sensor = {"cx": 31.5, "cy": 23.0, "depth_scale": 0.1, "fx": 80.0, "fy": 82.0, "height": 48, "width": 64}
    (folder / "camera.json").write_text(json.dumps(sensor))
    return folder


def save_image(path: Path, values: np.ndarray) -> None:
    file = io.BytesIO()
    Image.fromarray(values).save(file, {".jpg": "JPEG", ".png": "PNG"}.get(path.suffix, "TIFF"))
    path.write_bytes(file.getvalue())


def edit_json(path: Path, *keys: str | int, value: Any) -> None:
    """Set one value inside of a JSON file; `...` removes it."""
    content = json.loads(path.read_text())
    target = content
    for key in keys[:-1]:
        target = target[key]
    if value is ...:
        del target[keys[-1]]
    else:
        target[keys[-1]] = value
    path.write_text(json.dumps(content))
