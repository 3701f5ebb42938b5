"""Training scenes made inside jit: agreement with ray casting, milliseconds a view and a crop, crops a second.

python -m benchmarks.scenes [--pack experiments/assets/small_pack] [--objects 60] [--repeats 15] [--json FILE]
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.command import run
from benchmarks.timing import compile_for, time_in_turn
from kmn_jax.data import (
    CropConfig,
    DevicePack,
    LabelledCrop,
    NormalSource,
    Pack,
    draw_crop,
    stack_pack,
    take_scene,
    visible_points,
)
from kmn_jax.report import print_table, write_json
from kmn_jax.simulate import SplatConfig, VisiblePoints

NUM_KEYPOINTS = 20


def main(
    pack: Path = Path("experiments/assets/small_pack"),
    objects: int = 60,
    sizes: tuple[int, ...] = (512, 2048),
    batches: tuple[int, ...] = (1, 8),
    repeats: int = 15,
    json: Path | None = None,
) -> None:
    """Run all tables on the scenes of a pack with visibility bits.

    Args:
        pack: folder of the pack.
        objects: of the pack, at most, evenly spaced in its order.
        sizes: points of a crop.
        batches: crops made at once, each of another object, drop and seed.
        repeats: timed rounds.
        json: where results go.
    """
    opened = Pack(pack)
    names = opened.names()
    stacked = stack_pack(opened, names[:: -(-len(names) // objects)])
    arrays = jax.tree.map(jnp.asarray, stacked.arrays)
    agreement = agreement_rows(arrays, SplatConfig(num_bin_surfels=8 * arrays.bin_bits.shape[-1]))
    print_table(f"Splatting against ray casting, {len(stacked.names)} objects, all of their bins", agreement)
    stages = stage_rows(arrays, sizes, repeats)
    print_table(f"Stages of one crop, 20 copies of {arrays.points.shape[1]} surfels and a bin", stages)
    throughput = [row for size in sizes for batch in batches for row in throughput_rows(arrays, size, batch, repeats)]
    print_table("View and crop", throughput)
    write_json(json, {"agreement": agreement, "stages": stages, "throughput": throughput})


def agreement_rows(pack: DevicePack, config: SplatConfig) -> list[dict[str, Any]]:
    """Compare splatting with the exact bits: points called visible but hidden, and visible points that are missed.

    By count, and by the picture area that the points cover, as they are drawn into crops.
    """

    @jax.jit
    def compared(place: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        scene = take_scene(pack, place[0], place[1])
        splatted, exact = visible_points(scene, config), visible_points(scene)
        return splatted.mask, exact.mask, exact.picture_area / exact.picture_area.sum()

    places = np.array([[i, j] for i, drops in enumerate(np.asarray(pack.num_drops)) for j in range(drops)])
    parts = {"copies": slice(None, -config.num_bin_surfels), "bin": slice(-config.num_bin_surfels, None)}
    sums = {(part, weight): np.zeros(4) for part in parts for weight in ("points", "picture area")}
    beyond = {part: np.zeros(2, dtype=int) for part in parts}
    for place in places:
        found, truth, area = (np.asarray(array) for array in compared(jnp.asarray(place, dtype=jnp.int32)))
        for part, cut in parts.items():
            f, t = found[cut], truth[cut]
            for weight, w in (("points", np.ones(len(f))), ("picture area", area[cut])):
                sums[part, weight] += [w[f & ~t].sum(), w[f].sum(), w[t & ~f].sum(), w[t].sum()]
            beyond[part] += [(f & ~t).sum() > 0.03 * f.sum(), (t & ~f).sum() > 0.1 * t.sum()]
    return [
        {
            "of": part,
            "by": weight,
            "scenes": len(places),
            "false among visible %": 100 * false / called,
            "missed %": 100 * missed / visible,
            "scenes above 3% and 10%": " and ".join(map(str, beyond[part])) if weight == "points" else None,
        }
        for (part, weight), (false, called, missed, visible) in sums.items()
    ]


def stage_rows(pack: DevicePack, sizes: tuple[int, ...], repeats: int) -> list[dict[str, Any]]:
    """Time the two ways to a view, and the crop from it with its two kinds of normals."""
    key, scene = jax.random.key(0), take_scene(pack, jnp.int32(0), pack.num_drops[0] - 1)
    ready = {
        "view by bits": compile_for(visible_points, scene),
        "view by splatting": compile_for(partial(visible_points, splat=SplatConfig()), scene),
    }
    calls: dict[str, Callable[[], Any]] = {name: partial(compiled.function, scene) for name, compiled in ready.items()}
    seen: VisiblePoints = calls["view by bits"]()
    arguments = (key, seen, scene.surfels.points[:NUM_KEYPOINTS], scene.T_camera_object, scene.diameter)
    sources: tuple[NormalSource, ...] = ("surface", "estimated")
    for size in sizes:
        for normals in sources:
            name = f"crop of {size}, {normals} normals"
            ready[name] = compile_for(
                partial(draw_crop, config=CropConfig(num_points=size, normals=normals)), *arguments
            )
            calls[name] = partial(ready[name].function, *arguments)
    return [
        {
            "stage": name,
            "ms": steady.median_ms,
            "min ms": steady.minimum_ms,
            "compile s": ready[name].trace_s + ready[name].lower_s + ready[name].compile_s,
            "temporary MB": ready[name].temporary_bytes / 1e6,
        }
        for name, steady in time_in_turn(calls, repeats).items()
    ]


def throughput_rows(pack: DevicePack, size: int, batch: int, repeats: int) -> list[dict[str, Any]]:
    """Time whole crops, a view for each, mapped one after the other and vectorised."""
    keys = jax.random.split(jax.random.key(batch), batch)
    config = CropConfig(num_points=size)
    views: Mapping[str, SplatConfig | None] = {"bits": None, "splatting": SplatConfig()}
    calls: dict[tuple[str, str], Callable[[], Any]] = {}
    for view, splat in views.items():
        one = partial(_crop, pack, config, splat)
        calls[view, "map"] = partial(compile_for(partial(jax.lax.map, one), keys).function, keys)
        if batch > 1:
            calls[view, "vmap"] = partial(compile_for(jax.vmap(one), keys).function, keys)
    times = time_in_turn({"/".join(name): call for name, call in calls.items()}, repeats)
    return [
        {
            "points": size,
            "batch": batch,
            "view": view,
            "form": form,
            "ms a crop": times[f"{view}/{form}"].median_ms / batch,
            "min ms a crop": times[f"{view}/{form}"].minimum_ms / batch,
            "crops/s": 1e3 * batch / times[f"{view}/{form}"].median_ms,
        }
        for view, form in calls
    ]


def _crop(pack: DevicePack, config: CropConfig, splat: SplatConfig | None, key: jax.Array) -> LabelledCrop:
    """Make one crop of a random object and drop."""
    object_key, drop_key, crop_key = jax.random.split(key, 3)
    item = jax.random.randint(object_key, (), 0, pack.area.shape[0])
    drop = jax.random.randint(drop_key, (), 0, jnp.asarray(pack.num_drops)[item])
    scene = take_scene(pack, item, drop)
    keypoints = scene.surfels.points[:NUM_KEYPOINTS]
    return draw_crop(crop_key, visible_points(scene, splat), keypoints, scene.T_camera_object, scene.diameter, config)


if __name__ == "__main__":
    run(main)
