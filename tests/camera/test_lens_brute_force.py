"""Captures through a real lens against the sum that computes the PSF of each pixel, on twenty scenes."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor
from torch.nn.functional import fold, unfold

from kornia_tidy import Fidelity, PixelwiseMask, Spectrum, TiDyOptics
from kornia_tidy.data import dead_leaves
from tests.base import BaseTester

SIDE, RADIUS = 15, 7  # px of a PSF
SIZE, CENTER = (64, 80), (523.0, 601.0)  # the corner of 1110x1282 px
COMPOSITING = ("gather", "scatter", "occlusion")
SCENES = 20


def camera(compositing: str = "gather", **settings: float) -> TiDyOptics:
    fidelity = Fidelity(window=SIDE, layer_spacing=10.0, **settings)
    masks = PixelwiseMask(1, generator=torch.Generator().manual_seed(3))
    parts = {"spectrum": Spectrum.monochrome(), "lens": "single-50mm", "field_center": CENTER, "border": "zero"}
    return TiDyOptics(masks, sensor=None, color_space="linear", fidelity=fidelity, compositing=compositing, **parts)


def scene(seed: int) -> tuple[Tensor, Tensor]:
    """Leaves, noise on steps of depth, point lights, and texture that goes with depth, in turn."""
    random = torch.Generator().manual_seed(seed)
    if seed % 4 == 0:
        image, depth = dead_leaves(*SIZE, depth_range=(0.3, 5.0), num_leaves=80, seed=seed)
        return image[None, 1:2], depth[None]
    steps = torch.rand(1, 1, 8, 10, generator=random).repeat_interleave(8, 2).repeat_interleave(8, 3)
    noise = torch.rand(1, 1, *SIZE, generator=random)
    near = noise if seed % 4 == 3 else steps
    light = {1: noise, 2: (noise > 0.98).float(), 3: near.square()}[seed % 4]
    return light, 1 / (0.2 + 3 * near)


def places() -> list[tuple[float, float]]:
    rows, columns = ([c + i - (n - 1) / 2 for i in range(n)] for c, n in zip(CENTER, SIZE, strict=True))
    return [(y, x) for y in rows for x in columns]


def brute_force(compositing: str, light: Tensor, psi: Tensor, nodes: Tensor, psfs: Tensor, lit: Tensor) -> Tensor:
    """Return the capture, (H, W), beyond whose edges is nothing.

    Args:
        compositing: as of the camera.
        light: (1, 1, H, W).
        psi: (1, 1, H, W) radians.
        nodes: (D,) radians, evenly spaced.
        psfs: of each pixel, (N, D, P, P).
        lit: light of each pixel's place, (N, D).
    """
    weights = (1 - (psi - nodes[:, None, None]).abs() / (nodes[1] - nodes[0])).clamp(min=0)  # (1, D, H, W)

    def around(planes: Tensor) -> Tensor:
        """Sum planes (1, D, H, W) over the PSFs of the pixel that sees: (D, H, W)."""
        patches = unfold(planes, SIDE, padding=RADIUS).view(len(nodes), SIDE**2, -1)
        return torch.einsum("ndp,dpn->dn", psfs.flip(-2, -1).flatten(2), patches).view(-1, *SIZE)

    if compositing == "gather":
        return (weights[0] * around(light.expand_as(weights))).sum(0)
    if compositing == "scatter":
        spread = torch.einsum("dn,ndp->pn", (weights * light).flatten(2)[0], psfs.flatten(2))
        size = tuple(side + 2 * RADIUS for side in SIZE)
        return fold(spread[None], size, SIDE)[0, 0, RADIUS:-RADIUS, RADIUS:-RADIUS]
    seen, alpha, behind = (around(x) for x in (weights * light, weights, weights.cumsum(1)))
    hidden, total = torch.ones_like(alpha[0]), torch.zeros_like(alpha[0])
    for layer in reversed(range(len(nodes))):  # from near to far
        total += hidden * seen[layer] * lit[:, layer].view(SIZE) / (behind[layer] + 1e-6)
        hidden = hidden * (1 - alpha[layer] / (behind[layer] + 1e-6))
    return total


class TestBruteForce(BaseTester):
    @pytest.mark.slow
    @torch.no_grad()
    def test_feature_the_psf_of_each_pixel(self):
        """At the default tolerance of PSFs over the field, and at 1e-3; the axis' PSFs are some 60 times as far off."""
        model = camera().psf_model
        bank = model.psf_bank(1, field=places())
        psfs, lit = bank.psfs[:, :, 0].double(), bank.light[:, :, 0].double()
        nodes, inner = bank.defocus.double(), (..., slice(RADIUS, -RADIUS), slice(RADIUS, -RADIUS))
        ideal = model.psf_bank(1).psfs[None, :, 0].double().expand_as(psfs)
        for compositing in COMPOSITING:
            usual, fine = (camera(compositing, **given) for given in ({}, {"field_tolerance": 1e-3}))
            worst = torch.zeros(3)
            for seed in range(SCENES):
                image, depth = scene(seed)
                psi = usual.camera.defocus(depth).double().clamp(nodes[0], nodes[-1])
                given = compositing, image.double(), psi, nodes
                exact, axis = brute_force(*given, psfs, lit), brute_force(*given, ideal, torch.ones_like(lit))
                seen = usual(image, depth)[0, 0], fine(image, depth)[0, 0], axis
                worst = worst.maximum(torch.stack([(own - exact)[inner].abs().max().float() for own in seen]))
            assert worst[0] < 2e-3  # of full scale
            assert worst[1] < 1e-3
            assert worst[2] > 2e-2
