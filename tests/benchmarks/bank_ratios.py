"""What more masks and more wavelengths cost a capture: ratios within one run, bank made anew or remembered.

Not named ``test_``: it times pictures of a megapixel for minutes, which the check that every suite runs once must not.

Run with ``pytest tests/benchmarks/bank_ratios.py -s``. The picture is random, its depth a smooth ramp with waves over
the whole range; 21 nearest layers, masks of 23 x 23 pixels, PSFs of 23. Candidates take turns; medians. The bank alone
is timed by a wavelength, with and without gradients.
"""

from __future__ import annotations

import os
from collections.abc import Callable

import pytest
import torch

from kornia_tidy import Fidelity, PixelwiseMask, Spectrum, TiDyOptics
from kornia_tidy.optics import camera_spectrum
from kornia_tidy.optics.bank_memory import BankMemory
from tests.benchmarks.conftest import SIZE_VARIABLE
from tests.benchmarks.rendering_against_peers import in_turn

SIDE = int(os.environ.get(SIZE_VARIABLE, "1024"))
ROUNDS = 15


def make_optics(masks: int, spectrum: Spectrum, window: int = 23) -> TiDyOptics:
    fidelity = Fidelity(layers="nearest", layer_spacing=2.0, window=window)
    return TiDyOptics(PixelwiseMask(masks), sensor=None, fidelity=fidelity, spectrum=spectrum)


def make_scene() -> tuple[torch.Tensor, torch.Tensor]:
    y, x = torch.meshgrid(torch.linspace(-19, 19, SIDE), torch.linspace(0, 9, SIDE), indexing="ij")
    defocus = (y + torch.sin(3 * x)).clamp(-19.9, 19.9)[None, None]
    depth = 1 / (1 / 0.595 + defocus * 530e-9 / (torch.pi * 1.4175e-3**2))
    return torch.rand(1, 3, SIDE, SIDE), depth


def forget(optics: TiDyOptics) -> None:
    optics._memory = BankMemory()


def captures(optics: TiDyOptics) -> dict[str, Callable[[], object]]:
    """A capture that makes its bank, one that remembers it, and the bank alone."""
    scene = make_scene()

    def anew() -> object:
        forget(optics)
        return optics(*scene)

    def bank() -> object:
        forget(optics)
        return optics.psf_bank()

    return {"bank included": anew, "bank remembered": lambda: optics(*scene), "bank alone": bank}


def report(title: str, few: TiDyOptics, many: TiDyOptics) -> None:
    sides = {"few": captures(few), "many": captures(many)}
    with torch.no_grad():
        medians = {}
        for kind in sides["few"]:  # one kind at a time, or the banks' making would evict what is remembered
            medians |= in_turn({f"{side} {kind}": sides[side][kind] for side in sides}, ROUNDS)
    print(f"\n{title}: {SIDE}^2 pixels, {torch.get_num_threads()} threads")
    for kind in sides["few"]:
        one, other = medians[f"few {kind}"], medians[f"many {kind}"]
        print(f"{kind:16} {one:7.1f} -> {other:7.1f} ms  {other / one:5.2f} x")
    assert all(own > 0 for own in medians.values())


def test_ratio_of_16_masks_to_1():
    report("16 masks against 1", make_optics(1, Spectrum.rgb()), make_optics(16, Spectrum.rgb()))


def test_ratio_of_31_wavelengths_to_3():
    report("31 wavelengths against 3", make_optics(5, Spectrum.rgb()), make_optics(5, camera_spectrum(samples=31)))


@pytest.mark.parametrize("window", [23, 65])
@pytest.mark.parametrize("masks", [1, 5, 16])
def test_bank_by_the_wavelength(masks, window):
    optics = make_optics(masks, Spectrum.rgb(), window)

    def forward() -> object:
        forget(optics)
        with torch.no_grad():
            return optics.psf_bank()

    def backward() -> object:
        return torch.autograd.grad(optics.psf_bank().psfs.square().sum(), optics.masks.phase)

    medians = in_turn({"forward": forward, "with gradients": backward}, ROUNDS)
    print(f"\n{masks} masks, {window} px:", ", ".join(f"{k} {v / 3:.2f} ms a wavelength" for k, v in medians.items()))
    assert all(own > 0 for own in medians.values())
