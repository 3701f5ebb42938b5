"""Make network.npz: logits of the dense torch network in float64, for weights and inputs drawn by NumPy.

python -m tests.golden.make_network      (needs torch)
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from tests.reference.clouds import box_cloud, scene_crop

GOLDEN = Path(__file__).with_name("network.npz")
ROWS = np.arange(0, 2048, 32)

_ENCODER = [(12, 64), (64, 64), (128, 64), (64, 64), (128, 64), (192, 1024), (1216, 512)]
_LAYERS = {f"{prefix}{i}": shape for prefix in ("conv_obj", "conv") for i, shape in enumerate(_ENCODER, start=1)}
_LAYERS |= {"conv_obj8": (512, 128), "conv8": (640, 256), "conv8r": (384, 256)}
_LISTS = {"conv6", "conv7", "conv_obj6", "conv_obj7", "conv_obj8"}


def draw_state_dict(seed: int) -> dict[str, np.ndarray]:
    """Return a state dict of the published shapes, GroupNorm weights of both signs."""
    rng = np.random.default_rng(seed)

    def uniform(*shape: int) -> np.ndarray:
        return (2 * rng.random(shape) - 1).astype(np.float32)

    tensors = {}
    for name, (inputs, outputs) in _LAYERS.items():
        ones = (1,) if name in _LISTS else (1, 1)
        tensors[f"{name}.0.weight"] = uniform(outputs, inputs, *ones) * np.float32((6 / inputs) ** 0.5)
        scale = uniform(outputs)
        tensors[f"{name}.1.weight"] = np.where(scale < 0, scale - np.float32(0.5), scale + np.float32(0.5))
        tensors[f"{name}.1.bias"] = np.float32(0.5) * uniform(outputs)
    tensors["conv9.0.weight"] = uniform(2, 256, 1) * np.float32(0.1)
    tensors["conv10.0.weight"] = uniform(1, 256, 1, 1) * np.float32(0.1)
    return tensors


def draw_inputs(seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return a crop (2048, 6), an object cloud (2048, 6) and 20 keypoint indices."""
    return scene_crop(seed, 2048), box_cloud(seed + 50, 2048), np.arange(20) * 100 + 7


def main() -> None:
    """Run the dense network and write the file."""
    import torch

    from benchmarks.reference.dense_torch import DenseKeyMatchNet

    network = DenseKeyMatchNet().eval().double()
    network.load_state_dict({name: torch.from_numpy(tensor) for name, tensor in draw_state_dict(0).items()})
    crop, cloud, keypoints = draw_inputs(0)
    crop, cloud = crop.astype(np.float64), cloud.astype(np.float64)
    cloud = cloud - cloud.mean(axis=0)
    with torch.no_grad():
        inputs = [torch.from_numpy((x / x.std()).T[None].copy()) for x in (crop, cloud)]
        outputs = network(*inputs, torch.from_numpy(keypoints))
    named = dict(zip(("segmentation", "keypoints"), (x.numpy() for x in outputs), strict=True))
    ranges = {f"{name}_range": np.ptp(values) for name, values in named.items()}
    np.savez_compressed(GOLDEN, **{name: values[ROWS] for name, values in named.items()}, **ranges)
    print(f"wrote {GOLDEN.name}: {ranges}")


if __name__ == "__main__":
    main()
