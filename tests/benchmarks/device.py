"""A CUDA card: is it right, how fast is it, beside others and in training. ``python -m tests.benchmarks.device``.

At most eight minutes, installation apart. A table is printed, and written as JSON with card, date and commit:

- images and gradients of captures against those of the processor, to 1e-5 of full scale and of the largest gradient;
- milliseconds of rendering at 1 and 12 megapixels beside dense transforms, and beside DeepLens's interpolation in depth
  (Yang et al. 2024): its own function, where ``deeplens-core`` is installed, and the same method written anew;
- the optics' share of a training step;
- restorations a second.

Without a card it refuses. ``--device cpu --quick`` shows every line at a small size; its times mean nothing.
"""

from __future__ import annotations

import argparse
import copy
import json
import platform
import statistics
import subprocess
import sys
import time
import warnings
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import interpolate

from kornia_tidy import Fidelity, PixelwiseMask, SensorNoise, ThinLensCamera, TiDyOptics
from kornia_tidy.optics import camera_spectrum
from kornia_tidy.reconstruction.pretrained import load_pretrained
from kornia_tidy.reconstruction.trained import build_optics
from kornia_tidy.render import render
from kornia_tidy.training.settings import TrainingSettings
from tests.benchmarks.capabilities import by_depth_interpolation
from tests.benchmarks.rendering_against_peers import make_bank
from tests.benchmarks.training_step import HEADS, clocked_step
from tests.render.scenes import Bank

SECONDS = 450.0  # after which the rows that are left are skipped
EXACT = 1e-5
ROUNDS = 7
LAYERS, WINDOW = 21, 23
SIZES = {"1 megapixel": (864, 1152), "12 megapixels": (3000, 4000)}
QUICK_SIZES = {"1 megapixel": (48, 64), "12 megapixels": (64, 96)}
NETWORKS = ("midas-small", "attention-unet-16", "attention-unet-64")
SYSTEMS = ("edof-5", "joint-uncertain")


@dataclass(frozen=True)
class Row:
    """A line of the table.

    Args:
        section: of the table.
        what: was measured.
        value: of it; None where it was skipped.
        unit: of the value.
        remark: the comparison, or the reason for skipping it.
        right: True if a bound is kept, False if not, None without a bound.
    """

    section: str
    what: str
    value: float | None
    unit: str
    remark: str = ""
    right: bool | None = None

    def __str__(self) -> str:
        number = "skipped" if self.value is None else f"{self.value:.3g} {self.unit}"
        judged = "" if self.right is None else "  ok" if self.right else "  WRONG"
        return f"{self.section:14} {self.what:66} {number:>16}  {self.remark}{judged}"


@dataclass(frozen=True)
class Bench:
    """Where is measured, and how much.

    Args:
        device: CUDA card, or the processor.
        quick: small sizes and one round.
    """

    device: torch.device
    quick: bool

    def now(self) -> float:
        """Return the clock once everything that was launched is done."""
        if self.device.type == "cuda":
            torch.cuda.synchronize(self.device)
        return time.perf_counter()

    def milliseconds(self, call: Callable[[], object]) -> float:
        """Return the median time of a call, after one that fills the memories."""
        call()
        times = []
        for _ in range(1 if self.quick else ROUNDS):
            begin = self.now()
            call()
            times.append(1e3 * (self.now() - begin))
        return statistics.median(times)


def scene(height: int, width: int, batch: int = 1) -> tuple[Tensor, Tensor]:
    """Return an image and a map in [0, 1] of planes and slopes."""
    generator = torch.Generator().manual_seed(0)
    image = torch.rand(batch, 3, height, width, generator=generator)
    coarse = torch.rand(batch, 1, 5, 7, generator=generator)
    return image, interpolate(coarse, (height, width), mode="nearest") * torch.linspace(0.6, 1, width)


