"""Whole captures over their convolution, and over those of another checkout, at two widths of vectors and without C.

``python -m tests.benchmarks.whole_capture --against ../other_checkout``; minutes. Aloe (1282 x 1110, thin leaves), its
disparity laid linearly over the range of the camera as it comes; one thread. Processes of both checkouts take turns, so
that what else the machine does meets both alike. The least processor time of each, in milliseconds; captures of both
checkouts with the same seed are compared by their largest difference.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from pathlib import Path

import torch
from torch import Tensor

ROUNDS = 15
CONVOLUTION = "convolution"
SENSORS = ("no sensor", "read noise", "shot noise, 12 bits")
GRADIENTS = "read noise, gradient of the masks"
ROWS = (*SENSORS, GRADIENTS)
ROOT = Path(__file__).resolve().parents[2]


def main(arguments: Sequence[str] | None = None) -> None:
    """Print a table for each width."""
    from kornia_tidy import ThinLensCamera
    from tests.benchmarks.rendering_against_peers import load_scene
    from tests.kernels.widths import options, widths_here

    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks.whole_capture", description=__doc__)
    parser.add_argument("--against", type=Path, help="folder of another checkout")
    parser.add_argument("--rounds", type=int, default=ROUNDS, help=f"times of which the least is taken ({ROUNDS})")
    parser.add_argument("--widths", nargs="+", type=int, help="bytes of vectors, 0: no compiler (the two widest and 0)")
    parser.add_argument("--rows", nargs="+", choices=ROWS, default=ROWS, help="all")
    args = parser.parse_args(arguments)
    checkouts = [ROOT] if args.against is None else [ROOT, args.against.resolve()]
    compiler = os.environ.get("CC", "cc")
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        image, psi = load_scene("aloe")
        torch.save((image, ThinLensCamera().depth(psi)), folder / "scene.pt")
        for width in args.widths or (*widths_here()[-2:], 0):
            own = " ".join((compiler, *options(width))) if width else "false"
            workers = [Worker(checkout, own, folder / f"{width}-{n}") for n, checkout in enumerate(checkouts)]
            rows = list(args.rows) + [CONVOLUTION] * (width > 0)
            least = {(n, row): float("inf") for n in range(len(workers)) for row in rows}
            for _ in range(args.rounds):
                for row in rows:
                    for n, worker in enumerate(workers[: 1 if row == CONVOLUTION else None]):
                        least[n, row] = min(least[n, row], worker.milliseconds(row))
            print(f"\n{width} bytes" if width else "\nwithout a compiler")
            names = ["", "ms", *["over convolution"] * (width > 0)]
            names += ["against, ms", "times faster", "differs by"] * (len(workers) - 1)
            print(f"| {' | '.join(names)} |\n|{'---|' * len(names)}")
            for row in rows:
                print(line(row, least, workers))
            for worker in workers:
                worker.end()


def line(row: str, least: dict[tuple[int, str], float], workers: Sequence[Worker]) -> str:
    """Return a row of the table in Markdown."""
    cells = [row, f"{least[0, row]:.0f}"]
    if (0, CONVOLUTION) in least:
        cells.append(f"{least[0, row] / least[0, CONVOLUTION]:.2f}")
    if len(workers) > 1 and row != CONVOLUTION:
        one, other = (worker.made(row) for worker in workers)
        off = float((one - other).abs().max() / other.abs().max())
        cells += [f"{least[1, row]:.0f}", f"{least[1, row] / least[0, row]:.2f}", f"{off:.0e}"]
    return f"| {' | '.join(cells)} |"


class Worker:
    """A process that makes captures with the package of a checkout when it is told to."""

    def __init__(self, checkout: Path, compiler: str, folder: Path) -> None:
        folder.mkdir()
        own = {"CC": compiler, "OMP_NUM_THREADS": "1", "XDG_CACHE_HOME": str(folder), "PYTHONPATH": str(checkout)}
        command = [sys.executable, "-W", "ignore:compiled code", __file__, str(folder)]
        self.folder = folder
        self.process = subprocess.Popen(
            command, env={**os.environ, **own}, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )

    def milliseconds(self, row: str) -> float:
        """Make a row of :data:`ROWS`, and return the processor time that it took."""
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        self.process.stdin.write(row + "\n")
        self.process.stdin.flush()
        answer = self.process.stdout.readline()
        if not answer:
            raise RuntimeError(f"{row} ended its process with status {self.process.wait()}")
        return float(answer)

    def made(self, row: str) -> Tensor:
        """Return what was made last."""
        return torch.load(self.folder / f"{row}.pt")

    def end(self) -> None:
        """End the process."""
        self.process.communicate()


def serve(folder: Path) -> None:
    """Make captures as lines of standard input name them, and answer with milliseconds."""
    from kornia_tidy import PixelwiseMask, SensorNoise, TiDyOptics

    image, depth = torch.load(folder.parent / "scene.pt")
    torch.manual_seed(0)
    masks = PixelwiseMask(5)
    sensors = dict(zip(SENSORS, (None, SensorNoise(0.01), SensorNoise.physical(10_500, 2.4)), strict=True))
    cameras = {row: TiDyOptics(masks, sensor=sensor) for row, sensor in sensors.items()}

    def gradient() -> Tensor:
        coded = cameras["read noise"](image, depth, generator=torch.Generator().manual_seed(1))
        return torch.autograd.grad(coded.square().mean(), masks.phase)[0]

    @torch.no_grad()
    def capture(row: str) -> Tensor:
        return cameras[row](image, depth, generator=torch.Generator().manual_seed(1))

    calls: dict[str, Callable[[], Tensor]] = {row: lambda row=row: capture(row) for row in SENSORS}
    calls[GRADIENTS] = gradient
    for text in sys.stdin:
        row = text.strip()
        if row == CONVOLUTION and row not in calls:
            calls[row] = convolution(cameras["no sensor"], image, depth)
        first = not (folder / f"{row}.pt").exists()
        if first:
            torch.save(calls[row](), folder / f"{row}.pt")
        start = time.process_time()
        calls[row]()
        print(1e3 * (time.process_time() - start), flush=True)


@torch.no_grad()
def convolution(optics, image: Tensor, depth: Tensor) -> Callable[[], Tensor]:
    """Return the call that the capture of a scene spends most of its time in."""
    from kornia_tidy.kernels.overlap_ops import gather_overlap, window_size
    from kornia_tidy.render.scene import layered_scene

    bank = optics.psf_bank()
    scene = layered_scene(optics.decode(image), optics.defocus(depth), bank.defocus, bank.psfs, bank.veil)
    given = scene.plane, scene.psfs, scene.labels.layer_index, scene.labels.layer_weight
    return lambda: gather_overlap(*given, window_size(scene.psfs.shape[-1]))


if __name__ == "__main__":
    if len(sys.argv) == 2 and Path(sys.argv[1]).is_dir():
        serve(Path(sys.argv[1]))
    else:
        main()
