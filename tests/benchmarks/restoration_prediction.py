"""Compares the error of restoration that mask design predicts with that of simulated captures, on half A of the scenes.

A flat lens at several f-numbers and the five shipped masks, at equal exposure time and three amounts of light. Captures
have PSFs of 129 pixels, stray light as background, shot and read noise. They are restored by the Wiener filter, and by
it with less regularisation and a bilateral filter after it.

- ``python -m tests.benchmarks.restoration_prediction render FOLDER``: captures without noise; goes on where it stopped.
- ``... score FOLDER``: restores noisy captures, into FOLDER/scores.csv; goes on where it stopped.
- ``... table FOLDER``: Markdown, gains over the flat lens at f/50: predicted and measured.
"""

from __future__ import annotations

import argparse
import csv
import math
import statistics
import sys
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import torch
from kornia.color import linear_rgb_to_rgb, rgb_to_linear_rgb
from torch import Tensor
from tqdm import tqdm

from kornia_tidy import Fidelity, PixelwiseMask, TiDyOptics
from kornia_tidy.data import PHOTOGRAPHS, SceneStatistics
from kornia_tidy.design.objectives import restoration_error
from kornia_tidy.masks.base import PhaseMasks
from kornia_tidy.optics.thin_lens import ThinLensCamera
from kornia_tidy.psf.psf_bank import PSFBank
from kornia_tidy.reconstruction.periodic import periodic_extension
from kornia_tidy.reconstruction.pretrained import load_pretrained
from kornia_tidy.reconstruction.wiener import TransferMoments, inverse_spectrum, transfer_moments
from kornia_tidy.render.borders import next_fast_size
from kornia_tidy.sensor import exposed_sensor
from tests.benchmarks.system_scores import RealScenes
from tests.scenes import halves

REFERENCE = 17.6  # f-number at which electrons are counted
LIGHTS = (57_000, 10_000, 2_000)  # electrons of white
F_NUMBERS = {"flat": (50, 35, 71, 25), "K = 5": (17.6, 25, 22, 35)}
BASE = ("flat", 50.0)  # gains are over this
FIDELITY = Fidelity("capture", layers="linear", window=129, stray_light="veil")
OLD = SceneStatistics(2.0, 1 / 64, 0.25, 0.2, source="assumed before 2026-11-22")
# Weight of the noise in the filter, and colour range of a bilateral filter of the encoded result (none: no filter).
RESTORATIONS = {
    "Wiener": (1.0, None),
    "Wiener 0.3, bilateral 0.1": (0.3, 0.1),
    "Wiener 0.3, bilateral 0.2": (0.3, 0.2),
}
FIELDS = ("optics", "f_number", "electrons", "scene", "restoration", "linear", "encoded")


def camera_at(optics: str, f_number: float) -> TiDyOptics:
    """Return a camera of some masks at an f-number, without noise, for linear light and the default range of depth."""
    masks: PhaseMasks = PixelwiseMask(1, initial="flat") if optics == "flat" else load_pretrained("edof-5").optics.masks
    lens = ThinLensCamera(aperture_diameter=50e-3 / f_number)
    lo, hi = lens.defocus_range
    fidelity = FIDELITY.replace(layer_spacing=min(1.0, (hi - lo) / 16))
    return TiDyOptics(masks, lens, sensor=None, fidelity=fidelity, color_space="linear")


def pairs() -> list[tuple[str, float]]:
    """Return each optics and f-number."""
    return [(optics, float(number)) for optics, numbers in F_NUMBERS.items() for number in numbers]


def scenes() -> Iterator[tuple[str, Tensor, Tensor]]:
    """Yield name, linear light and depth of the scenes of half A."""
    real = RealScenes(ThinLensCamera())
    for name in halves(real.names)[0]:
        sample = real[real.names.index(name)]
        yield name, rgb_to_linear_rgb(sample["image"][None]), sample["depth"][None]


@torch.no_grad()
def render(folder: Path) -> None:
    """Render captures without noise."""
    folder.mkdir(parents=True, exist_ok=True)
    missing = [pair for pair in pairs() if not (folder / f"{pair[0]} {pair[1]:g}.pt").exists()]
    for optics, number in missing:
        camera = camera_at(optics, number)
        captures = {
            name: (light, camera(light, depth))
            for name, light, depth in tqdm(scenes(), desc=f"{optics} f/{number:g}", total=18)
        }
        torch.save(captures, folder / f"{optics} {number:g}.part")
        (folder / f"{optics} {number:g}.part").rename(folder / f"{optics} {number:g}.pt")


