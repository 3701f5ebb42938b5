"""Draw what is trained and tested on, without a screen: `python -m experiments.show_data`.

For each object of a pack, drops with their visible surfels by copy, and a crop of each: what belongs to the seed's copy
(the segmentation label), the nearest keypoint of its points (the keypoint label), and the normals as a sensor would
give them. For each object of a test set, its exact renderings, by copy and with the visible share of each.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from jaxtyping import Array, Float, Int

from kmn_jax.bop import BopDataset, BopFrame
from kmn_jax.data import CropConfig, DevicePack, LabelledCrop, Pack, draw_crop, stack_pack, take_scene, visible_points
from kmn_jax.errors import InputError
from kmn_jax.files import make_folder
from kmn_jax.geometry import depth_normals
from kmn_jax.simulate import BIN, VisiblePoints

ASSETS = Path(__file__).parent / "assets"


@dataclass(frozen=True)
class ShowData:
    """Draw bins and labelled crops of a pack, and images of a test set, to PNG files."""

    pack: Path | None = ASSETS / "small_pack"  # None leaves packs out
    test_set: Path | None = ASSETS / "small_test_set"  # folder of a BOP dataset; None leaves it out
    split: str = "test"  # of the BOP dataset
    folder: Path = Path("outputs") / "pictures"
    objects: int = 6  # at most so many, evenly spread
    drops: int = 4  # of each object
    keypoints: int = 20
    random_seed: int = 0
    crops: CropConfig = field(default_factory=CropConfig)

    def __post_init__(self) -> None:
        if min(self.objects, self.drops, self.keypoints) < 1:
            raise InputError(
                f"objects = {self.objects}, drops = {self.drops} and keypoints = {self.keypoints} must be 1 or more"
            )

    def run(self) -> None:
        make_folder(self.folder)
        if self.pack is not None:
            pack = Pack(self.pack)
            for name in _spread(pack.names(), self.objects):
                self._save(_pack_figure(pack, name, self), f"pack_{name.replace('/', '_')}.png")
        if self.test_set is not None:
            dataset = BopDataset(self.test_set, self.split)
            scenes = sorted({key.scene_id for key in dataset.keys})
            for scene in _spread(scenes, self.objects):
                images = _spread([key.image_id for key in dataset.keys if key.scene_id == scene], self.drops)
                frames = [dataset.frame(scene, image, masks=True) for image in images]
                self._save(_frames_figure(dataset, frames), f"{self.test_set.name}_{scene:06d}.png")

    def _save(self, figure: Any, name: str) -> None:
        figure.savefig(self.folder / name, dpi=70, bbox_inches="tight")
        print(self.folder / name)


def _spread(items: list[Any], count: int) -> list[Any]:
    """Return at most `count` items, evenly spaced."""
    chosen = np.unique(np.linspace(0, len(items) - 1, min(count, len(items))).round().astype(int))
    return [items[index] for index in chosen]


def _pack_figure(pack: Pack, name: str, show: ShowData) -> Any:
    item, stacked = pack.load(name, visibility=False), stack_pack(pack, [name])
    drops = _spread(list(range(len(item.drops))), show.drops)
    figure, axes = _figure(len(drops), 4, f"{name}: {item.split}, diameter {1000 * item.diameter:.1f} mm")
    for row, drop, key in zip(axes, drops, jax.random.split(jax.random.key(show.random_seed), len(drops)), strict=True):
        scene = item.drops[drop].scene
        visible, crop = _drawn(stacked.arrays, jnp.int32(drop), key, show.keypoints, show.crops)
        seen = np.asarray(visible.mask)
        pixels = np.asarray(visible.points)[seen] @ scene.camera.matrix.T
        _scatter(row[0], pixels[:, :2] / pixels[:, 2:], _instance_colors(np.asarray(visible.instance)[seen]), 0.3)
        seed = scene.camera.matrix @ np.asarray(crop.seed)
        row[0].plot(*(seed[:2] / seed[2]), "k+", markersize=14, markeredgewidth=2)
        row[0].set_title(f"{len(scene.T_bin_object)} copies, visible surfels, + seed")
        _crop_row(row[1:], crop, show)
    return figure


@partial(jax.jit, static_argnames=("num_keypoints", "config"))
def _drawn(
    arrays: DevicePack, drop: Int[Array, ""], key: jax.Array, num_keypoints: int, config: CropConfig
) -> tuple[VisiblePoints, LabelledCrop]:
    scene = take_scene(arrays, jnp.int32(0), drop)
    visible = visible_points(scene)
    keypoints = scene.surfels.points[:num_keypoints]
    return visible, draw_crop(key, visible, keypoints, scene.T_camera_object, scene.diameter, config)


def _crop_row(axes: Any, crop: LabelledCrop, show: ShowData) -> None:
    mask, is_object = np.asarray(crop.mask), np.asarray(crop.is_object)
    # As the camera sees it: divided by the depth, about the seed.
    points = (np.asarray(crop.points) + np.asarray(crop.seed))[mask]
    pixels = points[:, :2] / points[:, 2:]
    on_copy = is_object[mask]
    share = on_copy.mean() if len(on_copy) else 0.0
    _scatter(axes[0], pixels, np.where(on_copy[:, None], [0.8, 0.1, 0.1], [0.7, 0.7, 0.7]), 3)
    axes[0].set_title(f"segmentation label: {share:.0%} object" + ("" if bool(crop.valid) else ", not valid"))
    colors = _palette(np.asarray(crop.keypoint)[mask])
    _scatter(axes[1], pixels, np.where(on_copy[:, None], colors, 0.9), 3)
    axes[1].set_title(f"keypoint label, {show.keypoints} keypoints")
    _scatter(axes[2], pixels, (np.asarray(crop.normals)[mask] + 1) / 2, 3)
    axes[2].set_title(f"normals ({show.crops.normals}), noise {1000 * float(crop.noise):.2g} mm")


def _frames_figure(dataset: BopDataset, frames: list[BopFrame]) -> Any:
    instances = frames[0].instances or ()
    model = dataset.model(instances[0].object_id) if instances else None
    name = f"{model.name}, diameter {model.diameter:.1f} mm" if model else "no objects"
    figure, axes = _figure(len(frames), 2, name)
    for row, frame in zip(axes, frames, strict=True):
        depth = np.asarray(frame.depth, np.float32)
        ids = np.full(depth.shape, BIN)
        for index, visible in enumerate(frame.visible_masks if frame.visible_masks is not None else ()):
            ids[visible] = index
        normals, _ = depth_normals(jnp.asarray(depth), jnp.asarray(frame.camera.matrix, jnp.float32))
        shade = np.clip(-np.asarray(normals)[..., 2:], 0.15, 1)
        row[0].imshow(_instance_colors(ids.ravel()).reshape(*depth.shape, 3) * shade)
        row[0].set_title(f"{len(frame.instances or ())} copies")
        for instance in frame.instances or ():
            if instance.visible_fraction is not None and instance.visible_box is not None:
                left, top, width, height = instance.visible_box
                row[0].text(left + width / 2, top + height / 2, f"{instance.visible_fraction:.0%}", ha="center")
        measured = depth[depth > 0]
        low, high = np.percentile(measured, [0.5, 99.5]) if measured.size else (0, 1)
        row[1].imshow(np.where(depth > 0, depth, np.nan), cmap="viridis_r", vmin=low, vmax=high)
        row[1].set_title(f"depth, {low:.0f} to {high:.0f} mm")
    return figure


def _figure(rows: int, columns: int, title: str) -> tuple[Any, Any]:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6 * columns, 4 * rows), layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False)
    figure.suptitle(title)
    for axis in axes.ravel():
        axis.set_xticks([])
        axis.set_yticks([])
        axis.set_aspect("equal")
    return figure, axes


def _scatter(axis: Any, pixels: Float[np.ndarray, "n 2"], colors: Float[np.ndarray, "n 3"], size: float) -> None:
    axis.scatter(pixels[:, 0], pixels[:, 1], c=colors, s=size, linewidths=0)
    if not axis.yaxis_inverted():  # image rows run downwards
        axis.invert_yaxis()


def _instance_colors(instances: Int[np.ndarray, " n"]) -> Float[np.ndarray, "n 3"]:
    return np.where((instances == BIN)[:, None], 0.75, _palette(instances))


def _palette(labels: Int[np.ndarray, " n"]) -> Float[np.ndarray, "n 3"]:
    from matplotlib import colormaps

    # Neighbouring numbers far apart in hue.
    return colormaps["hsv"]((labels * 0.618034) % 1.0)[:, :3] * np.where(labels % 2, 0.75, 1.0)[:, None]


def main() -> None:
    """Draw the pictures."""
    try:
        tyro.cli(ShowData, description=__doc__).run()
    except InputError as error:
        sys.exit(f"error: {error}")


if __name__ == "__main__":
    main()
