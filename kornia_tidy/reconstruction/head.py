"""Base class of reconstruction networks, which take images of any size and return maps of the same size."""

from __future__ import annotations

import copy
import inspect
import warnings
from abc import ABC, abstractmethod

from torch import Tensor, nn
from torch.nn import functional

from kornia_tidy.checks import check_count, check_float_tensor
from kornia_tidy.mode import Mode, torch_mode
from kornia_tidy.optics.units import check_head_image, layout_remedy


class ReconstructionHead(nn.Module, ABC):
    """Base class of reconstruction networks: checks, padding to multiples of ``stride``, and cropping.

    A subclass defines ``stride`` and :meth:`predict`.

    Args:
        in_channels: channels of the image.
        out_channels: maps to estimate.

    Shape:
        - image: (B, in_channels, H, W), of any size.
        - output: (B, out_channels, H, W).

    Raises:
        ValueError: if the image has another rank or number of channels, or a number of channels is not positive.
        TypeError: if the image is not a floating-point tensor.

    Convention:
        - Captures are in [0, 1]. If the first image is in 0..255 or normalised, a warning is given.
        - An image with other sides than multiples of ``stride`` is padded equally on both sides, and the result is
          cropped. The padding is by reflection, which adds no edges; if a side is too short for that, by replication.
        - An ONNX export is for the image size it was made with; the batch size may be dynamic.
    """

    stride: int
    whole_image = False  # True if each output depends on the whole image, which then cannot be tiled
    seamless = False  # True if tests show that tiles equal the whole; other networks are measured, for seconds
    range_checked = False

    def __init__(self, in_channels: int, out_channels: int) -> None:
        super().__init__()
        check_count("in_channels", in_channels)
        check_count("out_channels", out_channels)
        self.in_channels = in_channels
        self.out_channels = out_channels

    def forward(self, image: Tensor) -> Tensor:
        """Return the estimated maps, (B, out_channels, H, W)."""
        self.check_image(image)
        return self.on_grid(image)

    def check_image(self, image: Tensor) -> None:
        """Raise an error for an image of another type, rank or number of channels; warn of the range of the first."""
        check_float_tensor("image", image, 4, "(B, C, H, W)")
        if image.shape[1] != self.in_channels:
            remedy = layout_remedy(tuple(image.shape), self.in_channels)
            raise ValueError(f"image must have {self.in_channels} channels, got {image.shape[1]}{remedy}")
        if not self.range_checked and Mode.GRAPH not in torch_mode():
            self.range_checked = True  # for the first image only, as the check waits for the device
            if (said := check_head_image(image)) is not None:
                warnings.warn(said, stacklevel=5)

    def on_grid(self, image: Tensor) -> Tensor:
        """Return the maps of an image that is padded to multiples of ``stride``, cropped to its size."""
        height, width = image.shape[-2:]
        (left, right, top, bottom), mode = border_padding((height, width), self.stride)
        if bottom or right:
            image = functional.pad(image, (left, right, top, bottom), mode)
        return self.predict(image)[..., top : top + height, left : left + width]

    @abstractmethod
    def predict(self, image: Tensor) -> Tensor:
        """Return the maps, (B, out_channels, H, W), of an image with sides that are multiples of ``stride``."""

    def reset_parameters(self) -> None:
        """Initialise all parameters, by the global generator.

        Convolutions get He's normal weights, which keep the variance from layer to layer through ReLUs, and zero
        biases; batch normalisation gets scale one, shift zero and initial statistics.

        Source: He et al., Delving Deep into Rectifiers (ICCV 2015), equation 10.
        """
        for module in self.modules():
            if isinstance(module, nn.Conv2d | nn.ConvTranspose2d):
                if not module.weight.is_meta:  # normal_ without memory would import torch's compiler, for seconds
                    nn.init.kaiming_normal_(module.weight, nonlinearity="relu")
                if module.bias is not None:
                    nn.init.zeros_(module.bias)
            elif isinstance(module, nn.BatchNorm2d):
                module.reset_parameters()


def takes_noise(head: nn.Module) -> bool:
    """Return whether a network is conditioned on the noise: it takes ``noise`` beside the capture.

    Example:
        >>> from kornia_tidy.reconstruction.closed_form_head import ClosedFormHead
        >>> takes_noise(ClosedFormHead()), takes_noise(nn.Conv2d(3, 3, 1))
        (True, False)
    """
    return "noise" in inspect.signature(head.forward).parameters


def sharing_weights(head: nn.Module) -> nn.Module:
    """Return a copy of a network that shares its parameters and buffers.

    Example:
        >>> head = nn.Conv2d(3, 3, 1)
        >>> copied = sharing_weights(head)
        >>> copied is head, copied.weight is head.weight
        (False, True)
    """
    return copy.deepcopy(head, {id(tensor): tensor for tensor in (*head.parameters(), *head.buffers())})


def border_padding(size: tuple[int, int], multiple: int) -> tuple[tuple[int, int, int, int], str]:
    """Return the padding (left, right, top, bottom) of an image to multiples of a number of pixels, and its mode.

    Example:
        >>> border_padding((13, 32), 16)
        ((0, 0, 1, 2), 'reflect')
    """
    height, width = size
    missing_rows, missing_columns = -height % multiple, -width % multiple
    top, left = missing_rows // 2, missing_columns // 2
    bottom, right = missing_rows - top, missing_columns - left
    return (left, right, top, bottom), "reflect" if bottom < height and right < width else "replicate"