def depth_of(optics: TiDyOptics, nearness: Tensor) -> Tensor:
    """Return the depth of a map in [0, 1], laid linearly on a camera's range of defocus; 0 is the far end."""
    lo, hi = optics.camera.defocus_range
    return optics.camera.depth(lo + (hi - lo) * (0.02 + 0.96 * nearness.double())).float()


# ---------------------------------------------------------------------- right


def cameras() -> dict[str, TiDyOptics]:
    """Return cameras of each compositing, with a lens, a spectrum and a sensor of other kinds."""
    torch.manual_seed(0)
    small = Fidelity(window=23)
    exact = {"fidelity": small, "sensor": None, "color_space": "linear"}
    fast = ThinLensCamera(focus_distance=2.0, depth_range=(1.7, float("inf")), f_number=4.0)
    return {
        "gather": TiDyOptics(**exact),
        "scatter": TiDyOptics(compositing="scatter", **exact),
        "occlusion": TiDyOptics(PixelwiseMask(2), compositing="occlusion", **exact),
        "band-limited layers": TiDyOptics(**{**exact, "fidelity": small.replace(layers="bandlimited")}),
        "reflectance spectra": TiDyOptics(spectrum=camera_spectrum(samples=4, reflectance=True), **exact),
        "a fast lens": TiDyOptics(PixelwiseMask(1, initial="flat"), fast, sensor=None, color_space="linear"),
        "sRGB and noise": TiDyOptics(fidelity=small, sensor=SensorNoise(0.01, full_well=5000.0)),
    }


def taken(optics: TiDyOptics, image: Tensor, depth: Tensor, params: dict[str, Tensor]) -> list[Tensor]:
    """Return a capture and its gradients to image, depth and masks, on the processor."""
    image, depth = image.clone().requires_grad_(), depth.clone().requires_grad_()
    coded = optics(image, depth, params=params or None)
    weight = torch.linspace(-1, 1, coded.numel(), dtype=coded.dtype, device=coded.device).reshape(coded.shape)
    (coded * weight).sum().backward()
    gradients = [image.grad, depth.grad, *(p.grad for p in optics.masks.parameters())]
    return [coded.detach().cpu(), *(g.cpu() for g in gradients if g is not None)]


def agreement(bench: Bench) -> Iterator[Row]:
    """Images and gradients against the processor's."""
    image, nearness = scene(*((48, 64) if bench.quick else (192, 256)), batch=2)
    for name, optics in cameras().items():
        depth = depth_of(optics, nearness)
        params = optics.draw(image, torch.Generator().manual_seed(1))
        expected = taken(copy.deepcopy(optics), image, depth, params)
        there = {field: value.to(bench.device) for field, value in params.items()}
        found = taken(optics.to(bench.device), image.to(bench.device), depth.to(bench.device), there)
        error = float((found[0] - expected[0]).abs().max())
        yield Row("right", f"{name}: image", error, "full scale", "against the processor", error <= EXACT)
        ratios = [
            float((a - b).abs().max() / b.abs().max().clamp(min=1e-30))
            for a, b in zip(found[1:], expected[1:], strict=True)
        ]
        error = max(ratios)
        yield Row("right", f"{name}: gradients", error, "of largest", "against the processor", error <= EXACT)


# ---------------------------------------------------------------------- fast


def deeplens() -> Callable[..., Tensor] | str:
    """Return DeepLens's function, or the reason for its absence."""
    try:
        from deeplens.imgsim import conv_psf_depth_interp  # ty: ignore[unresolved-import]
    except ImportError as error:
        return f"deeplens-core cannot be imported: {error}"
    return conv_psf_depth_interp


