"""How like photographs the painted training scenes are: distances in power spectrum, gradients, light and colour.

``python -m tests.benchmarks.scene_likeness [--scenes N] [--photographs FOLDER]`` prints a table. The photographs to
compare with are those of half A of the real scenes (``HALF_A``), from which settings may be taken; nothing is trained
on them. A row compares the two halves of half A, which is as near as sets of this size come to each other.

All pictures are cut into tiles of 224 px and rounded to 8 bits. Each scene counts the same.

- spectrum: root mean square difference over octave thirds of the mean log power of linear light, in dB;
- gradients, light, colour: total variation distance (0 to 1) of the histograms of differences between neighbouring
  pixels, of luminance, and of two colour differences, all of sRGB values.

A second table is about outlines of depth: how many pixels lie at them, and how much steeper the image is there than far
from them. Where a sensor's depth map is some pixels beside the image, it is no steeper.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import torch
from kornia.color import rgb_to_linear_rgb
from numpy.typing import NDArray
from torch import Tensor

from kornia_tidy.data.dead_leaves import DeadLeaves
from kornia_tidy.data.photo_collages import PhotoCollages, photographs_in
from kornia_tidy.data.photographic_leaves import PhotographicLeaves
from kornia_tidy.data.scene_dataset import SceneDataset
from kornia_tidy.optics.thin_lens import ThinLensCamera
from kornia_tidy.reconstruction.tasks import normalised_inverse_depth
from tests.benchmarks.results.scenes import real_scenes
from tests.scenes import ENTRIES, load_scene

TILE = 224
LUMA = (0.2126, 0.7152, 0.0722)
BANDS = np.geomspace(1.9 / TILE, 0.5, 18)  # cycles a pixel
STEPS = np.array([0, 0.5, 1.5, 3.5, 7.5, 15.5, 31.5, 63.5, 256]) / 255  # of gradients
LEVELS = np.linspace(0, 1, 17)
CHROMA = np.concatenate([[-1], np.linspace(-0.3, 0.3, 16), [1]])
SEED = 20261122  # of no training
JUMP = 0.06  # of normalised inverse depth, between neighbouring pixels
AT, FAR = 1.5, 14.0  # px from an outline
FEWEST = 50  # outline pixels that a scene must have
DEPTHS = ThinLensCamera().depth_range


def half_a() -> list[str]:
    """Return the names of the real scenes from which settings may be taken."""
    names = sorted(ENTRIES)
    order = torch.randperm(len(names), generator=torch.Generator().manual_seed(0)).tolist()
    return [names[place] for place in order[:18]]


class Statistics(NamedTuple):
    """Statistics of a set of scenes."""

    spectrum: NDArray[np.float64]
    """Mean over the scenes of the log power in each band, dB."""
    gradients: NDArray[np.float64]
    light: NDArray[np.float64]
    colour: NDArray[np.float64]
    mean: float
    """Of linear light."""
    spread: float
    """Standard deviation of linear light over all scenes."""
    exponent: float
    """Slope of log power over log frequency, above 1/32 cycles a pixel."""


def statistics(images: Iterable[Tensor]) -> Statistics:
    """Return the statistics of scenes, (3, H, W) sRGB."""
    rows = [[_tile_statistics(tile) for tile in tiles(image)] for image in images]
    scenes = [[np.mean(column, 0) for column in zip(*row, strict=True)] for row in rows]
    spectrum, gradients, light, colour, first, second = (np.mean(column, 0) for column in zip(*scenes, strict=True))
    middle = np.sqrt(BANDS[1:] * BANDS[:-1])
    fine = middle > 1 / 32
    exponent = np.polyfit(10 * np.log10(middle[fine]), spectrum[fine], 1)[0]
    return Statistics(spectrum, gradients, light, colour, float(first), float((second - first**2) ** 0.5), exponent)


def tiles(image: Tensor) -> Iterator[Tensor]:
    """Yield the whole tiles of a picture, those in the middle if they leave a rest."""
    rows, columns = (side // TILE for side in image.shape[-2:])
    top, left = (image.shape[-2] - rows * TILE) // 2, (image.shape[-1] - columns * TILE) // 2
    for row in range(rows):
        for column in range(columns):
            y, x = top + row * TILE, left + column * TILE
            yield (image[:, y : y + TILE, x : x + TILE] * 255).round() / 255


def distances(one: Statistics, other: Statistics) -> tuple[float, float, float, float]:
    """Return the distances in spectrum (dB), gradients, light and colour."""
    spectrum = float(np.sqrt(np.mean((one.spectrum - other.spectrum) ** 2)))
    histograms = (abs(a - b).sum() / 2 for a, b in zip(one[1:4], other[1:4], strict=True))
    return spectrum, *(float(value) for value in histograms)  # ty: ignore[invalid-return-type]


class Outlines(NamedTuple):
    """Of depth, for each scene."""

    shares: list[float]
    """Of pixels at which depth jumps."""
    steepness: list[float]
    """Mean gradient of the image at outlines over that far from them; scenes with few outlines are left out."""


def outlines(scenes: Iterable[tuple[Tensor, Tensor]]) -> Outlines:
    """Return how outlines of depth lie in scenes: images (3, H, W) and normalised inverse depths (1, H, W)."""
    found = Outlines([], [])
    for image, depth in scenes:
        luma = cv2.GaussianBlur(np.tensordot(LUMA, image.double().numpy(), 1), (0, 0), 0.7)
        gradient = np.hypot(cv2.Sobel(luma, -1, 1, 0), cv2.Sobel(luma, -1, 0, 1))
        plane = depth[0].double().numpy()
        jumps = [np.abs(np.diff(plane, axis=axis, prepend=plane.take([0], axis))) for axis in (0, 1)]
        edge = np.maximum(*jumps) > JUMP
        found.shares.append(float(edge.mean()))
        distance = cv2.distanceTransform((~edge).astype(np.uint8), cv2.DIST_L2, 5)
        far = distance > FAR
        if edge.sum() >= FEWEST and far.any():
            found.steepness.append(float(gradient[distance < AT].mean() / gradient[far].mean()))
    return found


def _tile_statistics(tile: Tensor) -> tuple[NDArray[np.float64] | float, ...]:
    linear = np.tensordot(LUMA, rgb_to_linear_rgb(tile[None])[0].double().numpy(), 1)
    luma = np.tensordot(LUMA, tile.double().numpy(), 1)
    red, green, blue = tile.double().numpy()
    steps = np.abs(np.concatenate([np.diff(luma, axis=0).ravel(), np.diff(luma, axis=1).ravel()]))
    chroma = np.histogram2d((red - blue).ravel(), (green - (red + blue) / 2).ravel(), CHROMA)[0]
    light = np.histogram(luma, LEVELS)[0]
    return (
        _spectrum(linear), np.histogram(steps, STEPS)[0] / steps.size, light / light.sum(), chroma / chroma.sum(),
        linear.mean(), (linear**2).mean(),
    )  # fmt: skip


def _spectrum(light: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the power of a tile in each band, in dB of squared full scale a pixel."""
    window = np.hanning(TILE)[:, None] * np.hanning(TILE)
    power = np.abs(np.fft.fft2((light - light.mean()) * window)) ** 2 / (window**2).sum()
    frequency = np.hypot(np.fft.fftfreq(TILE)[:, None], np.fft.fftfreq(TILE)[None])
    sums, counts = (np.histogram(frequency, BANDS, weights=weights)[0] for weights in (power, np.ones_like(power)))
    return 10 * np.log10(np.maximum(sums / counts, 1e-12))


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=int, default=64, help="painted scenes of each kind (default: 64)")
    parser.add_argument("--photographs", type=Path, metavar="FOLDER", help="measure collages of them, too")
    args = parser.parse_args()
    count = args.scenes
    if not ENTRIES:
        raise SystemExit("../shared/data is not on this machine: there are no photographs to compare with")
    pictures = {name: load_scene(name).image for name in half_a()}
    photographs = [image.expand(3, -1, -1) for name, image in pictures.items() if not name.startswith("flying")]
    painted: dict[str, SceneDataset] = {
        "dead leaves": DeadLeaves(count, 256, 256, depth_range=DEPTHS, seed=SEED),
        "photographic leaves": PhotographicLeaves(count, 256, 256, depth_range=DEPTHS, seed=SEED),
    }
    if args.photographs is not None:
        painted["photo collages"] = PhotoCollages(
            photographs_in(args.photographs), count, 256, 256, depth_range=DEPTHS, seed=SEED
        )
    sets = {
        f"photographs of half A ({len(photographs)})": photographs,
        "every second one of them": photographs[::2],
        "the others of them": photographs[1::2],
        **{f"{name} ({count})": [scenes[i]["image"] for i in range(count)] for name, scenes in painted.items()},
        "flying things (2)": [image for name, image in pictures.items() if name.startswith("flying")],
    }
    measured = {name: statistics(images) for name, images in sets.items()}
    first, even, odd, *others = measured
    pairs = {f"{odd}, to every second": (measured[even], measured[odd])}
    pairs |= {name: (measured[first], measured[name]) for name in others}
    print("| scenes | spectrum, dB | gradients | light | colour | exponent | mean light | spread |")
    print("|---|---|---|---|---|---|---|---|")
    about = measured[first]
    print(f"| {first} | | | | | {about.exponent:.2f} | {about.mean:.3f} | {about.spread:.3f} |")
    for name, (reference, own) in pairs.items():
        spectrum, *histograms = distances(reference, own)
        cells = [f"{spectrum:.1f}", *(f"{value:.3f}" for value in histograms)]
        print(f"| {name} | {' | '.join(cells)} | {own.exponent:.2f} | {own.mean:.3f} | {own.spread:.3f} |")
    print(
        "\n| scenes | pixels at outlines of depth | image there, times as steep: quartiles of scenes |\n|---|---|---|"
    )
    real, camera = real_scenes(), ThinLensCamera()
    with_depth = {"half A": [(scene.image[0], scene.inverse_depth[0]) for scene in map(real.load, real.half_a)]}
    for name, scenes in painted.items():
        items = [scenes[i] for i in range(count)]
        with_depth[name] = [(item["image"], normalised_inverse_depth(camera, item["depth"])) for item in items]
    for name, pairs_of_maps in with_depth.items():
        shares, steepness = outlines(pairs_of_maps)
        quartiles = ", ".join(f"{value:.1f}" for value in np.percentile(steepness, (25, 50, 75)))
        print(f"| {name} ({len(shares)}) | {100 * np.mean(shares):.1f} % | {quartiles} |")


if __name__ == "__main__":
    main()
