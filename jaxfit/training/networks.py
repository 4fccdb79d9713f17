"""The architecture of both built-in networks: a small residual encoder with a top-down feature pyramid.

The convolutions are plain 3×3 convolutions with few channels. On a CPU they are faster than the depthwise convolutions
of mobile networks, which are limited by memory bandwidth. The export folds batch normalisation into the convolutions.
"""

# pyright: reportMissingImports=false

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor, nn
from torch.nn import functional

__all__ = ["FeaturePyramid", "count_parameters"]


class _Residual(nn.Module):
    """Two 3×3 convolutions with a shortcut (He et al. 2016)."""

    def __init__(self, channels: int):
        super().__init__()
        self.body = nn.Sequential(_convolution(channels, channels), nn.Conv2d(channels, channels, 3, 1, 1, bias=False))
        self.norm = nn.BatchNorm2d(channels)

    def forward(self, x: Tensor) -> Tensor:
        return functional.relu(x + self.norm(self.body(x)))


def _convolution(inputs: int, outputs: int, stride: int = 1, side: int = 3) -> nn.Sequential:
    layer = nn.Conv2d(inputs, outputs, side, stride, side // 2, bias=False)
    return nn.Sequential(layer, nn.BatchNorm2d(outputs), nn.ReLU(inplace=True))


class FeaturePyramid(nn.Module):
    """A network from pictures to maps of lower resolution, with sums of features from coarse to fine.

    The stride of the output is 2 to the power of len(widths) − len(top_down).

    Args:
        widths: channels at strides 2, 4, 8, …
        blocks: residual blocks at each of these strides.
        top_down: channels of the top-down path, from the second coarsest stride to the stride of the output.
        heads: name → channels of each output map.

    Source: after Lin et al. 2017, Feature Pyramid Networks.
    """

    def __init__(self, widths: Sequence[int], blocks: Sequence[int], top_down: Sequence[int], heads: dict[str, int]):
        super().__init__()
        before = [3, *widths[:-1]]
        self.down = nn.ModuleList(
            nn.Sequential(_convolution(i, o, stride=2), *(_Residual(o) for _ in range(n)))
            for i, o, n in zip(before, widths, blocks, strict=True)
        )
        skips = widths[-2::-1][: len(top_down)]
        coarser = [widths[-1], *top_down[:-1]]
        self.lateral = nn.ModuleList(_convolution(i, o, side=1) for i, o in zip(skips, top_down, strict=True))
        self.reduce = nn.ModuleList(_convolution(i, o, side=1) for i, o in zip(coarser, top_down, strict=True))
        self.merge = nn.ModuleList(_convolution(o, o) for o in top_down)
        last = top_down[-1]
        self.heads = nn.ModuleDict({name: nn.Conv2d(last, channels, 3, 1, 1) for name, channels in heads.items()})

    def forward(self, pictures: Tensor) -> dict[str, Tensor]:
        """Compute the output maps by name.

        Args:
            pictures: (B, 3, H, W), normalised; H and W are multiples of the coarsest stride.
        """
        features, x = [], pictures
        for stage in self.down:
            x = stage(x)
            features.append(x)
        for skip, lateral, reduce, merge in zip(features[-2::-1], self.lateral, self.reduce, self.merge, strict=False):
            x = functional.interpolate(reduce(x), scale_factor=2.0, mode="nearest")
            x = merge(x + lateral(skip))
        return {name: head(x) for name, head in self.heads.items()}


def count_parameters(network: nn.Module) -> int:
    """Count the trainable parameters."""
    return sum(p.numel() for p in network.parameters())
