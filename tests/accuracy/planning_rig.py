"""Test rig of plans: cameras that render both plan and reference, masks, smooth noise and real scenes."""

from __future__ import annotations

from copy import deepcopy

import torch
from torch import Tensor
from torch.nn.functional import conv2d, interpolate, pad

from kornia_tidy import Fidelity, PixelwiseMask, TiDyOptics
from kornia_tidy.accuracy import Planner
from kornia_tidy.camera.strips import Strip
from tests.scenes import load_scene


class Rig:
    """A camera, its planner, and captures of both plan and reference with PSFs made once."""

    def __init__(self, optics: TiDyOptics, channels: int = 3) -> None:
        self.optics = optics
        self.planner = Planner(optics, channels)
        self._cameras: dict[Fidelity, TiDyOptics] = {}

    @torch.no_grad()
    def capture(self, light: Tensor, defocus: Tensor, fidelity: Fidelity) -> Tensor:
        """Return the capture in linear light, without noise and in float64."""
        key = fidelity.replace(name="")
        if key not in self._cameras:  # a copy has a memory of PSFs of its own, which holds one setting at a time
            self._cameras[key] = deepcopy(self.optics).with_fidelity(fidelity)
        dtype = torch.float64 if fidelity.double else torch.float32
        light, defocus = light.to(dtype), defocus.to(dtype)
        camera = self._cameras[key]
        return camera.blurred(Strip(light, defocus, defocus, camera.border)).double()

    def error(self, light: Tensor, defocus: Tensor, fidelity: Fidelity, reference: Fidelity) -> float:
        """Return the root mean square difference of two captures, full scale 1 also where light goes beyond it.

        With the border ``"valid"`` over the pixels that both have: the wider window leaves fewer.
        """
        ours, theirs = self.capture(light, defocus, fidelity), self.capture(light, defocus, reference)
        margin = (ours.shape[-1] - theirs.shape[-1]) // 2
        if margin:
            ours = ours[..., margin:-margin, margin:-margin]
        return float((ours - theirs).square().mean().sqrt())


def real_scene(name: str, optics: TiDyOptics, side: int) -> tuple[Tensor, Tensor]:
    """Return linear light and defocus of a real scene, its longer side made so many pixels."""
    scene = load_scene(name)
    scale = side / max(scene.image.shape[-2:])
    size = [round(length * scale) for length in scene.image.shape[-2:]]
    image = interpolate(scene.image[None], size, mode="area")
    return optics.decode(image), optics.camera.defocus(interpolate(scene.depth[None], size, mode="nearest"))


def smooth(shape: tuple[int, ...], width: float, generator: torch.Generator) -> Tensor:
    """Gaussian noise of unit variance, correlated over a width in pixels."""
    offset = torch.arange(-int(3 * width), int(3 * width) + 1)
    bell = torch.exp(-(offset**2) / (2 * width**2))
    planes = torch.randn(shape, generator=generator).flatten(0, -3)[:, None]
    blurred = conv2d(pad(planes, (len(bell) // 2,) * 4, mode="circular"), (bell[:, None] * bell)[None, None])
    return (blurred / blurred.std()).reshape(shape)


MASKS = {
    "random": lambda g: PixelwiseMask(2, 15, generator=g),
    "flat": lambda g: PixelwiseMask(1, 11, initial="flat"),
    "learned": lambda g: PixelwiseMask(initial=0.5e-6 * smooth((1, 23, 23), 2.0, g)),
}
