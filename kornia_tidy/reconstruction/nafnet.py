"""NAFNet: a U-Net of residual blocks without activation functions, for image restoration."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor, nn
from torch.nn import functional

from kornia_tidy.checks import check_count
from kornia_tidy.reconstruction.head import ReconstructionHead
from kornia_tidy.reconstruction.strips import strip_rows

ENCODER = (1, 1, 1, 1)  # blocks of each level
MIDDLE = 2
DECODER = (1, 1, 1, 2)  # from the finest level to the coarsest
ATTENTION = 3  # side of the window of the channel attention, in pixels of its level


class NAFNet(ReconstructionHead):
    r"""U-Net of residual blocks that multiply channels where other networks have activation functions.

    A block normalises its input over channels, and adds to it

    .. math:: y = x + \beta \, W_2 \, a(G(D W_1 \, \mathrm{LN}(x))), \qquad
              z = y + \gamma \, W_4 \, G(W_3 \, \mathrm{LN}(y))

    with 1x1 convolutions W, a depthwise 3x3 convolution D, the simple gate G, which multiplies the first half of the
    channels with the second, and simplified channel attention :math:`a(u) = u \cdot W_5 \bar u`. Five levels of width,
    2, 4, 8 and 16 times width channels are joined by 2x2 convolutions of stride 2 on the way down, and by 1x1
    convolutions with pixel shuffle on the way up. Skip connections are added.

    Args:
        in_channels: channels of the image.
        out_channels: maps to estimate.
        width: channels of the first level. 16 gives 1.7 million parameters; their number grows as its square.
        repeats: factor of the number of blocks of each level above the coarsest. A block is the identity at first, so
            that a trained network may be made deeper, see :func:`deepened`.

    Shape:
        - image: (B, in_channels, H, W), any size.
        - output: (B, out_channels, H, W), any real number.

    Convention:
        - The mean :math:`\bar u` of the attention is over 3x3 pixels of the coarsest level, 48x48 of the image, and
          other levels have no attention. In the published network it is over the image, and the result would depend on
          the size of the image or tile.
        - :math:`\beta` and :math:`\gamma` are zero at first. Initial weights of convolutions are those of
          :meth:`~kornia_tidy.reconstruction.ReconstructionHead.reset_parameters`.

    Source: Chen et al., Simple Baselines for Image Restoration (ECCV 2022), section 4. Chu et al., Improving Image
    Restoration by Revisiting Global Information Aggregation (ECCV 2022), for means over windows.

    Example:
        >>> head = NAFNet(width=4).eval()
        >>> head(torch.rand(1, 3, 50, 70)).shape
        torch.Size([1, 3, 50, 70])
    """

    stride = 2 ** len(ENCODER)
    seamless = True

    def __init__(self, in_channels: int = 3, out_channels: int = 3, width: int = 16, repeats: int = 1) -> None:
        super().__init__(in_channels, out_channels)
        check_count("width", width)
        check_count("repeats", repeats)
        widths = [width << level for level in range(len(ENCODER))]
        self.first = nn.Conv2d(in_channels, width, 3, padding=1)
        self.encoder = nn.ModuleList(_blocks(c, repeats * count) for c, count in zip(widths, ENCODER, strict=True))
        self.down = nn.ModuleList(nn.Conv2d(c, 2 * c, 2, stride=2) for c in widths)
        self.middle = _blocks(2 * widths[-1], MIDDLE, attention=True)
        self.up = nn.ModuleList(nn.Conv2d(2 * c, 4 * c, 1, bias=False) for c in widths)
        self.decoder = nn.ModuleList(_blocks(c, repeats * count) for c, count in zip(widths, DECODER, strict=True))
        self.last = nn.Conv2d(width, out_channels, 3, padding=1)
        self.reset_parameters()

    def predict(self, image: Tensor) -> Tensor:
        """Return the maps of an image with sides that are multiples of 16."""
        features = self.first(image)
        skips = []
        for blocks, down in zip(self.encoder, self.down, strict=True):
            skips.append(_after(blocks, features))
            features = down(skips[-1])
        features = self.middle(features)
        for blocks, up in zip(reversed(self.decoder), reversed(self.up), strict=True):
            features = functional.pixel_shuffle(up(features), 2).add_(skips.pop())  # whose memory is freed
            features = _after(blocks, features)
        return self.last(features)

    def reset_parameters(self) -> None:
        """Initialise all parameters, by the global generator; blocks are the identity at first."""
        super().reset_parameters()
        for module in self.modules():
            if isinstance(module, _Block):
                module.reset_parameters()


def deepened(weights: Mapping[str, Tensor], head: nn.Module) -> dict[str, Tensor]:
    """Return the weights of a network with those of its missing blocks, which do not change its result.

    Args:
        weights: state of a network with a :class:`NAFNet` of fewer blocks than the one in ``head``.
        head: its blocks, with factors of zero, are added; it is not changed.

    Example:
        >>> small, large = NAFNet(width=4), NAFNet(width=4, repeats=2)
        >>> large.load_state_dict(deepened(small.state_dict(), large))
        <All keys matched successfully>
        >>> image = torch.rand(1, 3, 32, 32)
        >>> torch.equal(small.eval()(image), large.eval()(image))
        True
    """
    found = dict(weights)
    for name, module in head.named_modules():
        if isinstance(module, _Block) and not any(key.startswith(f"{name}.") for key in weights):
            block = {f"{name}.{key}": value.clone() for key, value in module.state_dict().items()}
            found |= {k: torch.zeros_like(v) if k.endswith((".beta", ".gamma")) else v for k, v in block.items()}
    return found


def _after(blocks: nn.Module, features: Tensor) -> Tensor:
    """Return features after blocks without attention; in strips of rows these take their place."""
    height, rows = features.shape[-2], strip_rows(features)
    if rows == height:
        return blocks(features)
    for block in blocks.children():
        kept = features[:, :, :0]
        for top in range(0, height, rows):
            strip = block(features[:, :, max(0, top - 1) : top + rows + 1])  # with a row of neighbours on each side
            features[:, :, top - kept.shape[2] : top] = kept  # only now, as this strip needs the last of its rows
            kept = strip[:, :, min(top, 1) :][:, :, :rows]
        features[:, :, height - kept.shape[2] :] = kept
    return features


def _blocks(channels: int, count: int, *, attention: bool = False) -> nn.Sequential:
    return nn.Sequential(*(_Block(channels, attention) for _ in range(count)))


class _Block(nn.Module):
    """Two gated residual units: one over neighbours by a depthwise convolution, one within each pixel."""

    def __init__(self, channels: int, attention: bool) -> None:
        super().__init__()
        double = 2 * channels
        self.norm1, self.norm2 = _ChannelNorm(channels), _ChannelNorm(channels)
        self.expand1, self.expand2 = nn.Conv2d(channels, double, 1), nn.Conv2d(channels, double, 1)
        self.depthwise = nn.Conv2d(double, double, 3, padding=1, groups=double)
        self.attention = nn.Conv2d(channels, channels, 1) if attention else None
        self.project1, self.project2 = nn.Conv2d(channels, channels, 1), nn.Conv2d(channels, channels, 1)
        self.beta, self.gamma = (nn.Parameter(torch.zeros(1, channels, 1, 1)) for _ in range(2))

    def forward(self, features: Tensor) -> Tensor:
        mixed = _gate(self.depthwise(self.expand1(self.norm1(features))))
        if self.attention is not None:
            around = functional.avg_pool2d(mixed, ATTENTION, 1, ATTENTION // 2, count_include_pad=False)
            mixed = mixed * self.attention(around)
        features = _scaled(self.project1, self.beta, mixed).add_(features)
        return _scaled(self.project2, self.gamma, _gate(self.expand2(self.norm2(features)))).add_(features)

    def reset_parameters(self) -> None:
        for scale in (self.beta, self.gamma):
            nn.init.zeros_(scale)
        for norm in (self.norm1, self.norm2):
            norm.reset_parameters()


class _ChannelNorm(nn.LayerNorm):
    """Layer normalisation over the channels of each pixel."""

    def forward(self, input: Tensor) -> Tensor:  # noqa: A002 (torch calls it so)
        return super().forward(input.movedim(1, -1)).movedim(-1, 1)


def _scaled(convolution: nn.Conv2d, scale: Tensor, features: Tensor) -> Tensor:
    """Return the scale (1, C, 1, 1) times a 1x1 convolution; its weights are scaled, being fewer than pixels."""
    assert convolution.bias is not None
    return functional.conv2d(features, convolution.weight * scale.transpose(0, 1), convolution.bias * scale.flatten())


def _gate(features: Tensor) -> Tensor:
    one, other = features.chunk(2, 1)
    return one * other
