"""What the camera can do, each beside the other ways to do it: ours and theirs, in turns, in one run.

``python -m tests.benchmarks.capabilities [row ...]``; minutes. One thread, float32. Of each call the least processor
time of ``ROUNDS`` counts, because other programs can only lengthen it. The scene is Aloe (1110 x 1282), its disparity
laid linearly on [-20, 20] rad, unless a row says otherwise. Peers make the same image where nothing else is said:
``by_depth_interpolation`` and ``over`` are the ways of DeepLens (Yang et al. 2024, ``conv_psf_depth_interp`` and
``conv_psf_occlusion``), written anew.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterator
from typing import NamedTuple

import cv2
import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import conv2d, pad

from kornia_tidy import PixelwiseMask, ThinLensCamera, TiDyOptics
from kornia_tidy.render import render
from tests.benchmarks.rendering_against_peers import (
    by_kornia,
    by_one_conv2d,
    by_opencv,
    ikoma_stack,
    in_turn,
    labels_of,
    load_aloe,
    make_bank,
)
from tests.render.scenes import Bank

ROUNDS = 3
FRAMES, SIDE = 64, 256  # of a video
SMALL, MANY = 64, 256  # px of small images, and their number
F_NUMBER, FOCUS = 1.8, 2.0  # m; of the lens without a mask


class Row(NamedTuple):
    """A call and its peers, by name."""

    what: str
    ours: Callable[[], object]
    peers: dict[str, Callable[[], object]]


def by_depth_interpolation(image: Tensor, psi: Tensor, bank: Bank) -> Tensor:
    """Blur the whole image by the PSFs of all layers, and blend each pixel's two nearest."""
    radius = bank.psfs.shape[-1] // 2
    weight, padded = bank.psfs.flip((-2, -1)).transpose(0, 1)[:, :, None], pad(image, (radius,) * 4, mode="reflect")
    blurred = torch.stack([conv2d(padded[:, c : c + 1], weight[c]) for c in range(3)], 1)
    step = bank.defocus[1] - bank.defocus[0]
    layers = torch.arange(len(bank.defocus), device=psi.device)[:, None, None]
    shares = (1 - ((psi - bank.defocus[0]) / step - layers).abs()).clamp(min=0)
    return (blurred * shares.unsqueeze(1)).sum(2)


def over(image: Tensor, psi: Tensor, bank: Bank) -> Tensor:
    """Lay the layers over each other from far to near, as they are: white scenes darken at edges of depth."""
    radius = bank.psfs.shape[-1] // 2
    light, labels = (pad(x, (radius,) * 4, mode="reflect") for x in (image, labels_of(psi, bank).to(image.dtype)))
    seen = torch.zeros_like(image)
    for layer, psfs in enumerate(bank.psfs.flip((-2, -1))):
        mask = (labels == layer).to(image.dtype)
        if bool(mask.any()):
            blurred = conv2d(light * mask, psfs[:, None], groups=3)
            seen = seen * (1 - conv2d(mask, psfs[:1, None])) + blurred
    return seen


def by_discs(image: Tensor, depth: Tensor, optics: TiDyOptics) -> Tensor:
    """Blur by discs as wide as the circle of confusion, in steps of a pixel, with OpenCV; no diffraction."""
    lens = optics.camera
    blur = lens.aperture_diameter * lens.focal_length / (lens.focus_distance - lens.focal_length)
    radius = (blur * (1 - lens.focus_distance / depth).abs() / lens.pixel_pitch / 2).round()[0, 0].numpy()
    planes, coded = image[0].permute(1, 2, 0).contiguous().numpy(), np.empty((*radius.shape, 3), np.float32)
    for own in np.unique(radius):
        y, x = np.mgrid[-own : own + 1, -own : own + 1]
        disc = (np.hypot(y, x) <= own + 0.5).astype(np.float32)
        here = radius == own
        coded[here] = cv2.filter2D(planes, -1, disc / disc.sum(), borderType=cv2.BORDER_REFLECT_101)[here]
    return torch.from_numpy(coded)


def linear_layers(image: Tensor, psi: Tensor) -> Iterator[Row]:
    """21 linear layers of 23 px."""
    bank = make_bank(21, 23)
    expected = by_depth_interpolation(image, psi, bank)
    ours = render(image, psi, bank, layers="linear")
    torch.testing.assert_close(ours, expected, rtol=0, atol=1e-5)
    peers = {"DeepLens's interpolation in depth (conv2d)": lambda: by_depth_interpolation(image, psi, bank)}
    yield Row("21 linear layers, 23 px", lambda: render(image, psi, bank, layers="linear"), peers)


def occlusion(image: Tensor, psi: Tensor) -> Iterator[Row]:
    """21 layers of 23 px that hide one another."""
    bank = make_bank(21, 23)
    peers = {
        "Ikoma's equations as a dense FFT stack": lambda: ikoma_stack(image, psi, bank),
        "DeepLens's layers over each other (conv2d, not normalised)": lambda: over(image, psi, bank),
    }
    yield Row("occlusion, 21 layers, 23 px", lambda: render(image, psi, bank, "occlusion", layers="nearest"), peers)


