"""MiDaS Small, a network for monocular depth, with the module names of the published weights."""

from __future__ import annotations

import io
import os
import zipfile
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from kornia_tidy.files import read_bytes
from kornia_tidy.reconstruction.efficientnet_lite3 import EfficientNetLite3
from kornia_tidy.reconstruction.head import ReconstructionHead

IMAGE_MEAN = (0.485, 0.456, 0.406)  # of red, green and blue of ImageNet, on which the encoder was trained
IMAGE_DEVIATION = (0.229, 0.224, 0.225)


class MiDaSSmall(ReconstructionHead):
    """MiDaS 2.1 Small: an EfficientNet-Lite3 encoder, and a decoder that fuses its four scales from coarse to fine.

    Args:
        out_channels: maps to estimate; the published weights have 1.

    Shape:
        - image: (B, 3, H, W), RGB in [0, 1], any size; see :class:`ReconstructionHead` for the borders.
        - output: (B, out_channels, H, W), not negative.

    Convention:
        - The image is normalised inside, by ImageNet's mean and deviation. The published weights were trained on
          pictures with 256 pixels along the shorter side and return inverse depth up to an unknown scale and shift:
          larger is nearer. The output of a network that is trained further depends on its training.
        - ``state_dict()`` has the published names, shapes and order. One of its units, in the coarsest fusion, is
          never used. It is frozen, so that optimisers and distributed training do not wait for its gradient.
        - Initial weights are those of :meth:`reset_parameters`; :func:`load_midas_small` loads trained weights.

    Source: Ranftl et al., Towards Robust Monocular Depth Estimation (TPAMI 2022); the small network of release 2.1.

    Example:
        >>> head = MiDaSSmall().eval()
        >>> head(torch.rand(1, 3, 50, 70)).shape
        torch.Size([1, 1, 50, 70])
    """

    stride = 32

    def __init__(self, out_channels: int = 1) -> None:
        super().__init__(3, out_channels)
        self.pretrained = EfficientNetLite3()
        self.scratch = _Decoder(out_channels)
        self.reset_parameters()

    def predict(self, image: Tensor) -> Tensor:
        """Return the maps of an image with sides that are multiples of 32."""
        constants = zip(image.split(1, 1), IMAGE_MEAN, IMAGE_DEVIATION, strict=True)
        normalised = torch.cat([(colour - mean) / deviation for colour, mean, deviation in constants], 1)
        return self.scratch(*self.pretrained(normalised))

    def reset_parameters(self) -> None:
        """Initialise all parameters, by the global generator.

        The encoder is initialised as in :meth:`ReconstructionHead.reset_parameters`. The decoder has no normalisation:
        its residual units start as the identity, and its other convolutions keep the variance of their input. The last
        layer starts with small weights and a bias of 1/2, as the final ReLU has no gradient below zero.

        Source: zero residual units: Goyal et al., Accurate, Large Minibatch SGD (2017), section 5.1.
        """
        super().reset_parameters()
        for module in self.scratch.modules():
            if isinstance(module, nn.Conv2d):
                nn.init.kaiming_normal_(module.weight, nonlinearity="linear")
            if isinstance(module, _ResidualUnit):
                nn.init.zeros_(module.conv2.weight)
        last = self.scratch.output_conv[4]
        assert isinstance(last, nn.Conv2d)
        nn.init.normal_(last.weight, std=0.01)
        assert last.bias is not None
        nn.init.constant_(last.bias, 0.5)


class _Decoder(nn.Module):
    """Decoder: projects the four scales to 64, 128, 256 and 512 channels and fuses them from coarse to fine."""

    def __init__(self, out_channels: int) -> None:
        super().__init__()
        self.layer1_rn = nn.Conv2d(32, 64, 3, padding=1, bias=False)
        self.layer2_rn = nn.Conv2d(48, 128, 3, padding=1, bias=False)
        self.layer3_rn = nn.Conv2d(136, 256, 3, padding=1, bias=False)
        self.layer4_rn = nn.Conv2d(384, 512, 3, padding=1, bias=False)
        self.refinenet4 = _Fusion(512, 256)
        self.refinenet3 = _Fusion(256, 128)
        self.refinenet2 = _Fusion(128, 64)
        self.refinenet1 = _Fusion(64, 64)
        self.output_conv = nn.Sequential(
            nn.Conv2d(64, 32, 3, padding=1),
            nn.Upsample(scale_factor=2, mode="bilinear"),
            nn.Conv2d(32, 32, 3, padding=1),
            nn.ReLU(inplace=True),
            nn.Conv2d(32, out_channels, 1),
            nn.ReLU(inplace=True),
        )
        self.refinenet4.resConfUnit1.requires_grad_(False)  # unused: the coarsest scale has no coarser path

    def forward(self, fine: Tensor, medium: Tensor, coarse: Tensor, coarsest: Tensor) -> Tensor:
        path = self.refinenet4(self.layer4_rn(coarsest))
        path = self.refinenet3(self.layer3_rn(coarse), path)
        path = self.refinenet2(self.layer2_rn(medium), path)
        path = self.refinenet1(self.layer1_rn(fine), path)
        return self.output_conv(path)


