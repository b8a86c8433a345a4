"""Simulated raw captures: what a given camera's raw file would hold of a scene, to train and test for that camera.

The camera is a :class:`RawCapture` whose counts do not matter: one of its files, or :meth:`RawCapture.from_counts`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from kornia_tidy.checks import check_choice, check_finite, check_float_tensor
from kornia_tidy.raw.capture import RawCapture
from kornia_tidy.raw.color import camera_to_srgb
from kornia_tidy.raw.filter_array import tiled
from kornia_tidy.sensor.noise import SensorNoise

COLORS = ("camera", "channels")


def simulate_raw(
    light: Tensor,
    camera: RawCapture,
    noise: SensorNoise | None = None,
    *,
    color: str = "camera",
    generator: torch.Generator | None = None,
) -> RawCapture:
    """Return the raw capture that a camera makes of an image on its sensor.

    Args:
        light: (3, H, W), or (1, H, W) for a camera without colours, linear; see :func:`sensor_counts`.
        camera: whose filter array, levels and colours the capture gets; its own counts are not looked at.
        noise: its noise, :meth:`~kornia_tidy.calibration.noise.photon_transfer.PhotonTransfer.sensor_noise`; None for
            none.
        color: as for :func:`sensor_counts`.
        generator: where random numbers come from. Default: the global generator.

    Raises:
        TypeError: if the light is not a floating-point tensor.
        ValueError: if its shape does not fit, a value is not finite, or the camera's colours are not known.

    Example:
        >>> camera = RawCapture.from_counts(torch.zeros(1, 2, 2), "RGGB", black=64, white=1023)
        >>> raw = simulate_raw(torch.tensor([0.0, 0.5, 1.0]).view(3, 1, 1).expand(3, 2, 2), camera, color="channels")
        >>> raw.counts.tolist()
        [[[64, 544], [544, 1023]]]
    """
    check_float_tensor("light", light, 3, "(C, H, W)")
    counts = sensor_counts(light[None], camera, noise, color=color, generator=generator)[0]
    counts = counts.detach().to(torch.int32)
    return replace(camera, counts=counts, flip=0, info=replace(camera.info, timestamp=None))


def simulate_scene(
    image: Tensor,
    depth: Tensor,
    optics: Callable[[Tensor, Tensor], Tensor],
    camera: RawCapture,
    noise: SensorNoise | None = None,
    *,
    color: str = "camera",
    generator: torch.Generator | None = None,
) -> RawCapture:
    """Return the raw capture that a camera behind given optics makes of a scene with depth.

    Args:
        image: (3, H, W) or (1, H, W), encoded as the optics take it.
        depth: (1, H, W), metres.
        optics: a :class:`~kornia_tidy.camera.tidy_optics.TiDyOptics` with ``sensor=None``, as the camera is the sensor.
        camera: as for :func:`simulate_raw`, with
        noise: its noise,
        color: its colours, and
        generator: the random numbers.

    Raises:
        ValueError: if the optics have a sensor of their own; and as :func:`simulate_raw` and the optics do.

    Example:
        >>> from kornia_tidy import TiDyOptics
        >>> camera = RawCapture.from_counts(torch.zeros(1, 2, 2), "RGGB", black=64, white=1023)
        >>> optics = TiDyOptics(sensor=None)
        >>> scene = torch.rand(3, 96, 96), torch.full((1, 96, 96), 0.7)
        >>> simulate_scene(*scene, optics, camera, SensorNoise.physical(10500, 2.4), color="channels").counts.shape
        torch.Size([1, 96, 96])
    """
    lens: Any = optics
    if lens.sensor is not None:
        raise ValueError("optics must have sensor=None, as the noise is the camera's: TiDyOptics(..., sensor=None)")
    with torch.no_grad():
        light = lens.decode(lens(image, depth)[None])[0]
    return simulate_raw(light, camera, noise, color=color, generator=generator)


def sensor_counts(
    light: Tensor,
    camera: RawCapture,
    noise: SensorNoise | None = None,
    *,
    color: str = "camera",
    generator: torch.Generator | None = None,
) -> Tensor:
    r"""Return a camera's counts of images on its sensor, as whole numbers with a gradient.

    .. math:: n = \mathrm{round}\left( n_{black} + (n_{white} - n_{black}) \, x \right)

    with x the noisy light behind a pixel's filter, cut to 0 and the white level. Noise around black is kept, as cameras
    do, and saturated pixels have the white level to the count.

    Args:
        light: (B, 3, H, W), or (B, 1, H, W) for a camera without colours, linear, 1.0 saturates.
        camera: whose filter array, levels and colours are meant.
        noise: shot noise and read noise; its bits and its clipping are not used, the camera's levels are. None: none.
        color: ``"camera"``: the light is linear sRGB, and is seen through the camera's filters, by its matrix and its
            white balance, so that white of 1.0 saturates the most sensitive channel, and developing the capture gives
            the light back. ``"channels"``: red, green and blue of the light are the camera's own, unbalanced.
        generator: where random numbers come from, eager only. Default: the global generator.

    Returns:
        (B, 1, H, W) behind a filter array, else (B, C, H, W); float32 or wider.

    Convention:
        - Gradient: straight through rounding, zero where a count is cut.
        - Filters whose response to a colour would be negative, which a matrix can say, see no light.
    """
    check_float_tensor("light", light, 4, "(B, C, H, W)")
    check_choice("color", color, COLORS)
    wanted = 1 if not camera.colors else 3
    if light.shape[1] != wanted or light.numel() == 0:
        raise ValueError(
            f"light must have shape (B, {wanted}, H, W) for a camera of the colors {camera.colors!r}, got "
            f"{tuple(light.shape)}"
        )
    check_finite("light", light)
    seen = light.to(torch.promote_types(light.dtype, torch.float32))
    if camera.colors:
        seen = torch.einsum("kc,bchw->bkhw", _responses(camera, color).to(seen), seen).clamp(min=0)
    height, width = light.shape[-2:]
    black = camera.black.to(seen)[:, None, None]
    if camera.pattern is not None:
        index = tiled(torch.tensor(camera.pattern, device=seen.device), height, width)
        seen = seen.gather(1, index.expand(len(seen), 1, -1, -1))
        black = tiled(camera.black.to(seen), height, width)
    if noise is not None:
        plain = SensorNoise(noise.sigma, full_well=noise.full_well, dark=noise.dark, clip=False)
        seen = plain(seen, generator=generator)
    counts = black + (camera.white - black) * seen
    rounded = counts.detach().round() + (counts - counts.detach())
    return rounded.clamp(0, int(camera.white))


def _responses(camera: RawCapture, color: str) -> Tensor:
    """What each channel of ``camera.colors`` sees of red, green and blue light, (channels, 3)."""
    letters = "".join(dict.fromkeys(camera.colors))
    rows = [letters.index(letter) for letter in camera.colors]
    if color == "channels":
        if letters != "RGB":
            raise ValueError(f"color='channels' needs a camera of red, green and blue, this has {letters!r}")
        return torch.eye(3)[rows]
    if camera.camera_to_srgb is not None:
        balanced = camera.camera_to_srgb.double().cpu().pinverse()
    elif camera.xyz_to_camera is not None:
        balanced = camera_to_srgb(camera.xyz_to_camera.double().cpu())[0].pinverse()
    else:
        raise ValueError(
            "the camera's colors are unknown, it carries no matrix: choose color='channels', or give it one with "
            "dataclasses.replace(camera, xyz_to_camera=...)"
        )
    balanced = balanced / balanced.sum(1, keepdim=True)  # white gives 1 in each
    balance = camera.daylight_balance if camera.white_balance is None else camera.white_balance
    if balance is None:
        return balanced[rows]
    sensitivity = 1 / balance.double().cpu()
    return balanced[rows] * (sensitivity / sensitivity.max())[:, None]
