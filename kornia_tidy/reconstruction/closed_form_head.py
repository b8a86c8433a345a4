"""Networks that refine the restoration in closed form, and the closed form itself as a head."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor, nn
from torch.nn import functional

from kornia_tidy.reconstruction.closed_form import ClosedForm, closed_form_channels
from kornia_tidy.reconstruction.head import ReconstructionHead
from kornia_tidy.reconstruction.residual import zero_last_convolution


class ClosedFormHead(ReconstructionHead):
    """Feeds a network the capture and its restorations in closed form, and adds its output to the best of them.

    The last convolution of the network is initialised with zeros, so that the initial image is that of
    :class:`~kornia_tidy.reconstruction.closed_form.ClosedForm`. The head is conditioned on the noise: its level chooses
    the weight of the deconvolution in each pixel, and is an input of the network.

    Args:
        network: takes :func:`~kornia_tidy.reconstruction.closed_form.closed_form_channels` maps and ends in a
            convolution. If it has three output maps or more, the last three are the image. None: the restored image
            itself is the output.
        layers: as for :class:`~kornia_tidy.reconstruction.closed_form.ClosedForm`.
        bilateral: as for :class:`~kornia_tidy.reconstruction.closed_form.ClosedForm`.
        encoded: as for :class:`~kornia_tidy.reconstruction.closed_form.ClosedForm`.
        likelihood: as for :class:`~kornia_tidy.reconstruction.closed_form.ClosedForm`.
        inverse: as for :class:`~kornia_tidy.reconstruction.closed_form.ClosedForm`.
        fine: as for :class:`~kornia_tidy.reconstruction.closed_form.ClosedForm`.

    Shape:
        - image: (B, 3, H, W), captures of the camera, of any size.
        - noise: standard deviation of the noise in linear light, in units of full scale: a number, (B, 1, 1, 1),
          (B, 3, H, W) or four axes that broadcast to it. None: by the camera's sensor.
        - output: the network's, with the restored image added to its last three maps; or the restored image, (B, 3, H,
          W).

    Raises:
        ValueError: if the network takes another number of channels or does not end in a convolution, or no PSFs were
            given before the first capture.

    Convention:
        - PSFs and noise come from the camera by :meth:`~kornia_tidy.reconstruction.closed_form.ClosedForm.set_psfs`
          and :meth:`~kornia_tidy.reconstruction.closed_form.ClosedForm.set_noise` of ``closed_form``, or both by
          :func:`kornia_tidy.reconstruction.trained.update_psfs`. They are part of the state.
        - Borders are padded as in :class:`ReconstructionHead`, and in the same way for the deconvolution.

    Source: Ikoma et al., Depth from Defocus with Learned Optics (ICCP 2021), for a network behind a closed form. He et
    al., Deep Residual Learning (CVPR 2016); Zhang, Zuo and Zhang, FFDNet (TIP 2018), for the map of the noise.

    Example:
        >>> from kornia_tidy.psf.psf_bank import PSFBank
        >>> from kornia_tidy.reconstruction.nafnet import NAFNet
        >>> head = ClosedFormHead(NAFNet(closed_form_channels(), 3, width=4)).eval()
        >>> head.closed_form.set_psfs(PSFBank.from_measured(torch.rand(4, 3, 5, 5), torch.arange(4.0)))
        >>> capture, noise = torch.rand(2, 3, 32, 48), torch.tensor([0.002, 0.03]).view(2, 1, 1, 1)
        >>> torch.equal(head(capture, noise), head.closed_form(capture, noise).image)  # before training
        True
    """

    def __init__(
        self,
        network: ReconstructionHead | None = None,
        layers: int = 0,
        *,
        bilateral: bool = True,
        encoded: bool = True,
        likelihood: bool = False,
        inverse: str = "tikhonov",
        fine: bool = False,
    ) -> None:
        super().__init__(3, 3 if network is None else network.out_channels)
        self.closed_form = ClosedForm(
            layers, bilateral=bilateral, encoded=encoded, likelihood=likelihood, inverse=inverse, fine=fine
        )
        self.network = network
        self.stride = 1 if network is None else network.stride
        self.seamless = network is not None and network.seamless
        if network is not None:
            wanted = closed_form_channels(layers, likelihood=likelihood, fine=fine)
            if network.in_channels != wanted:
                raise ValueError(f"the network must take {wanted} channels, got in_channels={network.in_channels}")
            if network.out_channels >= 3:
                zero_last_convolution(network, 3)
            network.range_checked = True  # no check of the range, as refocused maps leave [0, 1]

    def forward(self, image: Tensor, noise: Tensor | float | None = None) -> Tensor:
        """Return the estimated maps, (B, out_channels, H, W)."""
        self.check_image(image)
        return self.on_grid(torch.cat([image, self.closed_form.noise_map(image, noise)], 1))

    def predict(self, image: Tensor) -> Tensor:
        """Return the maps from the capture and the map of its noise, (B, 6, H, W)."""
        restored = self.closed_form(*image.split(3, 1))
        if self.network is None:
            return restored.image
        maps = self.network(restored.maps)
        others = maps.shape[1] - 3
        if others < 0:
            return maps
        return torch.cat([maps[:, :others], maps[:, others:] + restored.image], 1)


def with_fine_maps(weights: Mapping[str, Tensor], head: ClosedFormHead) -> dict[str, Tensor]:
    """Return the weights of a network without the fine maps of the closed form as those of one that takes them.

    Their weights in the first convolution are zero, so that the result is the same.

    Args:
        weights: state of a :class:`ClosedFormHead` with as many layers, without fine maps.
        head: with them; it is not changed.

    Returns:
        A state for ``head``; weights of another kind of network are unchanged.

    Raises:
        ValueError: if the first convolution takes another number of maps.
    """
    assert head.network is not None
    name, first = next((n, part) for n, part in head.named_modules() if isinstance(part, nn.Conv2d))
    found, name = dict(weights), f"{name}.weight"
    if name in found:
        given, wanted = found[name].shape[1], closed_form_channels(head.closed_form.layers)
        if given != wanted:
            raise ValueError(f"a network without fine maps must take {wanted} maps to be given them, got {given}")
        found[name] = functional.pad(found[name], (0, 0, 0, 0, 0, first.in_channels - given))
    return found