@torch.no_grad()
def score(folder: Path) -> None:
    """Restore captures with noise, and write the mean squared errors."""
    path = folder / "scores.csv"
    done = {(row["optics"], float(row["f_number"])) for row in read(path)} if path.exists() else set()
    for optics, number in pairs():
        if (optics, number) in done:
            continue
        captures = torch.load(folder / f"{optics} {number:g}.pt")
        bank, rows = camera_at(optics, number).psf_bank(), []
        filters = {}
        for seed, (name, (light, capture)) in enumerate(tqdm(captures.items(), desc=f"{optics} f/{number:g}")):
            size = (next_fast_size(light.shape[-2] + 129), next_fast_size(light.shape[-1] + 129))
            if size not in filters:
                weights = PHOTOGRAPHS.depth_weights(bank.defocus)
                filters[size] = transfer_moments(bank.psfs, size, weights, bank.veil)
            for electrons in LIGHTS:
                found = _scored(light, capture, filters[size], number, electrons, seed)
                rows.extend((optics, number, electrons, name, *row) for row in found)
        new = not path.exists()
        with path.open("a", newline="") as file:
            csv.writer(file).writerows([FIELDS] * new + rows)


def _scored(
    light: Tensor, capture: Tensor, moments: TransferMoments, number: float, electrons: float, seed: int
) -> Iterator[tuple[str, float, float]]:
    sensor = exposed_sensor(number, electrons, REFERENCE)
    noisy = sensor(capture, generator=torch.Generator().manual_seed(seed))
    size = (moments.power.shape[-2], 2 * (moments.power.shape[-1] - 1))
    spectrum = torch.fft.rfft2(periodic_extension(noisy, size))
    noise = sensor.std(capture.mean((-2, -1), keepdim=True)).square() * inverse_spectrum(PHOTOGRAPHS, size).float()
    truth = linear_rgb_to_rgb(light)
    restored: dict[float, Tensor] = {}
    for name, (weight, colour) in RESTORATIONS.items():
        if weight not in restored:
            gain = moments.mean.conj() / (moments.power + weight * noise)
            plane = torch.fft.irfft2(spectrum * gain, s=size)[..., : light.shape[-2], : light.shape[-1]]
            restored[weight] = linear_rgb_to_rgb(plane.clamp(0, 1))
        encoded = restored[weight] if colour is None else _smoothed(restored[weight], colour)
        linear = float((rgb_to_linear_rgb(encoded) - light).square().mean())
        yield name, linear, float((encoded - truth).square().mean())


def _smoothed(encoded: Tensor, colour: float) -> Tensor:
    """Return an image after a bilateral filter."""
    plane = encoded[0].permute(1, 2, 0).contiguous().numpy()
    return torch.from_numpy(cv2.bilateralFilter(plane, 7, colour, 2.0)).permute(2, 0, 1)[None]


def read(path: Path) -> list[dict[str, str]]:
    """Return the rows of a table."""
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def predictions(bank: PSFBank, number: float, electrons: float) -> dict[str, float]:
    """Return PSNR in decibels by each form of the measure."""
    sensor = exposed_sensor(number, electrons, REFERENCE)
    forms = {"before": OLD, "linear": replace(PHOTOGRAPHS, shade=1.0), "sRGB": PHOTOGRAPHS}
    return {
        name: -10 * math.log10(float(restoration_error(bank, sensor, form)) * form.spread**2)
        for name, form in forms.items()
    }


@torch.no_grad()
def table(folder: Path) -> None:
    """Print the gains over the base: predicted, and measured in several ways."""
    rows = read(folder / "scores.csv")
    errors = defaultdict(dict)
    for row in rows:
        key = row["optics"], float(row["f_number"]), int(row["electrons"]), row["restoration"]
        errors[key][row["scene"]] = float(row["linear"]), float(row["encoded"])
    banks = {pair: camera_at(*pair).psf_bank() for pair in pairs() if (*pair, LIGHTS[0], "Wiener") in errors}

    def mean_db(key: tuple[str, float, int, str], column: int) -> float:
        return statistics.fmean(-10 * math.log10(each[column]) for each in errors[key].values())

    def pooled_db(key: tuple[str, float, int, str]) -> float:
        return -10 * math.log10(statistics.fmean(each[0] for each in errors[key].values()))

    def best(pair: tuple[str, float], electrons: int) -> float:
        return max(mean_db((*pair, electrons, name), 1) for name in RESTORATIONS)

    print("| e- | optics | f^-2 | linear | sRGB | pooled, linear | linear | sRGB | + bilateral |")
    print("|---|---|---|---|---|---|---|---|---|")
    for electrons in LIGHTS:
        reference = predictions(banks[BASE], BASE[1], electrons)
        for pair in pairs():
            if pair not in banks:
                continue
            found = predictions(banks[pair], pair[1], electrons)
            here, there = (*pair, electrons, "Wiener"), (*BASE, electrons, "Wiener")
            cells = [found[name] - reference[name] for name in found]
            cells += [pooled_db(here) - pooled_db(there), mean_db(here, 0) - mean_db(there, 0)]
            cells += [mean_db(here, 1) - mean_db(there, 1), best(pair, electrons) - best(BASE, electrons)]
            print(f"| {electrons} | {pair[0]} f/{pair[1]:g} | " + " | ".join(f"{c:+.2f}" for c in cells) + " |")


def main() -> None:
    """Run the command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("command", choices=("render", "score", "table"))
    parser.add_argument("folder", type=Path)
    args = parser.parse_args()
    {"render": render, "score": score, "table": table}[args.command](args.folder)


if __name__ == "__main__":
    torch.set_num_threads(1)
    sys.exit(main())
