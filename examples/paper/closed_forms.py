"""Yardsticks without a network: the closed forms of image and depth, and the bound on a bright point's depth."""

from __future__ import annotations

from typing import cast

import torch
from torch import Tensor, nn

from examples.paper.cameras import ELECTRONS, F_NUMBER
from kornia_tidy import SensorNoise, ThinLensCamera, TiDyOptics
from kornia_tidy.reconstruction.tasks import MAPS
from kornia_tidy.sensor import electrons_at

TEMPERATURES = (1.0, 4.0, 16.0, 64.0)
"""By which the log likelihood of depth is divided: neighbouring pixels are not independent."""
READ_NOISE = 2.4  # electrons


class ClosedForms(nn.Module):
    """Maps of a task from a capture, without a network. See :func:`examples.paper.training.closed_form_system`."""

    def __init__(self, optics: TiDyOptics, task: str, layers: int = 11) -> None:
        from kornia_tidy.reconstruction.closed_form_head import ClosedFormHead  # noqa: PLC0415
        from kornia_tidy.reconstruction.depth_likelihood import NOISE, likelihood_filters  # noqa: PLC0415

        super().__init__()
        self.temperature = TEMPERATURES[0]
        self.task, self.encoded = task, optics.color_space == "srgb"
        self.image = ClosedFormHead(encoded=self.encoded)
        if "depth" in MAPS[task]:
            lo, hi = optics.camera.defocus_range
            with torch.no_grad():
                psfs = optics.psf_bank(3, defocus=torch.linspace(lo, hi, layers, dtype=torch.float64).tolist()).psfs
                psfs = psfs.flip((-2, -1)) if optics.fidelity.correlate else psfs
                sensor = cast("SensorNoise", optics.sensor)
                noise = float(sensor.std(torch.tensor(0.2))) / psfs.shape[1] ** 0.5  # of the mean of the colours
                self.filters = likelihood_filters(psfs.mean(1).float(), max(noise, NOISE))

    def forward(self, coded: Tensor) -> Tensor:
        """Return depth, image, or depth and image."""
        maps = []
        if "depth" in MAPS[self.task]:
            maps.append(self._depth(coded))
        if "image" in MAPS[self.task]:
            maps.append(self.image(coded))
        return torch.cat(maps, 1)

    def _depth(self, coded: Tensor) -> Tensor:
        from kornia.color import rgb_to_linear_rgb  # noqa: PLC0415

        from kornia_tidy.reconstruction.depth_likelihood import depth_likelihood  # noqa: PLC0415

        light = (rgb_to_linear_rgb(coded) if self.encoded else coded).mean(1, keepdim=True)
        likelihood = (depth_likelihood(light, *self.filters) / self.temperature).softmax(1)
        places = torch.linspace(0, 1, likelihood.shape[1])
        return torch.einsum("bdhw,d->bhw", likelihood, places)[:, None]


def depth_limit(optics: TiDyOptics) -> float:
    r"""Return the bound on the error of a bright point's depth, as a fraction of the range.

    .. math:: \sqrt{\langle 1 / (12 + I_\psi \, (\psi_{hi} - \psi_{lo})^2) \rangle}

    The mean is over the depths of photographs; 12 is the information of a depth that is uniform over the range.

    Source: Van Trees, Detection, Estimation, and Modulation Theory I, section 2.4 (Bayesian bound).
    """
    from kornia_tidy.data.scene_statistics import PHOTOGRAPHS  # noqa: PLC0415
    from kornia_tidy.design.fisher_information import crlb  # noqa: PLC0415

    lens = optics.psf_model
    lo, hi = lens.camera.defocus_range
    electrons = electrons_at(cast("ThinLensCamera", lens.camera).f_number, ELECTRONS, F_NUMBER)
    with torch.no_grad():
        bound = crlb(lens, photons=electrons, background=PHOTOGRAPHS.mean * electrons + READ_NOISE**2)
        shares = PHOTOGRAPHS.depth_weights(torch.tensor(lens.defocus_nodes, dtype=bound.dtype))
        return float(((12 + ((hi - lo) / bound).square()).reciprocal() * shares).sum().sqrt())
