"""The stages of a forward pass, of a crop's way to its pose and of training, each as a call of its own."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from flax import nnx

from benchmarks import training, work
from benchmarks.network_cases import Case, cached_forward, encode_objects
from benchmarks.timing import compile_for
from benchmarks.work import Work
from configs import find_config
from experiments.evaluation.cases import Case as PoseCase
from experiments.evaluation.cases import draw_cases, padded
from experiments.evaluation.sources import bop_objects
from kmn_jax.detection import (
    CropSearchConfig,
    Prediction,
    draw_of_crop,
    find_poses_in_crop,
    poses_at,
    poses_of_draw,
    predict,
    refined,
    search_crop,
    search_draws,
    surface_scores,
)
from kmn_jax.errors import InputError
from kmn_jax.geometry import PaddedCloud, neighbor_graph, space_filling_order
from kmn_jax.models import Model, load_pretrained, released_scene
from kmn_jax.objects import ObjectModel, PartArrays, arrays_of, make_part

_SMALL_SET = Path("experiments/assets/small_test_set")
SEARCH = CropSearchConfig()  # what users run around a place that is given


class Stage(NamedTuple):
    """A call that is compiled and has its arguments, and what it has to do."""

    call: Callable[[], Any]
    work: Work


def small_case() -> tuple[ObjectModel, PoseCase]:
    """Return a crop of the small test set, and its object."""
    objects = bop_objects(_SMALL_SET, "test", _refuse, most_images=1)[0]
    return objects.model, next(iter(draw_cases(objects, 1, 0.01)))


class SmallCrop(NamedTuple):
    """The released network, an encoded object, and a crop around a copy of it."""

    model: Model
    part: PartArrays
    cloud: PaddedCloud


def small_crop(model: Model | None = None) -> SmallCrop:
    """Return the crop of `small_case`, as calls of a model take it, the released one unless given."""
    model = model or load_pretrained()
    found, case = small_case()
    return SmallCrop(model, arrays_of(model, make_part(found, model)), padded(case.points))


def network_call(case: Case) -> Callable[[], Any]:
    """Return the scene branch and the pair head in one call, with the features of a case's objects given."""
    model = case.model
    arguments = model.parameters, case.crops, encode_objects(*model, case)
    return partial(compile_for(partial(cached_forward, model.graphdef), *arguments).function, *arguments)


def network_stages(case: Case) -> dict[str, Stage]:
    """Return the stages of the published network at batch 1, each on what the stage before it gives."""
    model, config = case.model, case.model.config
    points, count = config.num_scene_points, config.num_neighbors

    def of_network(function: Callable[..., Any], *arguments: jax.Array) -> Callable[[], Any]:
        ready = compile_for(lambda p, *a: function(nnx.merge(model.graphdef, p), *a), model.parameters, *arguments)
        return lambda: ready.function(model.parameters, *arguments)

    def ordered(_: Any, cloud: jax.Array) -> tuple[jax.Array, jax.Array]:
        order, places = space_filling_order(cloud[:, :3])
        return cloud[order], places

    def nearest(_: Any, x: jax.Array) -> jax.Array:
        return neighbor_graph(x, count)

    calls = {"order of the points": of_network(ordered, released_scene(case.crops[0], None))}
    cloud, places = calls["order of the points"]()
    x, local = cloud, []
    for block, searched in enumerate(("coordinates", "features, first", "features, second"), start=1):
        calls[f"kNN on {searched}"] = of_network(nearest, x if block > 1 else cloud[:, :3])
        graph = calls[f"kNN on {searched}"]()
        calls[f"EdgeConv {block}"] = of_network(
            lambda net, x, g, block=block: getattr(net.scene, f"edge{block}")(x, g, "float32"), x, graph
        )
        x = calls[f"EdgeConv {block}"]()
        local.append(x)
    calls["global and output layers"] = of_network(
        lambda net, x: net.scene._with_global(x, "float32", None), jnp.concatenate(local, axis=1)
    )
    calls["points as given"] = of_network(lambda _, x, i: x[i], calls["global and output layers"](), places)
    scene, part = calls["points as given"](), encode_objects(*model, case)[0]
    calls["pair head"] = of_network(lambda net, s, o: net.match(s, o), scene, part)
    return _joined(calls, work.scene_stages(config, points))


