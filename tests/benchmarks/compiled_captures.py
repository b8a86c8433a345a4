"""Time of compiled captures over that of eager ones, in turns, with and without gradients to the masks.

``python -m tests.benchmarks.compiled_captures``; minutes, on the scene Aloe (1110 x 1282) with the default camera.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from kornia_tidy import TiDyOptics
from kornia_tidy.optics.spectrum import REFERENCE_WAVELENGTH
from tests.benchmarks.rendering_against_peers import in_turn, load_scene


def depth_of(psi: Tensor, optics: TiDyOptics) -> Tensor:
    """Return the depth in metres at which the camera has this defocus, in radians."""
    camera = optics.camera
    scale = math.pi * camera.aperture_radius**2 / REFERENCE_WAVELENGTH
    return 1 / (1 / camera.focus_distance + psi / scale)


def main() -> None:
    """Print the medians and their ratio, and the largest difference as a share of the largest value.

    Gradients in float32 are off by rounding; in float64 a corner of the scene shows that nothing else is.
    """
    optics = TiDyOptics(sensor=None)
    image, psi = load_scene("aloe")
    depth = depth_of(psi, optics)
    compiled = torch.compile(optics, fullgraph=True)

    def capture(camera: torch.nn.Module) -> Tensor:
        with torch.no_grad():
            return camera(image, depth)

    def learn(camera: torch.nn.Module) -> Tensor:
        return torch.autograd.grad(camera(image, depth).square().mean(), optics.masks.phase)[0]

    print(f"{torch.get_num_threads()} threads")
    for what, call in (("capture", capture), ("capture and gradients", learn)):
        off = (call(compiled) - call(optics)).abs().max() / call(optics).abs().max()
        times = in_turn({"eager": lambda f=call: f(optics), "compiled": lambda f=call: f(compiled)})
        ratio = times["compiled"] / times["eager"]
        medians = ", ".join(f"{name} {milliseconds:.1f} ms" for name, milliseconds in times.items())
        print(f"{what:22} {medians}: {ratio:.2f}, off {off:.0e}")

    optics = TiDyOptics(sensor=None).double()
    compiled = torch.compile(optics, fullgraph=True)
    image, depth = image[..., :256, :256].double(), depth[..., :256, :256].double()
    for what, call in (("capture", capture), ("gradients", learn)):
        off = (call(compiled) - call(optics)).abs().max() / call(optics).abs().max()
        print(f"{what} in float64, 256x256: off {off:.0e}")


if __name__ == "__main__":
    main()
