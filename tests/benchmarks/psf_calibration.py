"""Accuracy of PSF calibration from simulated captures of a point, and of Tikhonov restoration with its PSFs.

``python -m tests.benchmarks.psf_calibration`` prints the table. Each camera is a sensor of 12 bits with a black level,
with or without a filter array, behind a lens with a coded aperture. The point is imaged exactly, at random ninths of a
pixel, with shot noise, read noise and a background, in three exposures of which the longer ones saturate, and once with
the mask flat. Errors are the largest over the channels. The truth is the image without noise, cut to the window and
scaled to a sum of one, as in a bank; "whole" compares with Tikhonov that knows the light beyond the window too.
"""

from __future__ import annotations

import argparse

import torch
from torch import Tensor
from torch.nn.functional import conv2d, pad

from kornia_tidy.data.dead_leaves import dead_leaves
from kornia_tidy.lab.calibration.psf import MeasuredPSFs, diffraction_cutoff, measure_psfs, point_images
from kornia_tidy.masks import PhaseMasks, PixelwiseMask
from kornia_tidy.masks.initial_heights import fisher_mask
from kornia_tidy.optics.spectrum import Spectrum
from kornia_tidy.optics.thin_lens import ThinLensCamera
from kornia_tidy.reconstruction.metrics import psnr
from kornia_tidy.reconstruction.pretrained import load_pretrained
from kornia_tidy.reconstruction.tikhonov import tikhonov
from kornia_tidy.sensor.sensor import SensorNoise
from tests.lab.calibration.psf.captures import exposed, on_pixels, planes, point_light

CAMERA, SPECTRUM = ThinLensCamera(), Spectrum.rgb()
CUTOFF = [diffraction_cutoff(CAMERA, wavelength) for wavelength in SPECTRUM.wavelengths]
EXPOSURES = torch.tensor([1.0, 8.0, 64.0])
DISTANCES = (0.32, 0.595, 2.0)
SENSORS = {"10500 e, 2.4 e": (10500.0, 2.4), "2000 e, 5 e": (2000.0, 5.0)}
TILES = {"three chips": None, "RGGB": ((0, 1), (1, 2))}
BACKGROUND, SIDE, WINDOW = 0.003, 201, 61  # share of full scale; pixels
WEIGHTS, SIGMA = (1e-3, 3e-3, 1e-2, 3e-2), 0.01


def systems() -> dict[str, PhaseMasks]:
    """Masks of all kinds: none, one designed, five of noise, five learnt."""
    return {
        "plain lens": PixelwiseMask(1, initial="flat"),
        "Fisher": PixelwiseMask(1, initial=fisher_mask()),
        "5 of noise": PixelwiseMask(5, generator=torch.Generator().manual_seed(0)),
        "edof-5": load_pretrained("edof-5").optics.masks,
    }


def light_of(masks: PhaseMasks, distance: float) -> Tensor:
    """Share of a point's light in each ninth of a pixel."""
    return point_light(masks, float(CAMERA.defocus(torch.tensor(distance))), SIDE, SPECTRUM, CAMERA)


def calibrate(
    distance: float,
    coded: Tensor,
    flat: Tensor,
    sensor: tuple[float, float],
    tile: tuple[tuple[int, ...], ...] | None,
    places: int,
) -> MeasuredPSFs:
    """Take the captures of one distance and measure the PSFs."""
    generator = torch.Generator().manual_seed(0)
    span = 31  # ninths: farther than a grain of dust is wide
    images = []
    for _ in range(places):
        ninths = tuple(torch.randint(-span, span + 1, (2,), generator=generator).tolist())
        light, clear = on_pixels(coded, ninths), on_pixels(flat, ninths)
        if tile is not None:
            light, clear = planes(light, tile), planes(clear, tile)
        frames = exposed(0.5 * light / light.max(), EXPOSURES, generator, *sensor, BACKGROUND)
        reference = exposed(0.8 * clear / clear.max(), torch.ones(1), generator, *sensor, BACKGROUND)[0]
        noise = SensorNoise.physical(*sensor, bits=12)
        images += point_images(frames, EXPOSURES, noise, WINDOW, reference=reference, tile=tile)
    return measure_psfs({distance: images}, CAMERA, WINDOW, CUTOFF)


def scores(whole: Tensor, truth: Tensor, measured: Tensor) -> list[float]:
    """PSNR of Tikhonov with each of the PSFs, of a capture made with the whole one, at the best weight."""
    scene = dead_leaves(192, 192, num_leaves=300, seed=1)[0][None]
    radius = whole.shape[-1] // 2
    blurred = conv2d(pad(scene, (radius,) * 4, mode="circular"), whole.flip(-2, -1)[:, None], groups=3)
    capture = blurred + SIGMA * torch.randn(blurred.shape, generator=torch.Generator().manual_seed(1))

    def score(psf: Tensor, weight: float) -> float:
        estimate = tikhonov(capture, psf, weight, prior=capture, border="circular").clamp(0, 1)
        return float(psnr(estimate, scene).mean())

    best = max(WEIGHTS, key=lambda weight: score(truth, weight))
    return [score(psf, best) for psf in (whole, truth, measured)]


def main() -> None:
    """Measure and print, a line as soon as it is known."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--systems", nargs="+", default=list(systems()), choices=list(systems()))
    parser.add_argument("--tiles", nargs="+", default=list(TILES), choices=list(TILES))
    parser.add_argument("--sensors", nargs="+", default=list(SENSORS), choices=list(SENSORS))
    parser.add_argument("--distances", type=float, nargs="+", default=list(DISTANCES))
    parser.add_argument("--places", type=int, default=16)
    args = parser.parse_args()
    names = "masks, filters, full well and read, distance in m, psi, light held, places used"
    names += ", L1 in %, said in %, true bank in dB, measured less true, measured less whole"
    columns = names.split(", ")
    print("|", " | ".join(columns), "|\n" + "|---" * len(columns) + "|")
    for name in args.systems:
        for distance in args.distances:
            coded, flat = light_of(systems()[name], distance), light_of(systems()["plain lens"], distance)
            whole = on_pixels(coded)
            first = SIDE // 2 - WINDOW // 2
            truth = whole[:, first : first + WINDOW, first : first + WINDOW]
            held = float((truth.sum((1, 2)) / whole.sum((1, 2))).min())
            whole, truth = (psf / psf.sum((1, 2), keepdim=True) for psf in (whole, truth))
            for filters in args.tiles:
                for words in args.sensors:
                    try:
                        found = calibrate(distance, coded, flat, SENSORS[words], TILES[filters], args.places)
                    except ValueError as refusal:
                        print(f"| {name} | {filters} | {words} | {distance:g} | refused: {refusal} |", flush=True)
                        continue
                    psf = found.bank.psfs[0]
                    error = float((psf - truth).abs().sum((1, 2)).max())
                    said = 0.798 * float(found.uncertainty[0].sum((1, 2)).max())
                    used = sum(report.rejected is None for report in found.reports)
                    known, true, measured = scores(whole, truth, psf)
                    psi = float(found.bank.defocus[0])
                    print(
                        f"| {name} | {filters} | {words} | {distance:g} | {psi:+.1f} | {held:.2f} | {used} | "
                        f"{100 * error:.2f} | {100 * said:.2f} | {true:.2f} | {measured - true:+.2f} | "
                        f"{measured - known:+.2f} |",
                        flush=True,
                    )


if __name__ == "__main__":
    main()
