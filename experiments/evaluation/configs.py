"""Named evaluations: what is evaluated, on how much, against what. The docstring records what runs took.

electronics, industrial
    Command:   python -m experiments.build_data test-sets; python -m experiments.evaluate electronics
    Data:      7 held-out components and 7 parts of another class, 20 ray-cast bins of 1 to 20 copies each.
validation
    Command:   python -m experiments.build_data validation-bins; python -m experiments.tune_rivals validation
    Data:      25 components of the training's class, for choices: ablate, tune_rivals.
per_object
    Command:   python -m experiments.evaluate per_object --networks FOLDER, with gear_motor.safetensors and
               bearing_housing.safetensors, from runs of the training config per_object
    Data:      two of the industrial parts: what a network trained for one part alone finds.
wrs
    Command:   python -m experiments.evaluate wrs --cad FOLDER_OF_WRS_MESHES
    Data:      the seven parts of the published out-of-class test, in bins made as those above.
clouds
    Command:   python -m experiments.evaluate clouds --folder FOLDER [--sensor X,Y,Z]
    Data:      somebody else's clouds or depth images of one CAD file, with files of poses.
bop
    Command:   python -m experiments.evaluate bop --folder DATASET --split SPLIT
    Data:      any dataset in BOP format with ground truth, BlenderProc's included.
demo
    Command:   make demo
    Data:      the small test set that the repository carries.
"""

from __future__ import annotations

import difflib
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from kmn_jax.errors import InputError, number_list
from kmn_jax.released import RELEASED

Source = Literal["bop", "clouds"]
METHODS = (
    "ours", "ours_ransac", "ours_no_normals", "ours_open3d", "fpfh", "fpfh_best", "fgr", "ppf", "ppf_best", "kiss"
)  # fmt: skip
OWN_NETWORKS = "per_object"  # a method, too, for which networks have to be given
CROPS_AGAIN = "ours_again"  # one, too: a second crop around the middle of the first one's pose
_NAMED = (OWN_NETWORKS, CROPS_AGAIN)  # methods that are run only where they are named


def noise_name(noise: float) -> str:
    """Return what a noise, a share of the object's longest side, is called in tables: "noise 0.4%"."""
    return f"noise {100 * noise:g}%"


@dataclass(frozen=True)
class EvaluateConfig:
    """What is evaluated."""

    name: str
    source: Source = "bop"
    folder: Path | None = None  # BOP dataset, or clouds with poses
    split: str = "test"  # of the BOP dataset
    cad: Path | None = None  # folder of meshes, of which bins are made in `folder`
    cad_names: tuple[str, ...] = ()  # parts of the names of those to take; all unless given
    object: Path | None = None  # of clouds: the CAD file; the only one in the folder unless given
    camera: Path | None = None  # of depth images among clouds; camera.json in the folder unless given
    sensor: str | None = None  # of clouds: X,Y,Z in their frame; the origin unless given
    units: Literal["mm", "cm", "m", "in"] = "mm"  # of clouds and their poses
    objects: tuple[str, ...] = ()  # names of those to take; all unless given
    images: int | None = None  # of each object, evenly spread
    crops: int = 100  # of each object and noise
    noise: tuple[float, ...] = (0.0, 0.01, 0.05)  # share of the object's longest side
    methods: tuple[str, ...] = METHODS
    weights: str = RELEASED  # released network, or a .safetensors file
    random_seed: int = 0

    def __post_init__(self) -> None:
        """Refuse what cannot be evaluated."""
        if self.crops < 1 or (self.images is not None and self.images < 1):
            raise InputError(f"crops = {self.crops} and images = {self.images} must be 1 or more")
        if self.random_seed < 0:
            raise InputError(f"random_seed is {self.random_seed}, but must be 0 or more")
        if not self.noise or not all(0 <= level < 1 for level in self.noise):
            raise InputError(f"noise is {self.noise}, but must be shares of the object's longest side, 0 to 1")
        if not self.methods:
            raise InputError(f"no method is named: there are {', '.join(METHODS)}")
        for name in self.methods:
            if name not in (*METHODS, *_NAMED):
                raise InputError(f"there is no method {name!r}: there are {', '.join((*METHODS, *_NAMED))}")
        names = {noise_name(level) for level in self.noise}  # of columns; files are named alike
        if len({*self.methods}) < len(self.methods) or len(names) < len(self.noise):
            raise InputError("a method or a noise is named twice")
        if self.sensor is not None:
            _ = self.sensor_place

    @property
    def sensor_place(self) -> np.ndarray | None:
        """The sensor's place as numbers."""
        return None if self.sensor is None else np.array(number_list(self.sensor, "sensor", 3))


_SETS = Path("outputs/test_sets")
_WRS = ("04_37D", "05_PTPA30", "11_PTPA42", "07_SBARB", "08_SSFHRT", "13_APTF40", "14_BGPSL6")

_ALL = (
    EvaluateConfig("electronics", folder=_SETS / "electronics"),
    EvaluateConfig("industrial", folder=_SETS / "industrial"),
    EvaluateConfig("validation", folder=Path("outputs/validation_bins/perfect"), crops=10, random_seed=7),
    EvaluateConfig(
        "per_object",
        folder=_SETS / "industrial",
        objects=("gear_motor", "bearing_housing"),
        methods=("ours", OWN_NETWORKS, "fpfh"),
    ),
    EvaluateConfig("wrs", folder=_SETS / "wrs", cad_names=_WRS),
    EvaluateConfig("clouds", source="clouds", noise=(0.0,)),
    EvaluateConfig("bop", noise=(0.0,)),
    EvaluateConfig(
        "demo",
        folder=Path(__file__).parents[1] / "assets" / "small_test_set",
        crops=40,
        noise=(0.0,),
        methods=("ours", "fpfh", "kiss"),
    ),
)
CONFIGS = {config.name: config for config in _ALL}


def find_config(name: str) -> EvaluateConfig:
    """Return the config of a name. Raises InputError with the nearest names if there is none."""
    if name in CONFIGS:
        return CONFIGS[name]
    near = difflib.get_close_matches(name, CONFIGS, n=2)
    hint = f"did you mean {' or '.join(near)}?" if near else f"there are {', '.join(CONFIGS)}"
    raise InputError(f"there is no evaluation {name!r}: {hint}")
