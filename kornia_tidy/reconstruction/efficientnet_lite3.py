"""EfficientNet-Lite3 as a feature extractor, with the module names and the padding of MiDaS Small's encoder."""

from __future__ import annotations

from torch import Tensor, nn
from torch.nn import functional

EPSILON = 1e-3  # of the batch normalisation, as in TensorFlow


class EfficientNetLite3(nn.Module):
    """Features of an image at 1/4, 1/8, 1/16 and 1/32 of its size.

    Shape:
        - image: (B, 3, H, W), normalised; sides multiples of 32.
        - output: (B, 32, H/4, W/4), (B, 48, H/8, W/8), (B, 136, H/16, W/16), (B, 384, H/32, W/32).

    Source: Tan and Le, EfficientNet (ICML 2019), scaled by 1.2 in width and 1.4 in depth; the "lite" form has no
    squeeze-and-excitation and ReLU6 throughout. Without the classifier.

    Example:
        >>> import torch
        >>> [tuple(x.shape[1:]) for x in EfficientNetLite3().eval()(torch.rand(1, 3, 64, 96))]
        [(32, 16, 24), (48, 8, 12), (136, 4, 6), (384, 2, 3)]
    """

    def __init__(self) -> None:
        super().__init__()
        stem = [_HalvingConv2d(3, 32, 3, stride=2, bias=False), _norm(32), nn.ReLU6(inplace=True)]
        first = nn.Sequential(_DepthwiseSeparable(32, 24))
        self.layer1 = nn.Sequential(*stem, first, _stage(24, 32, repeats=3, kernel=3, stride=2))
        self.layer2 = nn.Sequential(_stage(32, 48, repeats=3, kernel=5, stride=2))
        self.layer3 = nn.Sequential(
            _stage(48, 96, repeats=5, kernel=3, stride=2), _stage(96, 136, repeats=5, kernel=5, stride=1)
        )
        self.layer4 = nn.Sequential(
            _stage(136, 232, repeats=6, kernel=5, stride=2), _stage(232, 384, repeats=1, kernel=3, stride=1)
        )

    def forward(self, image: Tensor) -> list[Tensor]:
        """Return the features, finest first."""
        features = []
        for layer in (self.layer1, self.layer2, self.layer3, self.layer4):
            image = layer(image)
            features.append(image)
        return features


class _DepthwiseSeparable(nn.Module):
    """Depthwise 3x3 convolution, then a pointwise convolution."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.conv_dw = _depthwise(inputs, 3, stride=1)
        self.bn1 = _norm(inputs)
        self.conv_pw = nn.Conv2d(inputs, outputs, 1, bias=False)
        self.bn2 = _norm(outputs)

    def forward(self, x: Tensor) -> Tensor:
        return self.bn2(self.conv_pw(functional.relu6(self.bn1(self.conv_dw(x)), inplace=True)))


class _InvertedResidual(nn.Module):
    """Inverted residual: expansion by six, depthwise convolution, projection; plus the input if the shapes agree."""

    def __init__(self, inputs: int, outputs: int, kernel: int, stride: int) -> None:
        super().__init__()
        inner = 6 * inputs
        self.conv_pw = nn.Conv2d(inputs, inner, 1, bias=False)
        self.bn1 = _norm(inner)
        self.conv_dw = _depthwise(inner, kernel, stride)
        self.bn2 = _norm(inner)
        self.conv_pwl = nn.Conv2d(inner, outputs, 1, bias=False)
        self.bn3 = _norm(outputs)
        self.is_residual = stride == 1 and inputs == outputs

    def forward(self, x: Tensor) -> Tensor:
        inner = functional.relu6(self.bn1(self.conv_pw(x)), inplace=True)
        inner = functional.relu6(self.bn2(self.conv_dw(inner)), inplace=True)
        out = self.bn3(self.conv_pwl(inner))
        return out + x if self.is_residual else out


class _HalvingConv2d(nn.Conv2d):
    """Convolution of stride 2 with TensorFlow's ``SAME`` padding: for even sides one pixel more after than before."""

    def forward(self, input: Tensor) -> Tensor:  # noqa: A002, named by torch
        return super().forward(functional.pad(input, (0, 1, 0, 1)))


def _depthwise(channels: int, kernel: int, stride: int) -> nn.Conv2d:
    kind = nn.Conv2d if stride == 1 else _HalvingConv2d
    return kind(channels, channels, kernel, stride, padding=(kernel - stride) // 2, groups=channels, bias=False)


def _stage(inputs: int, outputs: int, repeats: int, kernel: int, stride: int) -> nn.Sequential:
    first = _InvertedResidual(inputs, outputs, kernel, stride)
    return nn.Sequential(first, *(_InvertedResidual(outputs, outputs, kernel, 1) for _ in range(repeats - 1)))


def _norm(channels: int) -> nn.BatchNorm2d:
    return nn.BatchNorm2d(channels, eps=EPSILON)
