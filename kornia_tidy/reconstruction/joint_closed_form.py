"""Depth as a distribution and image from one network that refines the closed forms of both."""

from __future__ import annotations

import math
from collections.abc import Mapping

import torch
from torch import Tensor, nn

from kornia_tidy.checks import check_count, printed
from kornia_tidy.reconstruction.closed_form import LEAST, closed_form_channels, with_image
from kornia_tidy.reconstruction.closed_form_head import ClosedFormHead
from kornia_tidy.reconstruction.depth_distribution import interpolated_classes, layer_weights
from kornia_tidy.reconstruction.guided_classes import REDUCTION, smoothed_classes
from kornia_tidy.reconstruction.head import ReconstructionHead
from kornia_tidy.reconstruction.residual import zero_last_convolution


class JointClosedFormHead(ClosedFormHead):
    r"""Estimates image and distribution of depth by one network that refines the closed forms of both.

    The network takes the inputs of :class:`ClosedFormHead`, and the likelihood of each of L depths. All its maps but
    the last three are added to the logarithm of the likelihood, interpolated to D classes of depth. The image is that
    deconvolved for each depth, blended by the probability of the depth and smoothed by the bilateral filter; the last
    three maps are added to it. The last convolution is initialised with zeros: before training both are closed forms.

    The network does not see the image, which depends on its depth. A second one may, and adds the rest.

    Args:
        network: takes :func:`~kornia_tidy.reconstruction.closed_form.closed_form_channels` maps with the likelihood,
            returns D + 3, and ends in a convolution. The classes are evenly spaced over normalised inverse depth.
        layers: number L of depths, at least 2.
        refiner: takes the inputs of a network in a :class:`ClosedFormHead` with these layers, with the image in place
            of the restored one; returns three maps, which are added to the image, and ends in a convolution, which is
            also initialised with zeros. None: the image is as above.
        encoded: as for :class:`~kornia_tidy.reconstruction.closed_form.ClosedForm`.
        inverse: as for :class:`~kornia_tidy.reconstruction.closed_form.ClosedForm`: of estimates that the network
            takes, not of those for each depth.

    Shape:
        - image, noise: as for :class:`ClosedFormHead`.
        - output: (B, D + 3, H, W): the logits of the classes, then the image.

    Raises:
        ValueError: as :class:`ClosedFormHead`, or if the network has no two classes or the refiner other channels.

    Convention:
        - The blend is by logits without temperature, and no gradient of the image reaches the logits through it.
        - In eval mode probabilities of classes are averaged over neighbours of like colour, see
          :func:`~kornia_tidy.reconstruction.guided_classes.smoothed_classes`. Their logits are divided by
          ``temperature``, a number in the state that is fitted after training (see
          :func:`~kornia_tidy.reconstruction.depth_distribution.fit_temperature`).
        - PSFs and noise of the camera are part of the state, as for :class:`ClosedFormHead`.

    Source: Ikoma et al., Depth from Defocus with Learned Optics (ICCP 2021), for one network for both; for the
    likelihood see :func:`~kornia_tidy.reconstruction.depth_likelihood.depth_likelihood`.

    Example:
        >>> from kornia_tidy.psf.psf_bank import PSFBank
        >>> from kornia_tidy.reconstruction.joint import JointHead
        >>> from kornia_tidy.reconstruction.nafnet import NAFNet
        >>> channels = closed_form_channels(layers=4, likelihood=True)
        >>> head = JointClosedFormHead(NAFNet(channels, 16 + 3, width=4), layers=4).eval()
        >>> head.closed_form.set_psfs(PSFBank.from_measured(torch.rand(4, 3, 5, 5), torch.arange(4.0)))
        >>> with torch.no_grad():
        ...     estimate = JointHead(head)(torch.rand(2, 3, 32, 48))
        >>> estimate.depth.shape, estimate.deviation.shape, estimate.image.shape
        (torch.Size([2, 1, 32, 48]), torch.Size([2, 1, 32, 48]), torch.Size([2, 3, 32, 48]))
    """

    temperature: Tensor

    def __init__(
        self,
        network: ReconstructionHead,
        layers: int = 9,
        refiner: ReconstructionHead | None = None,
        *,
        encoded: bool = True,
        inverse: str = "tikhonov",
    ) -> None:
        check_count("the number of classes of network", network.out_channels - 3, 2)
        super().__init__(network, layers, encoded=encoded, likelihood=True, inverse=inverse)
        self.stride, self.seamless = math.lcm(network.stride, REDUCTION), False  # its tiles are measured
        if refiner is not None:
            wanted = closed_form_channels(layers), 3
            if (refiner.in_channels, refiner.out_channels) != wanted:
                raise ValueError(
                    f"refiner must have {wanted[0]} input and {wanted[1]} output channels, got {refiner.in_channels} "
                    f"and {refiner.out_channels}"
                )
            zero_last_convolution(refiner, 3, "refiner")
            refiner.range_checked = True  # no check of the range, as refocused maps leave [0, 1]
            self.stride = math.lcm(self.stride, refiner.stride)
        self.refiner = refiner
        self.register_buffer("temperature", torch.ones(()))

    def predict(self, image: Tensor) -> Tensor:
        """Return the logits of the classes and the image, from the capture and the map of its noise, (B, 6, H, W)."""
        assert self.network is not None
        capture, noise = image.split(3, 1)
        restored = self.closed_form(capture, noise)
        residual = self.network(restored.maps)
        logits, residual = residual.split([residual.shape[1] - 3, 3], 1)
        logits = logits + self._initial_logits(restored.maps)
        shares = layer_weights(logits.detach(), self.closed_form.layers)
        image = residual + self.closed_form.blend(restored.layers, shares, noise)
        if self.refiner is not None:
            image = image + self.refiner(with_image(restored.maps[:, : self.refiner.in_channels], image))
        if not self.training:
            logits = smoothed_classes(logits, image) / self.temperature.to(logits.dtype)
        return torch.cat([logits, image], 1)

    def _initial_logits(self, maps: Tensor) -> Tensor:
        """Return the logarithm of the likelihood for each class, from the maps of the closed form."""
        return interpolated_classes(LEAST * (1 - maps[:, -self.closed_form.layers :]), self.out_channels - 3)

    def extra_repr(self) -> str:
        """Return layers, classes and temperature."""
        classes, temperature = self.out_channels - 3, printed(self.temperature)
        return f"layers={self.closed_form.layers}, classes={classes}, temperature={temperature}"


