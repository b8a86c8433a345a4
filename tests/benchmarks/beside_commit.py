"""Captures and gradients beside those of an earlier commit: the same numbers, and how many times as fast.

``python -m tests.benchmarks.beside_commit b24c93b``; minutes. Processes of both commits take turns, with the compiler's
vectors of some widths and without a compiler; medians of processor time of one thread. ``--equal`` compares what both
compute instead: captures, and gradients of the masks, of 60 small cases.
"""

from __future__ import annotations

import argparse
import itertools
import os
import statistics
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from itertools import product
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import interpolate

from kornia_tidy import Fidelity, SensorNoise, Spectrum, ThinLensCamera, TiDyOptics, burst, moving_capture
from kornia_tidy.masks import PixelwiseMask, ZernikeMask
from kornia_tidy.modulator import DwellTimes, LearnableDwellTimes, Switching
from kornia_tidy.optics import annular_aperture, camera_spectrum

ROOT = Path(__file__).resolve().parents[2]
WIDTHS = {"32 bytes": "cc -march=x86-64-v3", "64 bytes": "cc -march=x86-64-v4", "no compiler": "false"}
ALLOWED = {"capture": 1e-6, "gradient": 1e-4}  # of full scale; of the largest value
Work = Callable[[], Tensor]


def scene(height: int, width: int, depths: tuple[float, float] = (0.3, 10.0), images: int = 1) -> tuple[Tensor, Tensor]:
    """Return images of noise and depths in squares of 24 pixels, evenly spread in inverse depth."""
    generator = torch.Generator().manual_seed(1)
    image = torch.rand(images, 3, height, width, generator=generator)
    near, far = depths
    squares = torch.rand(images, 1, -(-height // 24), -(-width // 24), generator=generator) * (1 / near - 1 / far)
    return image, 1 / (1 / far + interpolate(squares, scale_factor=24.0)[..., :height, :width])


def others(one: tuple[Tensor, Tensor]) -> Iterator[tuple[Tensor, Tensor]]:
    """Yield a scene and others like it, as cameras meet them: what is remembered of one does not help the next."""
    image, depth = one
    return ((image, depth * (1 + 1e-4 * n)) for n in itertools.count())


def masks(count: int = 5, side: int = 23) -> PixelwiseMask:
    """Return masks of noise."""
    heights = torch.rand(count, side, side, generator=torch.Generator().manual_seed(2)) * 1.2e-6
    return PixelwiseMask(initial=heights)


def flat(**lens: Any) -> dict[str, Any]:
    """Return the arguments of a fast lens that shows no mask."""
    camera = ThinLensCamera(f_number=2.8, focus_distance=2.0, pixel_pitch=6e-6, depth_range=(1.5, 40.0), **lens)
    return {"masks": PixelwiseMask(1, initial="flat"), "camera": camera}


def capture(*size: int, depths: tuple[float, float] = (0.3, 10.0), images: int = 1, **options: Any) -> Work:
    """Return the capture of a scene."""
    optics, given = TiDyOptics(options.pop("masks", None) or masks(), **options), others(scene(*size, depths, images))
    return torch.no_grad()(lambda: optics(*next(given)))


def gradient(*size: int, of_image: bool = False, learns: bool = False, **options: Any) -> Work:
    """Return the gradient of the masks or of the image, at the masks' values or at some that move each time."""
    optics, (image, depth) = TiDyOptics(options.pop("masks", None) or masks(), **options), scene(*size)
    given = others((image.requires_grad_(of_image), depth))
    wanted = [image] if of_image else list(optics.masks.parameters())

    def work() -> Tensor:
        if learns:
            with torch.no_grad():
                wanted[0] += 1e-7
        return torch.autograd.grad(optics(*next(given)).square().mean(), wanted)[0]

    return work


def new_scenes(side: int) -> Work:
    """Return the captures of scenes of other depths by a camera that is new."""
    image, depth = scene(side, side)
    count = itertools.count()

    def work() -> Tensor:
        heights = torch.rand(5, 23, 23, generator=torch.Generator().manual_seed(next(count))) * 1.2e-6
        return TiDyOptics(PixelwiseMask(initial=heights), fidelity=Fidelity(window=61))(image, depth)

    return torch.no_grad()(work)


def shots(side: int, **options: Any) -> Work:
    """Return a burst."""
    optics, given = TiDyOptics(masks(), **options), others(scene(side, side))
    return torch.no_grad()(lambda: burst(optics, *next(given)))


def moving(side: int, frames: int, **options: Any) -> Work:
    """Return the capture of a scene that moves."""
    optics, (image, depth) = TiDyOptics(masks(), **options), scene(side, side)
    images, depths = (torch.stack([x.roll(n, -1) for n in range(frames)], 1) for x in (image, depth))
    return torch.no_grad()(lambda: moving_capture(optics, images, depths))


_OCCLUSION = {"compositing": "occlusion", "fidelity": Fidelity(window=23), "sensor": None}
TIMED: dict[str, Callable[[], Work]] = {
    "1282x1110 with noise": lambda: capture(1110, 1282),
    "1282x1110 without noise": lambda: capture(1110, 1282, sensor=None),
    "64x64": lambda: capture(64, 64, fidelity=Fidelity(window=61)),
    "256x256": lambda: capture(256, 256),
    "8 x 128x128": lambda: capture(128, 128, images=8),
    "scatter": lambda: capture(256, 256, compositing="scatter"),
    "occlusion": lambda: capture(256, 256, **_OCCLUSION),
    "each scene new": lambda: new_scenes(256),
    "masks learn": lambda: gradient(256, 256, learns=True),
    "scatter, masks learn": lambda: gradient(256, 256, learns=True, compositing="scatter"),
    "image learns": lambda: gradient(256, 256, of_image=True),
    "occlusion, masks learn": lambda: gradient(128, 128, learns=True, **_OCCLUSION),
    "occlusion, image learns": lambda: gradient(128, 128, of_image=True, **_OCCLUSION),
    "wide lens": lambda: capture(256, 256, depths=(1.6, 30.0), **flat()),
    "burst": lambda: shots(256),
    "motion": lambda: moving(128, 5),
    "float64": lambda: capture(256, 256, fidelity=Fidelity(window=61, double=True)),
    "draft": lambda: capture(256, 256, fidelity="draft"),
}


def equal_cases() -> Iterator[tuple[str, Callable[[], Work]]]:
    """Yield 60 small captures and gradients by name."""
    usual: dict[str, Any] = {"sensor": None, "fidelity": Fidelity(window=15, layer_spacing=4.0)}
    for compositing, border in product(("gather", "scatter", "occlusion"), ("reflect", "zero", "circular", "valid")):
        for layers in ("linear", "nearest"):
            fidelity = Fidelity(window=15, layer_spacing=4.0, layers=layers)
            given: dict[str, Any] = {
                "compositing": compositing, "border": border, "fidelity": fidelity, "sensor": None,
            }  # fmt: skip
            yield f"capture {compositing} {border} {layers}", lambda given=given: capture(48, 56, **given)
            if border in {"reflect", "zero"}:
                yield f"gradient {compositing} {border} {layers}", lambda given=given: gradient(48, 56, **given)
    others: dict[str, dict[str, Any]] = {
        "noise": {"sensor": SensorNoise(0.01, full_well=5000.0, bits=10)},
        "unequal times": {"modulator": DwellTimes((5, 4, 3, 2, 1))},
        "learnt times": {"modulator": LearnableDwellTimes((5, 4, 3, 2, 1))},
        "switching": {"modulator": Switching(2e-3, samples=2)},
        "one wavelength": {"spectrum": Spectrum.rgb()},
        "spectra": {"spectrum": camera_spectrum(samples=5)},
        "reflectance": {"spectrum": camera_spectrum(samples=3, reflectance=True)},
        "draft": {"fidelity": "draft", "border": "replicate"},
        "balanced": {"fidelity": "balanced", "border": "replicate"},
        "float64": {"fidelity": Fidelity(window=15, double=True)},
        "band-limited": {"fidelity": Fidelity(window=15, layers="bandlimited", layer_spacing=1.0)},
        "cubic": {"fidelity": Fidelity(window=15, layers="cubic")},
        "veil": {"fidelity": Fidelity(window=15, stray_light="veil")},
        "ring": {"aperture": annular_aperture(23, 0.1, 0.4)},
        "zernike": {"masks": ZernikeMask(2, 15, num_modes=10, initial=torch.linspace(-3, 3, 20).reshape(2, 10))},
        "linear light": {"color_space": "linear"},
    }
    for name, own in others.items():
        yield f"capture {name}", lambda own=own: capture(48, 56, **(usual | own))
    for name in ("learnt times", "spectra", "float64", "band-limited"):
        yield f"gradient {name}", lambda own=others[name]: gradient(48, 56, **(usual | own))
    yield "capture wide lens", lambda: capture(96, 96, depths=(1.6, 30.0), sensor=None, **flat())
    yield "capture burst", lambda: shots(48, **usual)
    yield "capture motion", lambda: moving(48, 5, **usual)
    yield "capture bands", lambda: capture(400, 64, memory_budget=1 << 20, **usual)


EQUAL = dict(equal_cases())
LARGE: dict[str, Callable[[], Work]] = {  # of which vector_widths compares times and numbers
    f"{name} {own['compositing']}": lambda make=make, own=own: make(512, 512, **own)
    for own in ({"compositing": "gather", "sensor": None}, {"compositing": "scatter", "sensor": None}, _OCCLUSION)
    for name, make in (("capture", capture), ("gradient", gradient))
}


def serve() -> None:
    """Run the case that each line of standard input names, with a file for its result, and answer with milliseconds."""
    torch.set_num_threads(1)
    warnings.simplefilter("ignore")
    known: dict[str, Work] = {}
    for line in sys.stdin:
        name, path = line.rstrip("\n").split("|")
        if name not in known:
            known[name] = (TIMED | EQUAL | LARGE)[name]()
            torch.manual_seed(3)
            torch.save(known[name](), path)
        start = time.process_time()
        known[name]()
        print(1e3 * (time.process_time() - start), flush=True)


class Worker:
    """A process of a commit that runs cases when it is told to."""

    def __init__(self, checkout: Path, compiler: str, **more: str) -> None:
        settings = {"CC": compiler, "OMP_NUM_THREADS": "1", "PYTHONPATH": str(checkout), **more}
        command = [sys.executable, "-W", "ignore", str(Path(__file__).resolve()), "--serve", "-"]
        pipes: dict[str, Any] = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
        self.process = subprocess.Popen(command, cwd=checkout, env={**os.environ, **settings}, **pipes)

    def milliseconds(self, name: str, path: Path) -> float:
        """Run a case and return its processor time; the first time its result is saved before."""
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        self.process.stdin.write(f"{name}|{path}\n")
        self.process.stdin.flush()
        return float(self.process.stdout.readline())

    def end(self) -> None:
        """End the process."""
        self.process.communicate()


def rows(commit: str, compiler: str, names: Sequence[str], rounds: int) -> Iterator[tuple[str, float, float, float]]:
    """Yield of each case its name, the milliseconds of the earlier commit and of this one, and how far they differ."""
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        archive = subprocess.run(["git", "archive", commit, "kornia_tidy"], cwd=ROOT, check=True, capture_output=True)
        subprocess.run(["tar", "-x", "-C", str(folder)], input=archive.stdout, check=True)
        workers = [Worker(checkout, compiler) for checkout in (folder, ROOT)]
        for worker in workers:
            stack.callback(worker.end)
        for name in names:
            times: tuple[list[float], list[float]] = [], []
            for _ in range(rounds):
                for n, worker in enumerate(workers):
                    times[n].append(worker.milliseconds(name, folder / f"{n}.pt"))
            before, now = (torch.load(folder / f"{n}.pt").double() for n in range(2))
            full = float(before.abs().max()) if name.startswith("gradient") else 1.0
            off = float((before - now).abs().max()) / full if before.shape == now.shape else float("inf")
            yield name, *map(statistics.median, times), off


def main(arguments: Sequence[str] | None = None) -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks.beside_commit", description=__doc__)
    parser.add_argument("commit", help="that is compared with")
    parser.add_argument("--equal", action="store_true", help="compare what 60 small cases compute")
    parser.add_argument("--widths", nargs="*", default=[*WIDTHS], choices=WIDTHS, help="default: all")
    parser.add_argument("--only", help="cases with this word in their names")
    parser.add_argument("--rounds", type=int, default=5, help="default: 5")
    parser.add_argument("--serve", action="store_true", help=argparse.SUPPRESS)
    args = parser.parse_args(arguments)
    if args.serve:
        serve()
        return
    names = [name for name in (EQUAL if args.equal else TIMED) if (args.only or "") in name]
    for width in args.widths:
        print(f"\n{width}\n\n| | before, ms | now, ms | times as fast | differs by |\n|{'---|' * 5}", flush=True)
        for name, before, now, off in rows(args.commit, WIDTHS[width], names, 1 if args.equal else args.rounds):
            wrong = " **" if args.equal and off > ALLOWED[name.split()[0]] else ""
            print(f"| {name} | {before:.1f} | {now:.1f} | {before / now:.2f} | {off:.1e}{wrong} |", flush=True)


if __name__ == "__main__":
    main()
