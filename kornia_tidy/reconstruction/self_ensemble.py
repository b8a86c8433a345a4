"""Self-ensemble: the mean of a network's results for its input in several orientations."""

from __future__ import annotations

from torch import Tensor, nn

from kornia_tidy.reconstruction.closed_form_head import ClosedFormHead
from kornia_tidy.reconstruction.head import ReconstructionHead, sharing_weights
from kornia_tidy.reconstruction.joint_closed_form import JointClosedFormHead

ORIENTATIONS = (1, 2, 4, 8)


class SelfEnsemble(ReconstructionHead):
    r"""Averages a network's results for its input in several orientations, each turned back.

    .. math:: y = \frac{1}{N} \sum_n T_n^{-1} f(T_n x)

    The errors of a network differ with the orientation, and their mean is smaller than each.

    Args:
        network: f. It must make sense of its input in any orientation. So does a network that sees a capture beside its
            restorations in closed form, although a turned capture has turned PSFs; one that sees only the capture, and
            has learnt the PSFs, does not.
        orientations: N: 2 are the unchanged image and the one turned by 180 degrees; 4 are all turns by 90 degrees; 8
            are these and their mirror images. It takes N times as long as the network by itself, and about as much
            memory.

    Shape:
        - image: (B, C, H, W), as the network takes it.
        - output: the network's, in its orientation.

    Raises:
        ValueError: for another number of orientations, or a network that sees the whole image.

    Source: Timofte et al., Seven Ways to Improve Example-Based Single Image Super Resolution (CVPR 2016),
    section 3.7, enhanced prediction; Lim et al., Enhanced Deep Residual Networks (CVPR Workshops 2017), for the name.

    Example:
        >>> import torch
        >>> from kornia_tidy.reconstruction.nafnet import NAFNet
        >>> network = NAFNet(width=4).eval()
        >>> ensemble, image = SelfEnsemble(network, 2), torch.rand(1, 3, 32, 48)
        >>> torch.allclose(ensemble(image), ensemble(image.rot90(2, (2, 3))).rot90(2, (2, 3)), atol=1e-5)
        True
    """

    def __init__(self, network: ReconstructionHead, orientations: int = 8) -> None:
        check_orientations(orientations)
        if network.whole_image:
            raise ValueError(f"{type(network).__name__} sees the whole image, and cannot be turned")
        super().__init__(network.in_channels, network.out_channels)
        self.network, self.orientations, self.stride = network, orientations, network.stride
        self.range_checked = network.range_checked
        self.train(network.training)

    def predict(self, image: Tensor) -> Tensor:
        """Return the mean of the network's maps."""
        total = self.network.predict(image)
        for turns, mirrored in _turned(self.orientations):
            turned = image.rot90(turns, (2, 3))
            maps = self.network.predict(turned.flip(3) if mirrored else turned)
            total = total + (maps.flip(3) if mirrored else maps).rot90(-turns, (2, 3))
        return total / self.orientations

    def extra_repr(self) -> str:
        """Return the number of orientations."""
        return f"orientations={self.orientations}"


def self_ensemble(head: nn.Module, orientations: int = 8) -> nn.Module:
    """Return a copy of a trained head whose networks average over orientations; it shares the weights.

    The closed form is computed once, for the unturned capture; its restorations are then turned. The images of
    ``edof`` systems gain 0.10 to 0.14 dB by 8 orientations, ``joint-uncertain`` gains only in depth, see "In several
    orientations" in ``docs/trained_systems.md``.

    Args:
        head: begins with the closed form: a :class:`ClosedFormHead` with a network, or a module that contains one, such
            as :class:`~kornia_tidy.reconstruction.JointHead`. It is not changed.
        orientations: as for :class:`SelfEnsemble`. 1: the copy computes the same as the head.

    Raises:
        ValueError: for another number of orientations, or a head that does not begin with the closed form and so has
            learnt PSFs of one orientation.

    Source: as for :class:`SelfEnsemble`.

    Example:
        >>> import torch
        >>> from kornia_tidy.reconstruction.pretrained import load_pretrained
        >>> system = load_pretrained("edof-5")
        >>> with torch.inference_mode():
        ...     image = self_ensemble(system.head, 2)(torch.rand(1, 3, 64, 64))
    """
    check_orientations(orientations)
    copied = sharing_weights(head)
    if orientations == 1:
        return copied
    if not (parts := _refining(copied)):
        raise ValueError(
            f"orientations={orientations} is for a network that begins with the closed form, and "
            f"{type(head).__name__} has none: a network without a closed form knows PSFs in one orientation"
        )
    for part in parts:
        assert part.network is not None
        part.network = SelfEnsemble(part.network, orientations)
        if isinstance(part, JointClosedFormHead) and part.refiner is not None:
            part.refiner = SelfEnsemble(part.refiner, orientations)
    return copied


def check_orientations(orientations: int) -> None:
    """Raise ``ValueError`` for a number of orientations that is not offered."""
    if orientations not in ORIENTATIONS:
        raise ValueError(f"orientations must be one of {', '.join(map(str, ORIENTATIONS))}, got {orientations!r}")


def _refining(head: nn.Module) -> list[ClosedFormHead]:
    """Return the parts of a head in which a network refines a closed form."""
    return [part for part in head.modules() if isinstance(part, ClosedFormHead) and part.network is not None]


def _turned(orientations: int) -> list[tuple[int, bool]]:
    """Return the orientations but that of the image itself: turns by 90 degrees, and whether mirrored after them."""
    turns = {1: [0], 2: [0, 2]}.get(orientations, [0, 1, 2, 3])
    mirrored = [False, True] if orientations == 8 else [False]
    return [(turn, mirror) for mirror in mirrored for turn in turns][1:]
