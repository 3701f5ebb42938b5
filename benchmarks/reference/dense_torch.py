"""The published network as a plain dense torch module: the reference for shapes, checkpoints and time.

Written from the published description (arXiv 2303.16102, section III): edge features are concatenated,
the N x K pair tensor is formed, nothing is shared. One example at a time, channels first, as torch has it.
"""

from __future__ import annotations

import torch
from torch import nn

LEAK = 0.2


def layer(inputs: int, outputs: int, dims: int) -> nn.Sequential:
    convolution = nn.Conv1d if dims == 1 else nn.Conv2d
    return nn.Sequential(convolution(inputs, outputs, 1, bias=False), nn.GroupNorm(32, outputs), nn.LeakyReLU(LEAK))


def neighbours(features: torch.Tensor, k: int) -> torch.Tensor:
    """(1, c, n) -> (n, k) indices of the nearest columns, the column itself included."""
    rows = features[0].T
    squares = (rows**2).sum(dim=1)
    return (2 * rows @ rows.T - squares[:, None] - squares[None, :]).topk(k).indices


def edges(features: torch.Tensor, graph: torch.Tensor) -> torch.Tensor:
    """(1, c, n), (m, k) -> (1, 2c, m, k), the first m columns being the centres."""
    neighbour = features[:, :, graph]
    centre = features[:, :, : graph.shape[0], None].expand_as(neighbour)
    return torch.cat([neighbour - centre, centre], dim=1)


class DenseKeyMatchNet(nn.Module):
    """Published shapes; parameter names are those of the released checkpoints."""

    def __init__(self, k: int = 20, dropout: float = 0.4) -> None:
        super().__init__()
        self.k = k
        for prefix in ("conv_obj", "conv"):
            for index, (inputs, outputs) in enumerate(
                [(12, 64), (64, 64), (128, 64), (64, 64), (128, 64), (192, 1024), (1216, 512)], start=1
            ):
                self.add_module(f"{prefix}{index}", layer(inputs, outputs, 2 if index < 6 else 1))
        self.conv_obj8 = layer(512, 128, 1)
        self.conv8 = layer(640, 256, 2)
        self.conv8r = layer(384, 256, 2)
        self.conv9 = nn.Sequential(nn.Conv1d(256, 2, 1, bias=False))
        self.conv10 = nn.Sequential(nn.Conv2d(256, 1, 1, bias=False))
        self.obj_dp1, self.obj_dp2, self.dp1, self.dp2 = (nn.Dropout(dropout) for _ in range(4))

    def draw(self, seed: int) -> DenseKeyMatchNet:
        """Draw all parameters, GroupNorm weights of both signs, so that no symmetry hides a mistake."""
        generator = torch.Generator().manual_seed(seed)
        for name, parameter in self.named_parameters():
            if name.endswith("1.weight"):
                size = 0.5 + torch.rand(parameter.shape, generator=generator)
                sign = torch.where(torch.rand(parameter.shape, generator=generator) < 0.4, -1.0, 1.0)
                parameter.data = size * sign
            elif name.endswith("1.bias"):
                parameter.data = 0.3 * torch.randn(parameter.shape, generator=generator)
            else:
                fan_in = parameter.shape[1]
                parameter.data = torch.randn(parameter.shape, generator=generator) * (2 / fan_in) ** 0.5
        return self

    def branch(
        self, prefix: str, cloud: torch.Tensor, keypoints: torch.Tensor | None, graphs: list | None
    ) -> torch.Tensor:
        def conv(index: int, x: torch.Tensor) -> torch.Tensor:
            return getattr(self, f"{prefix}{index}")(x)

        graph = neighbours(cloud[:, :3], self.k) if graphs is None else graphs[0]
        x1 = conv(2, conv(1, edges(cloud, graph))).amax(-1)
        graph = neighbours(x1, self.k) if graphs is None else graphs[1]
        features = edges(x1, graph)
        if keypoints is not None:  # only the keypoints' rows go on
            x1, features = x1[:, :, keypoints], features[:, :, keypoints]
        x2 = conv(4, conv(3, features)).amax(-1)
        graph = neighbours(x2, min(self.k, x2.shape[-1])) if graphs is None else graphs[2]
        x3 = conv(5, edges(x2, graph)).amax(-1)
        local = torch.cat([x1, x2, x3], dim=1)
        overall = conv(6, local).amax(-1, keepdim=True).expand(-1, -1, local.shape[-1])
        return conv(7, torch.cat([overall, local], dim=1))

    def encode_object(self, cloud: torch.Tensor, keypoints: torch.Tensor, graphs: list | None = None) -> torch.Tensor:
        """(1, 6, m), (K,) -> (1, 128, K)."""
        x = self.obj_dp1(self.branch("conv_obj", cloud, keypoints, graphs))
        return self.obj_dp2(self.conv_obj8(x))

    def encode_scene(self, cloud: torch.Tensor, graphs: list | None = None) -> torch.Tensor:
        """(1, 6, n) -> (1, 512, n)."""
        return self.branch("conv", cloud, None, graphs)

    def match(self, scene: torch.Tensor, part: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """(1, 512, n), (1, 128, K) -> segmentation (n, 2), keypoints (n, K)."""
        n, count = scene.shape[-1], part.shape[-1]
        part = part[:, :, None, :].expand(-1, -1, n, -1)
        x = self.conv8(torch.cat([scene[..., None].expand(-1, -1, -1, count), part], dim=1)).amax(-1, keepdim=True)
        x = self.dp1(x)
        x = self.dp2(self.conv8r(torch.cat([x.expand(-1, -1, -1, count), part], dim=1)))
        return self.conv9(x.amax(-1))[0].T, self.conv10(x)[0, 0]

    def forward(
        self,
        scene_cloud: torch.Tensor,
        object_cloud: torch.Tensor,
        keypoints: torch.Tensor,
        scene_graphs: list | None = None,
        object_graphs: list | None = None,
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Clouds (1, 6, n) and (1, 6, m), already normalised; returns segmentation (n, 2), keypoints (n, K)."""
        part = self.encode_object(object_cloud, keypoints, object_graphs)
        return self.match(self.encode_scene(scene_cloud, scene_graphs), part)
