"""Cost of the same picture with 1, 2, 8 and 21 layers of depth present: captures, PSFs and training steps.

``python -m tests.benchmarks.scene_layers``; minutes. The picture is the middle 512 x 512 of Aloe, its disparity laid
linearly on [-20, 20] rad and rounded to so many of the 21 layers, the camera as it comes but without sensor. Scenes
take turns. Of each the median processor time counts. Captures remember their PSFs; those of a training step, and of the
row "PSFs", are computed each time.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import torch
from torch import Tensor

from kornia_tidy import TiDyOptics
from tests.benchmarks.compiled_captures import depth_of
from tests.benchmarks.rendering_against_peers import in_turn, load_scene

PRESENT, ROUNDS, SIDE = (1, 2, 8, 21), 5, 512


def rounded(psi: Tensor, nodes: tuple[float, ...], count: int) -> Tensor:
    """Return a defocus map in radians on so many of the nodes, evenly spread; one is the middle of the range."""
    last = len(nodes) - 1
    own = psi.new_tensor([nodes[round(last * (i + 0.5) / count - 0.5)] for i in range(count)])
    shares = (psi - nodes[0]) / (nodes[-1] - nodes[0])
    return own[(shares * count).long().clamp(0, count - 1)]


def works(compositing: str, image: Tensor, psi: Tensor) -> dict[str, Callable[[], object]]:
    """Return what is timed for a scene: a capture, a training step, and with gather the PSFs alone."""
    optics = TiDyOptics(sensor=None, compositing=compositing)
    depth = depth_of(psi, optics)

    def capture() -> Tensor:
        with torch.no_grad():
            return optics(image, depth)

    def learn() -> None:
        optics(image, depth).square().mean().backward()

    def psfs() -> None:
        with torch.no_grad():
            optics.psf_model._memories.clear()
            optics.psf_model.scene_bank(3, torch.float32, psi)

    found: dict[str, Callable[[], object]] = {
        f"{compositing}, capture": capture,
        f"{compositing}, training step": learn,
    }
    return {**found, "PSFs": psfs} if compositing == "gather" else found


def main() -> None:
    """Print a table: milliseconds, and their ratio to a scene in one layer."""
    image, psi = load_scene("aloe")
    top, left = ((n - SIDE) // 2 for n in image.shape[-2:])
    image, psi = (x[..., top : top + SIDE, left : left + SIDE].contiguous() for x in (image, psi))
    nodes = TiDyOptics(sensor=None).defocus_nodes
    scenes = {count: rounded(psi, nodes, count) for count in PRESENT}
    print(f"{torch.get_num_threads()} threads, milliseconds (times that of one layer)")
    print("| work | " + " | ".join(f"{count} layers" for count in PRESENT) + " |")
    print("|---" * (1 + len(PRESENT)) + "|")
    for compositing in ("gather", "scatter", "occlusion"):
        by_scene = {count: works(compositing, image, own) for count, own in scenes.items()}
        for name in by_scene[1]:
            times = in_turn({count: calls[name] for count, calls in by_scene.items()}, ROUNDS, time.process_time)
            cells = [f"{own:.1f} ({own / times[1]:.1f})" for own in times.values()]
            print(f"| {name} | " + " | ".join(cells) + " |", flush=True)


if __name__ == "__main__":
    main()