def widened_for_depth(weights: Mapping[str, Tensor], head: JointClosedFormHead) -> dict[str, Tensor]:
    """Return the weights of a network for the image as those of a network for image and depth that begins from them.

    Over the depths, whose number may differ, the weights of the first convolution are interpolated, and those of the
    likelihood are zero. The last convolution is that of ``head``, as the image was added to another closed form.

    Args:
        weights: state of a :class:`ClosedFormHead` with a network of the kind and width of that in ``head``.
        head: whose PSFs, noise, temperature, refiner and last convolution are taken; it is not changed.

    Returns:
        A state for ``head``; weights of another kind of network are unchanged.
    """
    assert head.network is not None
    named = head.network.named_modules(prefix="network")
    convolutions = [name for name, part in named if isinstance(part, nn.Conv2d)]
    first, last = f"{convolutions[0]}.weight", convolutions[-1]
    found, own = dict(weights), head.state_dict()
    kept = ("closed_form.", "refiner.", "temperature", f"{last}.")
    found |= {name: own[name] for name in own if name.startswith(kept)}
    if first in weights and weights[first].shape[1] >= closed_form_channels():
        stretched = _stretched(weights[first], head.closed_form.layers)
        zeros = stretched[:, closed_form_channels() :] * 0
        found[first] = torch.cat([stretched, zeros], 1)
    return found


def as_refiner(weights: Mapping[str, Tensor], head: JointClosedFormHead) -> dict[str, Tensor]:
    """Return the weights of a network for the image as those of the refiner of a head.

    Over the depths, whose number may differ, the weights of the first convolution are interpolated.

    Args:
        weights: state of a :class:`ClosedFormHead` with a network of the kind and width of the refiner.
        head: it is not changed.

    Returns:
        A part of the state of ``head``, with the refiner's names for its weights; weights of another kind of network
        are unchanged.
    """
    assert head.refiner is not None
    place = "network."
    found = {key.removeprefix(place): value for key, value in weights.items() if key.startswith(place)}
    first = next(name for name, part in head.refiner.named_modules() if isinstance(part, nn.Conv2d)) + ".weight"
    if first in found and found[first].shape[1] >= closed_form_channels():
        found[first] = _stretched(found[first], head.closed_form.layers)
    return {f"refiner.{name}": value for name, value in found.items()}


def _stretched(weight: Tensor, layers: int) -> Tensor:
    """Return the weights of a convolution of a network for the image for another number of depths, interpolated."""
    shared, by_depth = weight.tensor_split([closed_form_channels()], 1)
    given = by_depth.shape[1]
    if not given:
        return torch.cat([shared, shared.new_zeros(len(shared), layers, *shared.shape[2:])], 1)
    return torch.cat([shared, interpolated_classes(by_depth, layers) * given / layers], 1)