def large_windows(image: Tensor, psi: Tensor) -> Iterator[Row]:
    """8 layers of 65 and 129 px."""
    psi = psi + 1e-3  # no pixel lies half way between two layers, where peers may choose the other one
    for window in (65, 129):
        bank = make_bank(8, window)
        peers = {
            "cv2.filter2D for each layer present": lambda bank=bank: by_opencv(image, psi, bank),
            "kornia fft_conv for each layer present": lambda bank=bank: by_kornia(image, psi, bank),
        }
        if window == 65:
            peers["one conv2d over all layers"] = lambda bank=bank: by_one_conv2d(image, psi, bank)
        ours = render(image, psi, bank, layers="nearest")
        torch.testing.assert_close(ours, peers["kornia fft_conv for each layer present"](), rtol=0, atol=1e-5)
        yield Row(
            f"8 nearest layers, {window} px",
            lambda bank=bank: render(image, psi, bank, layers="nearest"),
            peers,
        )


def ordinary_lens(image: Tensor, psi: Tensor) -> Iterator[Row]:
    """A 50 mm lens without a mask, its PSFs computed anew, before the middle of Aloe at 1.5 to 21 m."""
    image, psi = (x[..., 200:712, 300:812] for x in (image, psi))
    near = (psi - psi.min()) / (psi.max() - psi.min())
    depth = 1 / (1 / 21 + (1 / 1.5 - 1 / 21) * near)

    def camera() -> TiDyOptics:
        lens = ThinLensCamera(50e-3, 50e-3 / F_NUMBER, FOCUS, 6e-6)
        masks = PixelwiseMask(1, initial="flat").requires_grad_(False)
        return TiDyOptics(masks, lens, sensor=None, color_space="linear")

    optics = camera()
    peers = {"discs of geometric optics by cv2.filter2D": lambda: by_discs(image, depth, optics)}
    yield Row(f"50 mm f/{F_NUMBER} at {FOCUS:g} m, 512 x 512, with its PSFs", lambda: camera()(image, depth), peers)


def batches(image: Tensor, psi: Tensor) -> Iterator[Row]:
    """Eight images at once, and steps of training."""
    optics = TiDyOptics(sensor=None)
    corners = [(100 * i, 120 * i) for i in range(8)]
    images, maps = (torch.cat([x[..., t : t + 278, left : left + 278] for t, left in corners]) for x in (image, psi))
    depth = optics.camera.depth(maps)

    def step(*parts: slice) -> None:
        for part in parts:
            optics(images[part], depth[part]).square().sum().backward()

    singles = [slice(i, i + 1) for i in range(8)]
    yield Row(
        "training step, 8 x 3 x 278 x 278, five masks",
        lambda: step(slice(None)),
        {"8 steps of one": lambda: step(*singles)},
    )


def videos(image: Tensor, psi: Tensor) -> Iterator[Row]:
    """64 frames with one bank of PSFs."""
    optics = TiDyOptics(sensor=None).requires_grad_(False)
    depth = optics.camera.depth(psi)
    frames = [(image[..., t : t + SIDE, t : t + SIDE], depth[..., t : t + SIDE, t : t + SIDE]) for t in range(FRAMES)]

    def film(*, anew: bool) -> None:
        for frame in frames:
            if anew:
                optics.masks.phase.data.add_(1e-4)  # so that no PSF is remembered
            optics(*frame)

    peers = {"PSFs anew for each frame": lambda: film(anew=True)}
    yield Row(f"{FRAMES} frames of {SIDE} x {SIDE}", lambda: film(anew=False), peers)


def small_images(image: Tensor, psi: Tensor) -> Iterator[Row]:
    """As many pixels in small images as in one of 1024 x 1024."""
    optics = TiDyOptics(sensor=None).requires_grad_(False)
    whole = [x[..., :1024, :1024].contiguous() for x in (image, optics.camera.depth(psi))]
    side = 1024 // SMALL
    cut = [
        x.reshape(x.shape[1], side, SMALL, side, SMALL).permute(1, 3, 0, 2, 4).reshape(MANY, -1, SMALL, SMALL)
        for x in whole
    ]
    peers = {
        "one image of 1024 x 1024": lambda: optics(*whole),
        f"{MANY} captures": lambda: [optics(*pair) for pair in zip(*cut, strict=True)],
    }
    yield Row(f"batch of {MANY} images of {SMALL} x {SMALL}", lambda: optics(*cut), peers)


ROWS = {
    "linear": linear_layers,
    "occlusion": occlusion,
    "windows": large_windows,
    "lens": ordinary_lens,
    "batch": batches,
    "video": videos,
    "small": small_images,
}


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("rows", nargs="*", metavar="row", choices=[*ROWS, []], help=f"of {', '.join(ROWS)} (all)")
    wanted = parser.parse_args().rows
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    image, psi = load_aloe()
    print("| what | ours, ms | beside | ms | times ours |\n|---|---|---|---|---|")
    for name, rows in ROWS.items():
        if wanted and name not in wanted:
            continue
        for row in rows(image, psi):
            times = in_turn({"": row.ours, **row.peers}, ROUNDS, time.process_time, min)
            ours = times.pop("")
            for peer, own in times.items():
                print(f"| {row.what} | {ours:.1f} | {peer} | {own:.1f} | {own / ours:.2f} |", flush=True)


if __name__ == "__main__":
    main()
