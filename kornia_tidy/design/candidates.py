"""Candidates of a co-design: flat lenses and masks over f-number and focus, optimised by gradient descent."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from kornia_tidy.design.depth_confusion import depth_confusion
from kornia_tidy.design.design_task import DesignTask, mask_of
from kornia_tidy.design.objectives import design, restoration_error
from kornia_tidy.fidelity import Fidelity
from kornia_tidy.masks.base import mask_axes, metres_to_radians
from kornia_tidy.masks.initial_heights import SMALL_NOISE, fisher_mask
from kornia_tidy.masks.pixelwise import PixelwiseMask
from kornia_tidy.optics.materials import constant_index
from kornia_tidy.optics.spectrum import Spectrum
from kornia_tidy.psf.psf_model import PSFModel
from kornia_tidy.seeds import keyed_seed

FLAT = "flat lens"
STARTS = ("focal sweep", "Fisher", "random")
LEARNING_RATE = 4e-8  # m of height in the first Adam step
FOCI = (0.2, 0.3, 0.4, 0.5, 0.6)  # fractions of the range of inverse depth
DEPTH_FOCI = (0.0, 0.25, 0.5, 0.75, 1.0)  # a plain lens tells near from far only if focused at an end
_SPACING = 3.0  # rad of defocus between the depths of the search, less than the PSFs' band limit
_DEPTHS = (9, 33)  # fewest and most of them


@dataclass(frozen=True, eq=False)
class Candidate:
    """A camera that the search found.

    Args:
        start: ``"flat lens"``, or the start of its masks.
        f_number: focal length over aperture diameter.
        focus: in focus, as a fraction of the range of inverse depth, 0 at the far end.
        image_error: error of the best linear restoration, NaN if the image has no weight; see :func:`cost_of`.
        depth_error: expected RMSE of inverse depth from texture, as a fraction of the range; NaN if depth has no
            weight.
        cost: minimised cost in dB: see :func:`cost_of`.
        phase: masks in radians at 530 nm, (K, N, N); None for a flat lens.
    """

    start: str
    f_number: float
    focus: float
    image_error: float
    depth_error: float
    cost: float
    phase: Tensor | None

    @property
    def is_flat(self) -> bool:
        """Whether it has no masks."""
        return self.phase is None

    @property
    def masks(self) -> PixelwiseMask | None:
        """The masks, or None for a flat lens."""
        return None if self.phase is None else mask_of(self.phase)


def search_lens(task: DesignTask, masks: PixelwiseMask | None, f_number: float, focus: float) -> PSFModel:
    """Return the lens as the search sees it: at 530 nm, with the depths and the window that it needs."""
    lo, hi = task.camera(f_number, focus).defocus_range
    intervals = min(max(math.ceil((hi - lo) / _SPACING), _DEPTHS[0] - 1), _DEPTHS[1] - 1)
    fidelity = Fidelity(
        "search",
        pixel_tolerance=0.1,
        layer_spacing=(hi - lo) / intervals,
        window=task.search_window(f_number, focus),
        stray_light="veil",
    )
    return task.psf_model(masks, f_number, focus, fidelity, Spectrum.monochrome())


def cost_of(task: DesignTask, lens: PSFModel, f_number: float) -> tuple[Tensor, Tensor, Tensor]:
    r"""Return the cost that a co-design minimises, and its two parts.

    .. math:: 10 \log_{10} \left( R^{1 - w} E^{2 w} \right)

    w is the weight of depth. If it is 0, R is :func:`~kornia_tidy.design.objectives.restoration_error`. Otherwise
    R and E are the errors of image and depth of :func:`~kornia_tidy.design.depth_confusion.depth_confusion`.

    Args:
        task: light, statistics of the scenes and weight.
        lens: see :func:`search_lens`.
        f_number: of the lens.

    Returns:
        Cost in dB, R and E, each 0-dimensional: of a real lens the mean over the task's places, E by squares. Parts
        without a weight are NaN.
    """
    weight, unknown = task.depth_weight, torch.tensor(math.nan)
    bank = lens.psf_bank(field=task.places()) if task.lens else lens.psf_bank()
    if weight == 0:
        error = restoration_error(bank, task.sensor(f_number), task.statistics)
        return 10 * error.log10().float(), error, unknown
    banks = [bank.at(index) for index in range(len(bank.psfs))] if task.lens else [bank]
    confusions = [depth_confusion(own, task.noise(f_number), task.statistics) for own in banks]
    depth = torch.stack([own.depth for own in confusions]).square().mean().sqrt()
    image = torch.stack([own.image for own in confusions]).mean()
    cost = 20 * weight * depth.log10().float()
    if weight == 1:
        return cost, unknown, depth
    return cost + 10 * (1 - weight) * image.log10().float(), image, depth


def flat_candidate(task: DesignTask, f_number: float, focus: float) -> Candidate:
    """Return the flat lens at an f-number and a focus.

    Example:
        >>> flat_candidate(DesignTask(), 50.0, 0.5).is_flat
        True
    """
    with torch.no_grad():
        cost, error, depth = map(float, cost_of(task, search_lens(task, None, f_number, focus), f_number))
    return Candidate(FLAT, f_number, focus, error, depth, cost, None)


def coded_candidate(
    task: DesignTask,
    start: str | Tensor,
    f_number: float,
    focus: float,
    steps: int,
    seed: int = 0,
    each_step: Callable[[], None] | None = None,
) -> Candidate:
    """Return masks optimised for an f-number and a focus.

    Args:
        task: the given lens, light and depths.
        start: one of ``STARTS``, or masks to go on from, radians (K, N, N).
        f_number: of the lens.
        focus: fraction of the range of inverse depth.
        steps: gradient steps.
        seed: of the random part of the start.
        each_step: called at each step, for a progress bar.

    Example:
        >>> masks = coded_candidate(DesignTask(masks=2), "focal sweep", 35.0, 0.5, steps=2)
        >>> masks.phase.shape, masks.image_error < 1
        (torch.Size([2, 23, 23]), True)
    """
    phase = initial_phase(task, start, f_number, focus, seed) if isinstance(start, str) else start
    masks = mask_of(phase)
    lens = search_lens(task, masks, f_number, focus)

    def objective() -> Tensor:
        if each_step is not None:
            each_step()
        return cost_of(task, lens, f_number)[0]

    design(masks, objective, steps, LEARNING_RATE)
    with torch.no_grad():
        cost, error, depth = map(float, cost_of(task, lens, f_number))
    name = start if isinstance(start, str) else "refined"
    return Candidate(name, f_number, focus, error, depth, cost, masks.phase.detach().clone())


def initial_phase(task: DesignTask, start: str, f_number: float, focus: float, seed: int = 0) -> Tensor:
    """Return the phase that masks start from, (K, N, N) radians at 530 nm.

    Args:
        task: number and size of the masks, and the depth range.
        start: ``"focal sweep"``: quadratic phases that bring K depths, evenly spread over the range, into focus;
            ``"Fisher"``: the Fisher mask of :func:`~kornia_tidy.masks.initial_heights.fisher_mask`; ``"random"``:
            uniform in a wave and smooth over three pixels. The first two have normal noise of 0.36 rad, without which
            equal masks stay equal and round ones round.
        f_number: of the lens.
        focus: fraction of the range of inverse depth.
        seed: of the noise.

    Source: Nagahara et al., Flexible Depth of Field Photography (ECCV 2008), for the focal sweep.
    """
    shape = task.masks, task.mask_size, task.mask_size
    generator = torch.Generator().manual_seed(keyed_seed(seed, start))
    to_radians = metres_to_radians(constant_index(1.5))
    noise = SMALL_NOISE * to_radians * torch.randn(shape, generator=generator, dtype=torch.float32)
    if start == "Fisher":
        return noise + (fisher_mask(task.mask_size) * to_radians).float()
    if start == "random":
        waves = 2 * math.pi * torch.rand(shape, generator=generator, dtype=torch.float32)
        return torch.nn.functional.avg_pool2d(waves[:, None], 3, 1, 1, count_include_pad=False)[:, 0] * 2
    lo, hi = task.camera(f_number, focus).defocus_range
    fractions = (torch.arange(task.masks, dtype=torch.float32) + 0.5) / task.masks
    y, x = mask_axes(task.mask_size)
    return noise - ((lo + fractions * (hi - lo))[:, None, None] * (x.square() + y.square())).float()
