"""A network for the captures of any camera: it corrects the closed form in proportion to its certainty."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import torch
from torch import Tensor, nn

from kornia_tidy.reconstruction.clipped_light import clipped_share
from kornia_tidy.reconstruction.closed_form import closed_form_channels
from kornia_tidy.reconstruction.closed_form_head import ClosedFormHead
from kornia_tidy.reconstruction.nafnet import NAFNet
from kornia_tidy.reconstruction.ruled_closed_form import CAMERA_MAPS, RuledClosedForm, Settings
from kornia_tidy.reconstruction.state_file import read_state

WEIGHTS = Path(__file__).parent / "pretrained" / "any-camera.safetensors"

SHARE = 1.0  # logit of the share before training
# The factor of the share is 1 at an expected error of FULL_ERROR. By the truth the best factor is .1 to .4 at an error
# of .009, .3 to .6 at .018, .1 to 1.4 at .03, 1 to 1.3 at .045 and 1.4 to 2.8 at .05 (three scenes of half A behind 13
# cameras of training and validation). The numbers are the best of twenty with the present weights on six scenes of half
# A behind 17 cameras of validation, training and shipped systems.
FULL_ERROR, EXPONENT, MOST = 0.042, 1.5, 1.25
# It falls further where a scene has less fine detail than FULL_DETAIL of a photograph's, which a network adds. By the
# truth the best factor of the correction is .4 to .6 in the mean at .006 to .012, and .9 to 1.2 from .03 on (six scenes
# of half A behind 17 cameras of validation, training and shipped systems, beside the factor for the error). With
# an exponent of .5 in place of .35 a dark scene with grain, whose corrections contradict the capture, loses at most .03
# dB to the closed form in place of .19 (twelve more cameras), and the means change by less than .02.
FULL_DETAIL, DETAIL_EXPONENT = 0.06, 0.5
# It rises beside clipped pixels, about which the closed form rings. By the truth the best factor there is 1.4 to 1.6 in
# the mean where 5 to 15 % of the pixels about are clipped, and 2.0 to 2.3 where more than 30 % are (six scenes of half
# A, two and four times overexposed, behind edof-designed and two cameras of validation).
BESIDE_CLIPPED = 3.0


class AnyCameraHead(ClosedFormHead):
    r"""Adds a share of a network's correction to the closed form, which knows the camera.

    .. math:: \hat x = x_0 + q \, \sigma(s) \, \Delta

    The network estimates the correction :math:`\Delta`, and for each pixel the logit s of its share. q rises with the
    error that is expected of the closed form (:func:`largest_share`): where that is near the truth it stays. It rises
    also beside clipped pixels (:func:`beside_clipped`). Its inputs describe the camera: the maps of
    :class:`~kornia_tidy.reconstruction.ruled_closed_form.RuledClosedForm`. So one network serves all cameras: PSFs and
    noise are set, not learnt.

    Args:
        width: of the :class:`~kornia_tidy.reconstruction.NAFNet`.
        repeats: of its blocks.
        layers: number of depths with a deconvolution among the inputs.

    Shape:
        - image: (B, 3, H, W), captures of the camera encoded as sRGB, of any size.
        - noise: as for :class:`~kornia_tidy.reconstruction.ClosedFormHead`.
        - output: (B, 3, H, W), the image, encoded as sRGB.

    Raises:
        ValueError: if no PSFs were given before the first capture.

    Convention:
        - PSFs and noise come from the camera by :func:`kornia_tidy.reconstruction.trained.update_psfs`.
        - Before training :math:`\Delta` is zero.

    Source: He et al., Deep Residual Learning (CVPR 2016); Srivastava, Greff and Schmidhuber, Highway Networks (2015),
    for a learnt share.

    Example:
        >>> from kornia_tidy.psf.psf_bank import PSFBank
        >>> head = AnyCameraHead(width=4, repeats=1).eval()
        >>> head.closed_form.set_psfs(PSFBank.from_measured(torch.rand(7, 3, 5, 5), torch.arange(7.0)))
        >>> capture = torch.rand(1, 3, 32, 48)
        >>> torch.equal(head(capture, 0.01), head.closed_form(capture, 0.01).image)  # before training
        True
    """

    def __init__(self, width: int = 16, repeats: int = 3, layers: int = 7) -> None:
        super().__init__()
        self.closed_form: RuledClosedForm = RuledClosedForm(layers)
        network = NAFNet(closed_form_channels(layers) + CAMERA_MAPS, 4, width, repeats)
        nn.init.zeros_(network.last.weight)
        network.last.bias = nn.Parameter(torch.tensor([SHARE, 0.0, 0.0, 0.0]))
        network.range_checked = True  # no check of the range, as maps leave [0, 1]
        self.network: NAFNet = network
        self.stride, self.seamless = network.stride, network.seamless

    def forward(self, image: Tensor, noise: Tensor | float | None = None) -> Tensor:
        """Return the image, (B, 3, H, W)."""
        self.check_image(image)
        found = self.closed_form.settings_of(image, noise)  # of the capture, not of one that is padded
        return self.on_grid(torch.cat([image, *(part.expand(-1, -1, *image.shape[-2:]) for part in found)], 1))

    def predict(self, image: Tensor) -> Tensor:
        """Return the image from the capture and three maps of its settings, (B, 6, H, W)."""
        found = Settings(*image[:, 3:, :1, :1].split(1, 1))
        restored = self.closed_form.restore_by(image[:, :3], found)
        largest = beside_clipped(largest_share(self.closed_form, found), image[:, :3])
        return corrected(restored.image, self.network(restored.maps), largest)


def largest_share(form: RuledClosedForm, found: Settings) -> Tensor:
    """Return the factor of the share of a correction, (B, 1, 1, 1).

    It rises with the error that is expected of photographs behind the camera, and with the detail of the scene.

    Args:
        form: closed form of the camera.
        found: settings of the capture.
    """
    by_error = ((form.expected_error(found.noise) / FULL_ERROR) ** EXPONENT).clamp(max=MOST)
    return by_error * (found.detail / FULL_DETAIL).clamp(max=1) ** DETAIL_EXPONENT


def beside_clipped(largest: Tensor, capture: Tensor) -> Tensor:
    """Return the factor of the share at each pixel, (B, 1, H, W), which rises beside those that are clipped.

    Args:
        largest: as :func:`largest_share` returns it.
        capture: (B, 3, H, W), full scale 1.
    """
    raised = largest * (1 + BESIDE_CLIPPED * clipped_share(capture))
    return raised.minimum(largest.clamp(min=MOST))


@cache
def _shipped() -> dict[str, Tensor]:
    return read_state(WEIGHTS)["network"]


def any_camera_head() -> AnyCameraHead:
    """Return the network that is shipped, which waits for the PSFs of a camera.

    Example:
        >>> sum(parameter.numel() for parameter in any_camera_head().parameters()) // 1000
        2425
    """
    head = AnyCameraHead().eval()
    if not head.network.last.weight.is_meta:  # else shapes alone are wanted
        head.network.load_state_dict(_shipped())
    return head


def corrected(image: Tensor, maps: Tensor, largest: Tensor | float = 1.0) -> Tensor:
    """Return an image plus the share of its correction; maps are the logit of the share and the correction.

    Args:
        image: (B, 3, H, W).
        maps: (B, 4, H, W).
        largest: factor of the share.

    Example:
        >>> corrected(torch.zeros(1, 3, 1, 1), torch.tensor([0.0, 0.2, 0.4, 0.6]).view(1, 4, 1, 1)).flatten()
        tensor([0.1000, 0.2000, 0.3000])
    """
    return image + largest * maps[:, :1].sigmoid() * maps[:, 1:]
