"""Time of compiled captures over that of eager ones, in turns, with and without gradients to the masks.

``python -m tests.benchmarks.compiled_captures``; minutes, on the scene Aloe (1110 x 1282) with the default camera.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial

import torch
from torch import Tensor

from kornia_tidy import TiDyOptics
from kornia_tidy.optics.spectrum import REFERENCE_WAVELENGTH
from tests.benchmarks.rendering_against_peers import in_turn, load_scene

Call = Callable[..., Tensor]


def depth_of(psi: Tensor, optics: TiDyOptics) -> Tensor:
    """Return the depth in metres at which the camera has this defocus, in radians."""
    camera = optics.camera
    scale = math.pi * camera.aperture_radius**2 / REFERENCE_WAVELENGTH
    return 1 / (1 / camera.focus_distance + psi / scale)


def main() -> None:
    """Print the medians and their ratio, and the largest difference as a share of the largest value.

    Gradients in float32 are off by rounding; in float64 a corner of the scene shows that nothing else is.
    """
    image, psi = load_scene("aloe")
    print(f"{torch.get_num_threads()} threads")
    for compositing in ("gather", "scatter", "occlusion"):
        side = 512 if compositing == "occlusion" else None  # of its corner
        optics = TiDyOptics(sensor=None, compositing=compositing)
        scene = [x[..., :side, :side].contiguous() for x in (image, depth_of(psi, optics))]
        for what, call in CALLS.items():
            torch.compiler.reset()  # there is a limit to graphs of the same code
            compiled = torch.compile(optics, fullgraph=True)
            off = difference(call, compiled, optics, scene)
            ways = {"eager": partial(call, optics, *scene), "compiled": partial(call, compiled, *scene)}
            times = in_turn(ways)
            medians = ", ".join(f"{name} {milliseconds:.1f} ms" for name, milliseconds in times.items())
            print(
                f"{compositing:9} {what:9} {medians}: {times['compiled'] / times['eager']:.2f}, off {off:.0e}",
                flush=True,
            )

    optics = TiDyOptics(sensor=None).double()
    compiled = torch.compile(optics, fullgraph=True)
    scene = [x[..., :256, :256].double() for x in (image, depth_of(psi, optics))]
    for what, call in CALLS.items():
        print(f"{what} in float64, 256x256: off {difference(call, compiled, optics, scene):.0e}")


def capture(camera: torch.nn.Module, image: Tensor, depth: Tensor) -> Tensor:
    """Return a capture without gradients."""
    with torch.no_grad():
        return camera(image, depth)


def learn(camera: torch.nn.Module, image: Tensor, depth: Tensor) -> Tensor:
    """Return the gradient of the masks."""
    return torch.autograd.grad(camera(image, depth).square().mean(), list(camera.parameters())[:1])[0]


CALLS = {"capture": capture, "gradients": learn}


def difference(call: Call, compiled: torch.nn.Module, optics: TiDyOptics, scene: list[Tensor]) -> float:
    """Return the largest difference of compiled and eager results as a share of the largest value."""
    one, other = call(compiled, *scene), call(optics, *scene)
    return float((one - other).abs().max() / other.abs().max())


if __name__ == "__main__":
    main()
