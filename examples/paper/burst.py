"""Experiment 10: one exposure through all masks against a burst of one shot through each; and motion meanwhile.

    python -m examples.paper.burst --scale smoke
    python -m examples.paper.burst --scale cpu

Both ways have the same 100 ms. A burst loses the light of the pauses between its shots and is read out once a shot, but
it tells the masks apart. The scene is one plane, so that a Wiener filter restores it: from the exposure, from the sum
of the burst, and from all its shots. The masks are those of the shipped system edof-5. For motion, the scene moves
evenly by some pixels during the exposure, and the same filter, which assumes a scene at rest, restores it.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from typing import cast

import torch
from torch import Tensor

from examples.paper.report import grid, mean_and_error, means
from examples.paper.runner import Experiment, Row, Trial, main
from examples.paper.shipped import with_parts
from kornia_tidy import SensorNoise, Switching, ThinLensCamera, TiDyOptics, burst, moving_capture
from kornia_tidy.camera.motion import moment_times
from kornia_tidy.data.dead_leaves import dead_leaves
from kornia_tidy.reconstruction.pretrained import load_pretrained
from kornia_tidy.reconstruction.tasks import metres

SWAP, PAUSE, EXPOSURE, READ_NOISE = 2e-3, 8e-3, 0.1, 3.0  # s, s, s, electrons
EXTENT = {"smoke": (96, 1), "cpu": (192, 3), "gpu": (512, 5), "paper": (512, 5)}
"""Side of the scene in pixels, and seeds, by scale."""
WAYS = ("exposure", "sum of burst", "all shots")
LIGHT = ("10", "100", "1000", "10000")  # electrons of a white pixel in the whole interval
MOTION = ("0", "1", "4")  # pixels during the exposure
PLACES = (0.2, 0.5, 0.8)  # of the range of inverse depth, by seed in turn
RATIOS = torch.logspace(-6, 1, 29).tolist()  # noise over signal, of the Wiener filter


def trials(scale: str) -> list[Trial]:
    """Return the trials: light for the scene at rest, then motion at 1,000 electrons."""
    seeds = [str(seed) for seed in range(EXTENT[scale][1])]
    cases = [(light, "0") for light in LIGHT] + [("1000", pixels) for pixels in MOTION[1:]]
    return [
        {"electrons": light, "pixels": pixels, "way": way, "seed": seed}
        for seed in seeds
        for light, pixels in cases
        for way in WAYS
    ]


def measure(trial: Trial, scale: str) -> Mapping[str, float | str]:
    """Return the PSNR of the best Wiener restoration, and the share of the light that was collected."""
    seed, side, pixels = int(trial["seed"]), EXTENT[scale][0], float(trial["pixels"])
    optics = camera()
    with torch.no_grad():
        scene = dead_leaves(side, side, seed=seed)[0].mean(0)[None, None]
        depth = metres(cast("ThinLensCamera", optics.camera), torch.full_like(scene, PLACES[seed % len(PLACES)]))
        point = torch.zeros_like(scene)
        point[..., 0, 0] = 1
        psfs = take(optics, trial["way"], point, depth, 0.0)  # the capture of a point is its PSF
        electrons = float(trial["electrons"])
        optics.sensor = SensorNoise(READ_NOISE / electrons, full_well=electrons, clip=False)
        torch.manual_seed(seed)
        captures = take(optics, trial["way"], scene, depth, pixels)
        return {"psnr": best_psnr(scene, captures, psfs), "light": float(psfs.sum())}


def camera() -> TiDyOptics:
    """Return the camera: five shipped masks, a relaxing liquid crystal, linear light and a border that wraps around."""
    modulator = Switching(SWAP, EXPOSURE, between="exponential")
    shipped = load_pretrained("edof-5").optics
    return with_parts(shipped, modulator=modulator, sensor=None, color_space="linear", border="circular")


def take(optics: TiDyOptics, way: str, scene: Tensor, depth: Tensor, pixels: float) -> Tensor:
    """Return the captures (1, K, 1, H, W) of one way of taking them, of a scene that moves by so many pixels."""
    times = moment_times(optics) - 0.5
    if way == "exposure":
        if not pixels:
            return optics(scene, depth)[:, None]
        images = torch.stack([moved(scene, float(pixels * time)) for time in times], 1)
        return moving_capture(optics, images, depth[:, None].expand_as(images))[:, None]
    if pixels:  # each shot sees the scene where it then is
        shifts = (pixels * times[: optics.masks.phase.shape[0]]).tolist()
        taken = [burst(optics, moved(scene, x), depth, PAUSE, EXPOSURE)[:, k] for k, x in enumerate(shifts)]
        shots = torch.stack(taken, 1)
    else:
        shots = burst(optics, scene, depth, PAUSE, EXPOSURE)
    return shots if way == "all shots" else shots.sum(1, keepdim=True)


def moved(scene: Tensor, pixels: float) -> Tensor:
    """Return a scene moved to the right, around the border, by a Fourier shift."""
    spectrum = torch.fft.rfft2(scene)
    turns = torch.fft.rfftfreq(scene.shape[-1]) * pixels
    shifted = torch.fft.irfft2(spectrum * torch.exp(-2j * torch.pi * turns), s=scene.shape[-2:])
    return shifted.clamp(0, 1)


def best_psnr(scene: Tensor, captures: Tensor, psfs: Tensor) -> float:
    """Return the PSNR in dB of the best Wiener restoration of captures (1, K, 1, H, W) with known PSFs."""
    spectrum, transfer = torch.fft.rfft2(captures), torch.fft.rfft2(psfs)
    matched = (transfer.conj() * spectrum).sum(1)
    gain = (transfer.real.square() + transfer.imag.square()).sum(1)
    restored = (torch.fft.irfft2(matched / (gain + ratio), s=scene.shape[-2:]) for ratio in RATIOS)
    error = min(float((image.clamp(0, 1) - scene).square().mean()) for image in restored)
    return -10 * float(torch.tensor(error).log10())


def table(rows: Sequence[Row], scale: str) -> str:
    """Return the table of the ways by light and motion."""
    cases = dict.fromkeys((row["electrons"], row["pixels"]) for row in rows)
    lines = []
    for electrons, pixels in cases:
        of_case = [row for row in rows if (row["electrons"], row["pixels"]) == (electrons, pixels)]
        by_way = [means([row for row in of_case if row["way"] == way], "psnr") for way in WAYS]
        lines.append([electrons, pixels, *(mean_and_error(values) if values else "-" for values in by_way)])
    light = [means([row for row in rows if row["way"] == way], "light") for way in WAYS]
    told = [f"{100 * values[0]:.0f} %" if values else "-" for values in light]
    lines.append(["light collected", "", *told])
    heading = ["electrons of white", "pixels of motion", "one exposure", "sum of the burst", "all shots"]
    return f"{UNITS}\n\n{grid(heading, lines)}\n\n{JUDGED}"


UNITS = """\
PSNR in dB of a plane that a Wiener filter restored, whose one parameter is the best for each capture. All shots need
five times the memory of the other two."""
JUDGED = """\
Judged can be what the pauses and the readouts of a burst cost, against what it gains by telling the masks apart. Not
judged can be networks, scenes with depth, and a burst whose shots are aligned before they are restored, which motion
calls for."""


def settings(scale: str) -> str:
    """Return what the results depend on."""
    side, seeds = EXTENT[scale]
    return (
        f"{seeds} scenes of {side} px, each a plane at another depth; {EXPOSURE * 1e3:g} ms in all, swaps of "
        f"{SWAP * 1e3:g} ms (exponential) within the exposure, pauses of {PAUSE * 1e3:g} ms between shots, "
        f"{READ_NOISE:g} electrons of read noise."
    )


EXPERIMENT = Experiment("burst", "10. Burst against average, and motion", trials, measure, table, settings)

if __name__ == "__main__":
    sys.exit(not main(EXPERIMENT, __doc__ or ""))