def pose_stages(config: CropSearchConfig = SEARCH) -> dict[str, Stage]:
    """Return the stages from a scan to the refined pose by the released network, on a crop of the small test set."""
    model, part, cloud = small_crop()
    key, sizes, row = jax.random.key(0), model.config, jnp.int32(0)
    config = config.of_network(sizes)
    if config.icp is None:
        raise InputError("the stages of a crop end with its refinement: give icp")
    every, count = replace(config, enough=None), config.points_of_draw

    crop_call = compile_for(lambda p, c, k: search_crop(c, row, p.diameter, k, config), part, cloud, key).function
    crop = crop_call(part, cloud, key)

    draw_call = compile_for(lambda c, d: draw_of_crop(c, 0, d, config), crop, part.diameter).function
    drawn = draw_call(crop, part.diameter)

    def network(parameters: nnx.State, part: Any, drawn: Any) -> Prediction:
        return predict(nnx.merge(model.graphdef, parameters), part, drawn)

    network_call = compile_for(network, model.parameters, part, drawn).function
    draw = network_call(model.parameters, part, drawn)
    poses_call = compile_for(lambda s, v, p, k: poses_of_draw(s, v, p, k, config), draw, crop.valid, part, key).function
    poses = poses_call(draw, crop.valid, part, key)
    draws = jax.tree.map(lambda leaf: jnp.stack([leaf] * config.most_draws), draw)
    scores_call = compile_for(lambda f, s, c, p: surface_scores(f, s, c, p, config), poses, draws, crop.seed, part)
    searched = jax.jit(lambda c: search_draws(nnx.merge(*model), part, c, key, config))(crop)
    made = int(searched.num_draws)
    best = int(jnp.argmax(scores_call.function(poses, draws, crop.seed, part)))
    pose = poses.T_scene_object[best]
    icp_call = compile_for(lambda f, s, p: refined(f, s, p, config), pose, draw, part).function
    calls = {
        "crop": lambda: crop_call(part, cloud, key),
        "a draw, smoothed, with normals": lambda: draw_call(crop, part.diameter),
        "network on a draw": lambda: network_call(model.parameters, part, drawn),
        "matches and RANSAC of a draw": lambda: poses_call(draw, crop.valid, part, key),
        "a draw's poses against the surface": lambda: scores_call.function(poses, draws, crop.seed, part),
        "ICP": lambda: icp_call(pose, draw, part),
        "crop to refined poses, all draws": lambda: find_poses_in_crop(*model, part, crop, key, every),
        "crop to refined poses": lambda: poses_at(model, part, cloud, 0, 0, config),
    }
    kept = max(config.most_draws * (count - 1) + 1, config.crop_points)
    pairs = min(config.matches.capacity, count * sizes.num_keypoints)
    search = work.matches(count, sizes.num_keypoints, config.matches) + work.ransac(
        pairs, config.num_modes, config.ransac
    )
    of_stage = {
        "crop": work.drawn_crop(len(cloud.points), kept, 0),
        "a draw, smoothed, with normals": work.drawn_crop(0, kept, count),
        "network on a draw": work.total(work.scene_stages(sizes, count).values()),
        "matches and RANSAC of a draw": search,
        "a draw's poses against the surface": work.surface_scores(
            config.num_modes, config.surface_points, config.most_draws * count
        ),
        "ICP": work.icp(len(part.points), config.icp_points, config.icp),
    }
    first, *of_draw, refining = of_stage.values()
    draw_work, last = work.total(of_draw), refining.times(config.num_poses)
    return _joined(
        calls,
        of_stage
        | {
            "crop to refined poses, all draws": first + draw_work.times(config.most_draws) + last,
            "crop to refined poses": first + draw_work.times(made) + last,
        },
    )


def training_stages(names: tuple[str, ...], on_cpu: bool) -> dict[str, Stage]:
    """Return a step of each named training config, its samples included, and the making of these alone."""
    stages: dict[str, Stage] = {}
    for name in names:
        config = training.of_batch(find_config(name), 8 if on_cpu else 128, on_cpu)
        config = replace(config, network=replace(config.network, compute="float32")) if on_cpu else config
        step, data, _ = training.steps(config, 1)
        pipeline = config.pipeline
        counted = work.training_step(config.network, pipeline.batch_size, pipeline.crops_per_object)
        stages[f"{name}: a step of {pipeline.batch_size} with its data"] = Stage(step, counted)
        crops = config.examples.crops
        drawn = work.drawn_crop(crops.num_drawn, crops.num_drawn, crops.num_points)
        stages[f"{name}: its data alone"] = Stage(data, drawn.times(pipeline.batch_size))
    return stages


def _joined(calls: Mapping[str, Callable[[], Any]], of_stage: Mapping[str, Work]) -> dict[str, Stage]:
    if set(calls) != set(of_stage):
        raise ValueError(f"stages and their work differ: {set(calls) ^ set(of_stage)}")
    return {name: Stage(call, of_stage[name]) for name, call in calls.items()}


def _refuse(problem: str) -> None:
    raise InputError(problem)
