"""Architecture of the networks.

The keypoint network has a small residual encoder of plain 3×3 convolutions. The segmenter has the encoder of
EfficientNet-lite0, whose weights were trained on a million photographs. The export folds batch normalisation into the
convolutions.

EfficientNet-lite0 was trained on the photographs of ImageNet. A segmenter with this encoder transfers better from
simulated to real footage than a segmenter that has seen simulated footage only.
"""

# pyright: reportMissingImports=false

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

from torch import Tensor, nn
from torch.nn import functional

EFFICIENTNET_WIDTHS = 16, 24, 40, 112, 320
"""Channels of the encoder of EfficientNet-lite0 at strides 2, 4, 8, 16, 32."""
_EFFICIENTNET_BLOCKS = (
    ((1, 1, 16, 3, 1),),
    ((2, 6, 24, 3, 2),),
    ((2, 6, 40, 5, 2),),
    ((3, 6, 80, 3, 2), (3, 6, 112, 5, 1)),
    ((4, 6, 192, 5, 2), (1, 6, 320, 3, 1)),
)
"""For each stride: number of blocks, expansion, channels, side of the kernel, stride of the first block."""
_PHOTOGRAPH_MEAN, _PHOTOGRAPH_SCALE = 127 / 255, 128 / 255
"""Mean and scale of the pictures in the training of EfficientNet-lite0, values within 0 and 1."""


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


def residual_stages(widths: Sequence[int], blocks: Sequence[int]) -> list[nn.Module]:
    """Create an encoder of 3×3 convolutions: a stage for each of the strides 2, 4, 8, …

    On a CPU, few plain channels are faster than the depthwise convolutions of mobile networks.

    Args:
        widths: channels of each stage.
        blocks: residual blocks of each stage.
    """
    before = [3, *widths[:-1]]
    return [
        nn.Sequential(_convolution(i, o, stride=2), *(_Residual(o) for _ in range(n)))
        for i, o, n in zip(before, widths, blocks, strict=True)
    ]


class _PhotographInput(nn.Module):
    """Pictures of blue, green, red within 0 and 1 in the range of EfficientNet-lite0."""

    def forward(self, x: Tensor) -> Tensor:
        return (x - _PHOTOGRAPH_MEAN) / _PHOTOGRAPH_SCALE


class _InvertedResidual(nn.Module):
    """Wide depthwise convolution between two narrow ends, with a shortcut (Sandler et al. 2018)."""

    def __init__(self, inputs: int, outputs: int, expansion: int, side: int, stride: int):
        super().__init__()
        wide = inputs * expansion
        expand = [] if expansion == 1 else [*_mobile_convolution(inputs, wide, 1), nn.ReLU6(inplace=True)]
        depthwise = [*_mobile_convolution(wide, wide, side, stride, wide), nn.ReLU6(inplace=True)]
        self.body = nn.Sequential(*expand, *depthwise, *_mobile_convolution(wide, outputs, 1))
        self.has_shortcut = stride == 1 and inputs == outputs

    def forward(self, x: Tensor) -> Tensor:
        return x + self.body(x) if self.has_shortcut else self.body(x)


def _mobile_convolution(inputs: int, outputs: int, side: int, stride: int = 1, groups: int = 1) -> Iterator[nn.Module]:
    """Yield a convolution with TensorFlow's padding, which is asymmetric for a stride of 2."""
    pad = side // 2
    if stride == 2:
        yield nn.ZeroPad2d((pad - 1, pad, pad - 1, pad))
        pad = 0
    yield nn.Conv2d(inputs, outputs, side, stride, pad, groups=groups)


def efficientnet_stages() -> list[nn.Module]:
    """Create the encoder of EfficientNet-lite0: a stage for each of the strides 2, 4, 8, 16, 32.

    The convolutions have a bias in place of the batch normalisation, so that mean and variance stay those of the
    photographs, and a training is faster.

    Source: Tan and Le 2019, EfficientNet; the lite variants have no squeeze-and-excitation, and ReLU6 instead of swish.
    """
    stages, inputs = [], 32
    for blocks in _EFFICIENTNET_BLOCKS:
        layers: list[nn.Module] = []
        for count, expansion, outputs, side, stride in blocks:
            for n in range(count):
                layers.append(_InvertedResidual(inputs, outputs, expansion, side, stride if n == 0 else 1))
                inputs = outputs
        stages.append(layers)
    stages[0] = [_PhotographInput(), *_mobile_convolution(3, 32, 3, 2), nn.ReLU6(inplace=True), *stages[0]]
    return [nn.Sequential(*layers) for layers in stages]


class FeaturePyramid(nn.Module):
    """A network from pictures to maps of lower resolution, with sums of features from coarse to fine.

    The stride of the output is 2 to the power of len(widths) − len(top_down).

    Args:
        stages: the encoder: modules that halve the resolution, one after another.
        widths: channels of each stage.
        top_down: channels of the top-down path, from the second coarsest stride to the stride of the output.
        heads: name → channels of each output map.
        fixed_stages: number of stages, from the first, whose weights are not trained.
        encoder_rate: learning rate of the encoder, as a share of the learning rate of all other layers.

    Source: after Lin et al. 2017, Feature Pyramid Networks.
    """

    def __init__(
        self,
        stages: Sequence[nn.Module],
        widths: Sequence[int],
        top_down: Sequence[int],
        heads: dict[str, int],
        fixed_stages: int = 0,
        encoder_rate: float = 1.0,
    ):
        super().__init__()
        self._encoder_rate = encoder_rate
        self.down = nn.ModuleList(stages)
        for stage in stages[:fixed_stages]:
            stage.requires_grad_(False)
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

    def parameter_groups(self) -> list[dict[str, Any]]:
        """Return all parameters in groups for an optimiser, each with its `share` of the learning rate."""
        others = [self.lateral, self.reduce, self.merge, self.heads]
        return [
            {"params": list(self.down.parameters()), "share": self._encoder_rate},
            {"params": [p for part in others for p in part.parameters()], "share": 1.0},
        ]
