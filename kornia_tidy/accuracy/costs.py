"""The work and the memory of a capture before it is taken."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import cache

import torch
from torch import Tensor

from kornia_tidy.fidelity import Fidelity
from kornia_tidy.optics.quadrature import gauss_legendre_order
from kornia_tidy.optics.spectrum import Spectrum
from kornia_tidy.psf.energies import energy_operations
from kornia_tidy.psf.field import Field
from kornia_tidy.psf.psf_model import PSFModel
from kornia_tidy.render.backend import Work
from kornia_tidy.render.dispatch import choose, refusal
from kornia_tidy.render.scene import layered_scene

_points = cache(gauss_legendre_order)


def bank_work(model: PSFModel, spectrum: Spectrum, states: int, fidelity: Fidelity, layers: int) -> Work:
    r"""Return the work of an exact PSF bank.

    For each layer and wavelength as many operations as :func:`~kornia_tidy.psf.energies.energy_operations` says, of its
    two ways the one with fewer. The bank holds its PSFs, and its kernels four times: as remembered, in one piece, and
    as real matrices.

    Args:
        model: whose aperture and pixels count.
        spectrum: whose wavelengths count.
        states: masks shown during the exposure.
        fidelity: its window, points and precision count.
        layers: how many.

    Example:
        >>> print(bank_work(PSFModel(), Spectrum.rgb(), 5, Fidelity(window=65), 21))
        1e+09 operations, 5 MiB
    """
    pupil, window, real = model.pupil, window_side(fidelity), 8 if fidelity.double else 4
    cells, phase = pupil.amplitude.shape[-1], 2 * math.pi * pupil.extent * float(model.pixel_step)
    orders = [_points(phase / wavelength, fidelity.pixel_tolerance) for wavelength in spectrum.wavelengths]
    ways = [energy_operations(states, window, order, cells) for order in orders]
    psfs, kernels = len(spectrum.plane_weights) * window**2, 2 * window * max(orders) * cells
    return Work(real / 4 * layers * sum(min(each) for each in ways), real * layers * (psfs + 4 * kernels))


def window_side(fidelity: Fidelity) -> int:
    """Return the fixed window of a fidelity.

    Raises:
        ValueError: if it has none.
    """
    if fidelity.window is None:
        raise ValueError(f"a fidelity to plan with needs a fixed window, got window=None of {fidelity.name!r}")
    return fidelity.window


def rendering_work(
    defocus: Tensor,
    batch: int,
    channels: int,
    nodes: Sequence[float],
    window: int,
    *,
    layers: str = "linear",
    compositing: str = "gather",
    border: str = "reflect",
    double: bool = False,
    field: Field | None = None,
) -> Work:
    """Return the work of rendering a scene through a bank, from the layers of its pixels.

    Args:
        defocus: (B or 1, 1, H, W) radians.
        batch: images B.
        channels: of the images.
        nodes: defocus of the layers that are rendered.
        window: side of the PSFs.
        layers: ``"nearest"`` or ``"linear"``.
        compositing: ``"gather"``, ``"scatter"`` or ``"occlusion"``.
        border: continuation of the image beyond its edges.
        double: in float64.
        field: where over the picture PSFs are known, of gather and scatter.

    Example:
        >>> flat = torch.zeros(1, 1, 64, 64)
        >>> rendering_work(flat, 1, 3, (-1.0, 0.0, 1.0), 5).operations == 3 * 64**2 * 2 * 2 * 5**2
        True
    """
    dtype = torch.float64 if double else torch.float32
    image = torch.zeros((), dtype=dtype, device=defocus.device).expand(batch, channels, *defocus.shape[-2:])
    psfs = image.new_zeros(()).expand(len(nodes), channels, window, window)
    at = defocus.new_tensor(list(nodes))
    if compositing == "gather" and border != "valid":  # pixels beyond the image cost nothing
        border = "replicate"
    scene = layered_scene(image, defocus, at, psfs, None, compositing, layers, border)
    # A processor's choice looks at the PSFs' values: of one layer, as all of a wide range would take gigabytes.
    one = replace(scene, psfs=psfs[:1]) if psfs.device.type == "cpu" else scene
    backend = choose(one)
    if field is None:
        return backend.work(scene)
    over = replace(scene, psfs=psfs.expand(len(field.points), *psfs.shape), field=field)
    if refusal(backend, over) is None:
        return backend.work(over)
    work = backend.work(scene)  # cell by cell, a value and two gradients
    return replace(work, operations=3 * work.operations)