def renderers() -> dict[str, Callable[[Tensor, Tensor, Bank], Tensor] | str]:
    """Return renderers of linear layers by name, or the reason for the absence of one."""
    own = deeplens()

    def by_deeplens(image: Tensor, psi: Tensor, bank: Bank) -> Tensor:
        assert not isinstance(own, str)
        below = -1e3  # its depths are negative; between two layers it is linear in them
        return own(image, psi + below, bank.psfs, bank.defocus + below)

    return {
        "ours": lambda image, psi, bank: render(image, psi, bank, layers="linear"),
        "dense transforms": lambda image, psi, bank: render(image, psi, bank, layers="linear", method="dense"),
        "DeepLens's function": own if isinstance(own, str) else by_deeplens,
        "DeepLens's method, written anew": by_depth_interpolation,
    }


def rendering(bench: Bench) -> Iterator[Row]:
    """Renderers on the same scene, and whole captures of it."""
    for size, (height, width) in (QUICK_SIZES if bench.quick else SIZES).items():
        image, nearness = (part.to(bench.device) for part in scene(height, width))
        yield from _renderers_in_turn(bench, size, image, 40 * nearness - 20)
        yield from _captures(bench, size, image, nearness)


@torch.no_grad()
def _renderers_in_turn(bench: Bench, size: str, image: Tensor, psi: Tensor) -> Iterator[Row]:
    bank = make_bank(LAYERS, WINDOW)
    bank, ours = Bank(bank.psfs.to(bench.device), bank.defocus.to(bench.device)), None
    for name, call in renderers().items():
        what = f"{size}, {LAYERS} layers, {WINDOW} px: {name}"
        if isinstance(call, str):
            yield Row("rendering", what, None, "ms", call)
            continue
        try:
            took, seen = bench.milliseconds(partial(call, image, psi, bank)), call(image, psi, bank)
        except torch.OutOfMemoryError as failed:
            yield Row("rendering", what, None, "ms", f"out of memory: {failed!s:.60}")
            continue
        if ours is None:
            ours = took, seen
            yield Row("rendering", what, took, "ms")
        else:
            right = float((seen - ours[1]).abs().max()) <= 2 * EXACT
            yield Row("rendering", what, took, "ms", f"{took / ours[0]:.2f} times ours", right)


def _captures(bench: Bench, size: str, image: Tensor, nearness: Tensor) -> Iterator[Row]:
    """Captures with colour and noise, as a user takes them."""
    torch.manual_seed(0)
    optics = TiDyOptics(fidelity=Fidelity(window=WINDOW)).to(bench.device)
    depth = depth_of(optics, nearness)

    @torch.no_grad()
    def capture() -> None:
        optics(image, depth)

    def step() -> None:
        optics.masks.phase.grad = None
        optics(image, depth).square().mean().backward()

    for name, call in (("capture with colour and noise", capture), ("the same, forward and backward", step)):
        try:
            yield Row("rendering", f"{size}: {name}", bench.milliseconds(call), "ms")
        except torch.OutOfMemoryError as failed:
            yield Row("rendering", f"{size}: {name}", None, "ms", f"out of memory: {failed!s:.60}")


def training(bench: Bench) -> Iterator[Row]:
    """The optics' share of a training step, batch 8, five masks."""
    size = 80 if bench.quick else 278
    settings = TrainingSettings(size=size, **({"window": WINDOW} if bench.quick else {}))
    for name in NETWORKS[:1] if bench.quick else NETWORKS:
        torch.manual_seed(0)
        optics, head = build_optics(settings).train().to(bench.device), HEADS[name]().train().to(bench.device)
        image, nearness = scene(size, size, batch=8)
        depth = depth_of(optics, nearness)
        batch = {"image": image.to(bench.device), "depth": depth.to(bench.device)}
        adam = torch.optim.Adam([p for p in (*optics.parameters(), *head.parameters()) if p.requires_grad], lr=1e-8)
        steps = [clocked_step(optics, head, adam, batch, bench.now) for _ in range(2 if bench.quick else ROUNDS + 2)]
        forward, backward, whole = (1e3 * statistics.median(column) for column in zip(*steps[1:], strict=True))
        what = f"8 x 3 x {size} x {size}, {name}: optics"
        remark = f"{forward:.1f} ms forward and {backward:.1f} ms backward of {whole:.1f} ms"
        yield Row("training", what, 100 * (forward + backward) / whole, "% of a step", remark)


