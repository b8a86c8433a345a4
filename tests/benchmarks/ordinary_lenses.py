"""Time, memory, light and error of captures through ordinary fast lenses without a mask.

``python -m tests.benchmarks.ordinary_lenses``; a minute. Each lens has a process of its own, so that its peak memory is
known. The scene is the middle of Aloe, 512 x 512 pixels of 6 um, its disparity stretched over the range of depths. The
error is that of 256 x 256 pixels in green at 40 depths against the exact PSF of each.
"""

from __future__ import annotations

import argparse
import os
import resource
import subprocess
import sys
import time

import torch
from torch import Tensor
from torch.nn.functional import pad

from kornia_tidy import PixelwiseMask, ThinLensCamera, TiDyOptics
from kornia_tidy.optics.spectrum import Spectrum
from kornia_tidy.psf.exact import exact_psf_bank
from tests.benchmarks.rendering_against_peers import load_scene

LENSES = {
    "f/2.8 at 2 m": (2.8, 2.0),
    "f/1.8 at 2 m": (1.8, 2.0),
    "f/1.4 at 3 m": (1.4, 3.0),
    "f/1.4 at 0.5 m": (1.4, 0.5),
}
TARGETS = {"f/2.8 at 2 m": 1.0, "f/1.8 at 2 m": 2.0, "f/1.4 at 3 m": 3.0, "f/1.4 at 0.5 m": 10.0}
DEPTHS = 40
LARGEST_EXACT = 200  # px; exact PSFs of larger windows take minutes


def camera(f_number: float, focus: float) -> TiDyOptics:
    """Return a 50 mm lens with pixels of 6 um and nothing but its aperture."""
    lens = ThinLensCamera(50e-3, 50e-3 / f_number, focus, 6e-6)
    return TiDyOptics(PixelwiseMask(1, initial="flat"), lens, sensor=None, color_space="linear")


def scene(size: int, focus: float) -> tuple[Tensor, Tensor]:
    """Return light and depth: from 1.5 to 21 m, or from half the focus to infinity for a focus at 0.5 m."""
    image, psi = (x[..., 200 : 200 + size, 300 : 300 + size] for x in load_scene("aloe"))
    near = (psi - psi.min()) / (psi.max() - psi.min())
    lowest, highest = (1 / 21, 1 / 1.5) if focus > 1 else (0.0, 2.0)
    return image, 1 / (lowest + (highest - lowest) * near)


def error_and_light(optics: TiDyOptics, image: Tensor, depth: Tensor) -> tuple[float, float]:
    """Return the root mean square error against exact PSFs, and the least light in the lens's windows."""
    psi = optics.defocus(depth)
    nodes = torch.quantile(psi.flatten(), (torch.arange(DEPTHS) + 0.5) / DEPTHS).unique()
    psi = nodes[(psi[..., None] - nodes).abs().argmin(-1)]
    side, step = optics.window + 20, float(optics.psf_model.pixel_step)
    plane = pad(image, (side // 2,) * 4, mode="reflect")
    spectrum, exact, shares = torch.fft.rfft2(plane), torch.zeros_like(image), []
    for node in nodes.tolist():
        flat, one = torch.zeros(1, 23, 23), torch.ones(1)
        psf = exact_psf_bank(flat, one, optics.pupil, Spectrum.monochrome(), [1.0], [node], step, side, 1e-2).psfs
        shares.append(float(psf[..., 10:-10, 10:-10].sum()))
        product = spectrum * torch.fft.rfft2(psf / psf.sum(), s=plane.shape[-2:])
        blurred = torch.fft.irfft2(product, s=plane.shape[-2:])[..., side - 1 :, side - 1 :]
        exact = torch.where(psi == node, blurred, exact)
    return float((optics(image, optics.camera.depth(psi)) - exact).square().mean().sqrt()), min(shares)


@torch.no_grad()
def measure(name: str) -> None:
    """Print the row of one lens."""
    f_number, focus = LENSES[name]
    image, depth = scene(512, focus)
    camera(8.0, 2.0)(image[..., :96, :96], depth[..., :96, :96])  # compiled code is loaded
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    begun, work = time.perf_counter(), time.process_time()
    optics = camera(f_number, focus)
    optics(image, depth)
    took, work = time.perf_counter() - begun, time.process_time() - work
    memory = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024
    begun = time.perf_counter()
    optics(image, depth)
    again = time.perf_counter() - begun
    row = [
        name,
        f"{took:.2f}",
        f"{work:.2f}",
        f"{again:.2f}",
        f"{TARGETS[name]:g}",
        f"{memory:.0f}",
        f"{optics.window}",
    ]
    if optics.window <= LARGEST_EXACT:
        error, light = error_and_light(optics, image[:, 1:2, 128:384, 128:384], depth[..., 128:384, 128:384])
        row += [f"{light:.1%}", f"{error:.1e}"]
    else:
        row += [f"{optics.light_held[0]:.1%} (small discs)", "-"]
    print("| " + " | ".join([*row, f"{optics.psf_model.wide_blur.error:.1e}"]) + " |", flush=True)


def main() -> None:
    """Print a table with a row for each lens, or the row of one."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("lens", nargs="?", choices=tuple(LENSES), help="print the row of this one alone")
    lens = parser.parse_args().lens
    if lens:
        measure(lens)
        return
    print(f"{torch.get_num_threads()} threads, load {os.getloadavg()[0]:.1f}")
    print("| 50 mm | first capture, s | of the processor | again, s | target, s | memory, MiB | window, px | light | "
          "RMSE | promised |")  # fmt: skip
    print("|---" * 10 + "|", flush=True)
    for name in LENSES:
        subprocess.run([sys.executable, "-m", "tests.benchmarks.ordinary_lenses", name], check=True)


if __name__ == "__main__":
    main()
