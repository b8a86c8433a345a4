"""Simulation of raw captures with the filter array, levels, colours and noise of a given camera.

The camera is described by a :class:`RawCapture`, from one of its files or :meth:`RawCapture.from_counts`. The counts of
that capture are not used.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from kornia_tidy.checks import check_choice, check_finite, check_float_tensor
from kornia_tidy.lab.raw.capture import RawCapture
from kornia_tidy.lab.raw.color import camera_to_srgb, srgb_from_xyz
from kornia_tidy.lab.raw.filter_array import tiled
from kornia_tidy.sensor.sensor import SensorNoise

COLORS = ("camera", "channels")


def simulate_raw(
    light: Tensor,
    camera: RawCapture,
    noise: SensorNoise | None = None,
    *,
    color: str = "camera",
    generator: torch.Generator | None = None,
) -> RawCapture:
    """Simulate the raw capture of an image on the sensor.

    Args:
        light: (3, H, W), or (1, H, W) for a monochrome camera, linear; see :func:`sensor_counts`.
        camera: gives the filter array, levels and colours of the capture.
        noise: of the sensor, see
            :meth:`~kornia_tidy.lab.calibration.noise.photon_transfer.PhotonTransfer.sensor_noise`; None for no noise.
        color: as for :func:`sensor_counts`.
        generator: random number generator. Default: the global generator.

    Raises:
        TypeError: if the light is not a floating-point tensor.
        ValueError: if its shape does not fit, a value is not finite, or the camera's colours are unknown.

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


def simulated_sensor(pattern: str = "RGGB", bits: int = 12, black: float | None = None) -> RawCapture:
    """Return a sensor that is described in words, as the ``camera`` of a simulation.

    Its colours are declared to be those of the picture, so that a raw developer reproduces them.

    Args:
        pattern: colours of the filter array's tile, by rows.
        bits: of the converter; white is 2^bits - 1.
        black: count without light. Default: 2^bits / 16.

    Raises:
        ValueError: if the filter array is unknown, or black is not below white.

    Example:
        >>> sensor = simulated_sensor("GBRG", bits=14)
        >>> sensor.white, sensor.colors
        (16383.0, 'RGBG')
    """
    dark = 2**bits // 16 if black is None else black
    camera = RawCapture.from_counts(torch.zeros(1, 2, 2), pattern, dark, 2**bits - 1)
    if set(camera.colors) != set("RGB"):
        return camera
    return replace(camera, xyz_to_camera=srgb_from_xyz().float(), white_balance=torch.ones(len(camera.colors)))


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
    """Simulate the raw capture of a scene with depth through given optics.

    Args:
        image: (3, H, W) or (1, H, W), in the color space of the optics; a colour camera sees grey as three channels.
        depth: (1, H, W), metres.
        optics: a :class:`~kornia_tidy.camera.tidy_optics.TiDyOptics` with ``sensor=None``, as the camera is the sensor.
        camera: as for :func:`simulate_raw`.
        noise: as for :func:`simulate_raw`.
        color: as for :func:`sensor_counts`.
        generator: random number generator. Default: the global generator.

    Raises:
        ValueError: if the optics have a sensor; and as :func:`simulate_raw` and the optics do.

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
    if not camera.colors and image.shape[0] == 3:
        raise ValueError("a monochrome camera needs a grey picture, of one channel")
    image = image.expand(3, -1, -1) if camera.colors and image.shape[0] == 1 else image
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
    r"""Return the digital counts of images on the sensor, quantised with a straight-through gradient.

    .. math:: n = \mathrm{round}\left( n_{black} + (n_{white} - n_{black}) \, x \right)

    with x the noisy light behind the filter of a pixel. Counts are clamped to 0 and the white level. Noise around black
    is kept, as cameras do, and saturated pixels have exactly the white level.

    Args:
        light: (B, 3, H, W), or (B, 1, H, W) for a monochrome camera, linear, 1.0 saturates.
        camera: gives the filter array, levels and colours.
        noise: shot noise and read noise; the camera's levels replace its bits and clipping. None for no noise.
        color: ``"camera"``: the light is linear sRGB. The camera's matrix and white balance convert it to the camera's
            channels, so that white of 1.0 saturates the most sensitive channel, and developing the capture restores
            the light. ``"channels"``: red, green and blue of the light are the camera's own channels, unbalanced.
        generator: random number generator, eager only. Default: the global generator.

    Returns:
        (B, 1, H, W) behind a filter array, else (B, C, H, W); float32 or wider.

    Convention:
        - Gradient: straight through rounding, zero where a count is clamped.
        - Negative responses of a filter, which a matrix can give for saturated colours, are set to zero.
    """
    check_float_tensor("light", light, 4, "(B, C, H, W)")
    check_choice("color", color, COLORS)
    if camera.counts.is_floating_point():
        raise ValueError("the camera must have counts, got a capture of floating-point samples")
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
    """Return the responses of the channels of ``camera.colors`` to red, green and blue light, (channels, 3)."""
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
            "the camera has no colour matrix: choose color='channels', or give it one with "
            "dataclasses.replace(camera, xyz_to_camera=...)"
        )
    balanced = balanced / balanced.sum(1, keepdim=True)  # white gives 1 in each channel
    balance = camera.daylight_balance if camera.white_balance is None else camera.white_balance
    if balance is None:
        return balanced[rows]
    sensitivity = 1 / balance.double().cpu()
    return balanced[rows] * (sensitivity / sensitivity.max())[:, None]