@torch.no_grad()
def restoration(bench: Bench) -> Iterator[Row]:
    """Captures restored by shipped systems."""
    height, width = (160, 160) if bench.quick else SIZES["1 megapixel"]
    capture = scene(height, width)[0].to(bench.device)
    for name in SYSTEMS[:1] if bench.quick else SYSTEMS:
        head = load_pretrained(name).head.to(bench.device)
        for dtype in (torch.float32, torch.bfloat16):
            with torch.autocast(bench.device.type, torch.bfloat16, enabled=dtype == torch.bfloat16):
                took = bench.milliseconds(lambda head=head: head(capture))
            what = f"{name}, {height} x {width}, {str(dtype).removeprefix('torch.')}"
            yield Row("restoration", what, 1e3 / took, "frames a second")


# ---------------------------------------------------------------------- all


def measured(bench: Bench, begin: float) -> Iterator[Row]:
    """Yield all rows; those after the time limit are skipped."""
    for part in (agreement, rendering, training, restoration):
        if time.monotonic() - begin > SECONDS:
            yield Row(part.__name__, "all", None, "", "no time was left")
            continue
        for row in part(bench):
            yield row
            if time.monotonic() - begin > SECONDS:
                yield Row(part.__name__, "the rest", None, "", "no time was left")
                break
        if bench.device.type == "cuda":
            torch.cuda.empty_cache()


def facts(bench: Bench) -> dict[str, Any]:
    """Return card, versions, date and commit."""
    root = Path(__file__).resolve().parents[2]
    commit = subprocess.run(
        ["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True, check=False, cwd=root
    ).stdout.strip()
    cuda = bench.device.type == "cuda"
    return {
        "card": torch.cuda.get_device_name(bench.device) if cuda else "none: the processor",
        "processor": platform.processor() or platform.machine(),
        "torch": torch.__version__,
        "cuda": torch.version.cuda if cuda else None,
        "date": datetime.now(UTC).date().isoformat(),
        "commit": commit or "unknown",
        "quick": bench.quick,
    }


def main(argv: list[str] | None = None) -> int:
    """Measure; return 0 if everything is right, 1 if not, 2 without a card."""
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks.device", description="Measures a CUDA card.")
    parser.add_argument("--device", default="cuda", help="cuda, cuda:1, or cpu to see every line (default: cuda)")
    parser.add_argument("--quick", action="store_true", help="small sizes, one round")
    parser.add_argument("-o", "--output", type=Path, default=Path("outputs/device.json"), help="file of JSON")
    args = parser.parse_args(argv)
    device = torch.device(args.device)
    if device.type == "cuda" and not torch.cuda.is_available():
        told = f"no CUDA card is here for torch {torch.__version__}: --device cpu --quick shows every line without one"
        print(told, file=sys.stderr)
        return 2
    torch.backends.cuda.matmul.allow_tf32 = torch.backends.cudnn.allow_tf32 = False
    begin, bench = time.monotonic(), Bench(device, args.quick)
    known, rows = facts(bench), list[Row]()
    print(", ".join(f"{name} {value}" for name, value in known.items()))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for row in measured(bench, begin):
            rows.append(row)
            print(row, flush=True)
    known["seconds"] = round(time.monotonic() - begin)
    args.output.parent.mkdir(parents=True, exist_ok=True)
    args.output.write_text(json.dumps({**known, "rows": [asdict(row) for row in rows]}, indent=1))
    print(f"{known['seconds']} s, written to {args.output}")
    return int(any(row.right is False for row in rows))


if __name__ == "__main__":
    sys.exit(main())