class _Fusion(nn.Module):
    """Fusion: adds one scale of the encoder to the coarser path, if there is one, refines it and doubles its size."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.out_conv = nn.Conv2d(inputs, outputs, 1)
        self.resConfUnit1 = _ResidualUnit(inputs)
        self.resConfUnit2 = _ResidualUnit(inputs)

    def forward(self, features: Tensor, path: Tensor | None = None) -> Tensor:
        if path is not None:
            features = path + self.resConfUnit1(features)
        # A 1x1 convolution commutes with interpolation; before it, it takes a quarter of the multiplications.
        mixed = self.out_conv(self.resConfUnit2(features))
        return functional.interpolate(mixed, scale_factor=2.0, mode="bilinear", align_corners=True)


class _ResidualUnit(nn.Module):
    """Residual unit: its input plus two 3x3 convolutions with ReLUs."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(channels, channels, 3, padding=1)
        self.conv2 = nn.Conv2d(channels, channels, 3, padding=1)

    def forward(self, x: Tensor) -> Tensor:
        return x + self.conv2(functional.relu(self.conv1(functional.relu(x)), inplace=True))


def load_midas_small(path: str | os.PathLike[str]) -> MiDaSSmall:
    """Load published weights of MiDaS Small from a local file, such as ``midas_v21_small_256.pt``.

    The file is read as data: nothing in it is executed, and nothing is downloaded.

    Args:
        path: file of ``torch.save`` with the state dict, itself or under the key ``"model"``.

    Returns:
        The network on the CPU, in training mode; call ``.eval()`` before use.

    Raises:
        FileNotFoundError: if the file is missing.
        ValueError: if the file holds anything but tensors, or other names or shapes than the network's.

    Source: the release 2.1 of MiDaS by Intel ISL (MIT licence).

    Example:
        >>> from pathlib import Path
        >>> from tempfile import TemporaryDirectory
        >>> with TemporaryDirectory() as folder:
        ...     path = Path(folder) / "midas.pt"
        ...     torch.save(MiDaSSmall().state_dict(), path)
        ...     head = load_midas_small(path)
        >>> head.out_channels
        1
    """
    data = read_bytes(path)
    try:
        _check_archive(data)
        state = torch.load(io.BytesIO(data), map_location="cpu", weights_only=True)
    except Exception as error:  # of any type, for damaged archives and refused pickles
        raise ValueError(
            f"cannot read {path}: it must be a state dict that torch.save wrote, and hold tensors only"
        ) from error
    if isinstance(state, dict) and "model" in state:
        state = state["model"]
    head = MiDaSSmall()
    _check_state(path, state, head.state_dict())
    head.load_state_dict(state)
    return head


def _check_archive(data: bytes) -> None:
    """Raise ``ValueError`` for an archive with compressed parts, which torch.save never writes: they may be bombs."""
    if not zipfile.is_zipfile(io.BytesIO(data)):
        return  # the older format of torch.save
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        if any(part.compress_type != zipfile.ZIP_STORED for part in archive.infolist()):
            raise ValueError("its parts are compressed")


def _check_state(path: str | os.PathLike[str], state: Any, wanted: dict[str, Tensor]) -> None:
    """Raise ``ValueError`` unless a state has exactly the wanted names and shapes."""
    if not isinstance(state, dict):
        raise ValueError(f"cannot read {path}: it must hold a state dict, got {type(state).__name__}")
    if missing := [name for name in wanted if name not in state]:
        raise ValueError(f"cannot read {path}: {len(missing)} of {len(wanted)} weights are missing, first {missing[0]}")
    if unknown := [name for name in state if name not in wanted]:
        raise ValueError(f"cannot read {path}: {len(unknown)} weights are unknown, first {unknown[0]}")
    for name, value in wanted.items():
        shape = tuple(state[name].shape) if isinstance(state[name], Tensor) else type(state[name]).__name__
        if shape != tuple(value.shape):
            raise ValueError(f"cannot read {path}: {name} must have shape {tuple(value.shape)}, got {shape}")
