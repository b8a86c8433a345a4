"""Mean light and windows of a whole picture, told to the closed forms in a network that see parts of it."""

from __future__ import annotations

from collections.abc import Generator
from contextlib import contextmanager

import torch
from kornia.color import rgb_to_linear_rgb
from torch import Tensor, nn

from kornia_tidy.reconstruction.clipped_light import REACH
from kornia_tidy.reconstruction.closed_form import ClosedForm
from kornia_tidy.reconstruction.ruled_closed_form import RuledClosedForm, sampled_windows

STRIP = 256  # rows, whose light is averaged at once


@contextmanager
def whole_picture(head: nn.Module, picture: Tensor, *, encoded: bool = False) -> Generator[None]:
    """Let the closed forms in a network take away the stray light of a whole picture while they see parts of it.

    :func:`~kornia_tidy.reconstruction.tiled.reconstruct_tiled` does so by itself for a network that takes captures as
    its closed form does. Give an encoding of linear light before the network here. Closed forms keep an encoding that
    they were given before.

    Args:
        head: a network.
        picture: (B, 3, H, W), clipped to [0, 1] by the network.
        encoded: the picture is encoded as sRGB. False: it is linear light.

    Example:
        >>> from kornia_tidy.psf.psf_bank import PSFBank
        >>> restore = ClosedForm()
        >>> bank = PSFBank(torch.rand(4, 3, 5, 5), torch.arange(4.0), torch.ones(4, 3), torch.full((4, 3), 0.1))
        >>> restore.set_psfs(bank)
        >>> with whole_picture(restore, torch.full((1, 3, 8, 8), 0.25)):
        ...     restore.mean_light.flatten()
        tensor([0.2500, 0.2500, 0.2500])
    """
    parts = closed_forms_without_statistics(head)
    if parts:
        windows = [part.clamp(0, 1) for part in sampled_windows(picture)]
        sample = [rgb_to_linear_rgb(part) if encoded else part for part in windows]
    try:
        for part in parts:
            part.mean_light, part.sample = _mean_light(part, picture, encoded=encoded), sample
            if isinstance(part, RuledClosedForm):
                part.remembered = {}
        yield
    finally:
        for part in parts:
            part.mean_light = part.sample = None


def closed_forms_without_statistics(head: nn.Module) -> list[ClosedForm]:
    """Return the closed forms in a network that estimate stray light or noise from the mean light of their input.

    Example:
        >>> closed_forms_without_statistics(nn.Conv2d(3, 3, 1))
        []
    """
    parts = [module for module in head.modules() if isinstance(module, ClosedForm)]
    return [part for part in parts if (part.has_stray_light or part.even_noise) and part.mean_light is None]


def _mean_light(form: ClosedForm, picture: Tensor, *, encoded: bool) -> Tensor:
    """Return the mean light of a picture, with what a closed form expects beyond full scale, (B, 3, 1, 1)."""
    rows, sums, precise = picture.shape[-2], [], torch.promote_types(form.psfs.dtype, torch.float32)
    for top in range(0, rows, STRIP):  # a copy of the picture would take its memory again
        first = max(0, top - REACH)
        strip = picture[..., first : top + STRIP + REACH, :].clamp(0, 1).to(form.psfs.device, precise)
        light = form.completed(rgb_to_linear_rgb(strip) if encoded else strip)
        sums.append(light[..., top - first : top - first + STRIP, :].double().sum((-2, -1)))
    return (torch.stack(sums).sum(0)[..., None, None] / (rows * picture.shape[-1])).to(form.psfs)
