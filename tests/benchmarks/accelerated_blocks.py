"""Fast kernels for training :class:`~kornia_tidy.reconstruction.nafnet.NAFNet` on a graphics processor, in Triton.

At 16 channels a pixel the network moves little data an operation, and PyTorch's kernels for layer normalisation and
depthwise convolution are made for more. :func:`use_fast_blocks` replaces these two and the gate after the latter, and
the gradients for the weights of 1x1 convolutions, all for maps in channels-last memory. Sums over pixels are added
atomically: two runs differ by round-off.
"""

from __future__ import annotations

from typing import Any

import torch
import triton  # ty: ignore[import-not-found]
import triton.language as tl  # ty: ignore[import-not-found]
from torch import Tensor, nn
from torch.nn import functional

PROGRAMS = 1056  # eight for each of the 132 multiprocessors of a Hopper card
PIXELS = 64  # that a program takes at a time


@triton.jit
def _norm(x, weight, bias, y, pixels, EPS: tl.constexpr, C: tl.constexpr, P: tl.constexpr):
    pixel = tl.program_id(0) * P + tl.arange(0, P)
    channel = tl.arange(0, C)
    inside = (pixel < pixels)[:, None]
    place = pixel[:, None] * C + channel[None, :]
    value = tl.load(x + place, mask=inside, other=0.0).to(tl.float32)
    apart = value - (tl.sum(value, 1) / C)[:, None]
    scale = 1 / tl.sqrt(tl.sum(apart * apart, 1) / C + EPS)
    out = apart * scale[:, None] * tl.load(weight + channel)[None, :] + tl.load(bias + channel)[None, :]
    tl.store(y + place, out.to(y.dtype.element_ty), mask=inside)


@triton.jit
def _norm_back(
    x, weight, given, wanted, weight_sum, bias_sum, pixels, EPS: tl.constexpr, C: tl.constexpr, P: tl.constexpr
):
    channel = tl.arange(0, C)
    factor = tl.load(weight + channel)[None, :]
    for_weight = tl.zeros((C,), tl.float32)
    for_bias = tl.zeros((C,), tl.float32)
    for block in range(tl.program_id(0), tl.cdiv(pixels, P), tl.num_programs(0)):
        pixel = block * P + tl.arange(0, P)
        inside = (pixel < pixels)[:, None]
        place = pixel[:, None] * C + channel[None, :]
        value = tl.load(x + place, mask=inside, other=0.0).to(tl.float32)
        slope = tl.load(given + place, mask=inside, other=0.0).to(tl.float32)
        apart = value - (tl.sum(value, 1) / C)[:, None]
        scale = 1 / tl.sqrt(tl.sum(apart * apart, 1) / C + EPS)
        normal = apart * scale[:, None]
        for_weight += tl.sum(slope * normal, 0)
        for_bias += tl.sum(slope, 0)
        scaled = slope * factor
        along = (tl.sum(scaled * normal, 1) / C)[:, None]
        out = scale[:, None] * (scaled - (tl.sum(scaled, 1) / C)[:, None] - normal * along)
        tl.store(wanted + place, out.to(wanted.dtype.element_ty), mask=inside)
    tl.atomic_add(weight_sum + channel, for_weight)
    tl.atomic_add(bias_sum + channel, for_bias)


@triton.jit
def _neighbour(pixel, rows, columns, pixels, down: tl.constexpr, across: tl.constexpr):
    """Return the index (P, 1) of the neighbour of each pixel, and whether it is in the same image."""
    row, column = (pixel // columns) % rows + down, pixel % columns + across
    inside = (pixel < pixels) & (row >= 0) & (row < rows) & (column >= 0) & (column < columns)
    return (pixel + down * columns + across)[:, None], inside[:, None]


@triton.jit
def _pair(maps, place, channel, inside, C: tl.constexpr):
    """Return the values of two halves of 2 C channels, (P, K) each."""
    place = place * (2 * C) + channel[None, :]
    first = tl.load(maps + place, mask=inside, other=0.0).to(tl.float32)
    return first, tl.load(maps + place + C, mask=inside, other=0.0).to(tl.float32)


@triton.jit
def _depthwise(
    u, weight, bias, pixel, channel, rows, columns, pixels, C: tl.constexpr, K: tl.constexpr, P: tl.constexpr
):
    """Return the two halves of a depthwise 3x3 convolution, (P, K) each."""
    one = tl.zeros((P, K), tl.float32) + tl.load(bias + channel)[None, :]
    two = tl.zeros((P, K), tl.float32) + tl.load(bias + C + channel)[None, :]
    for tap in tl.static_range(9):
        place, inside = _neighbour(pixel, rows, columns, pixels, tap // 3 - 1, tap % 3 - 1)
        first, second = _pair(u, place, channel, inside, C)
        one += first * tl.load(weight + channel * 9 + tap)[None, :]
        two += second * tl.load(weight + (C + channel) * 9 + tap)[None, :]
    return one, two


@triton.jit
def _depthwise_gate(u, weight, bias, out, rows, columns, pixels, C: tl.constexpr, K: tl.constexpr, P: tl.constexpr):
    pixel = tl.program_id(0) * P + tl.arange(0, P)
    channel = tl.program_id(1) * K + tl.arange(0, K)
    one, two = _depthwise(u, weight, bias, pixel, channel, rows, columns, pixels, C, K, P)
    place = pixel[:, None] * C + channel[None, :]
    tl.store(out + place, (one * two).to(out.dtype.element_ty), mask=(pixel < pixels)[:, None])


@triton.jit
def _depthwise_gate_back(
    u, weight, bias, given, slopes, weight_sum, bias_sum, rows, columns, pixels,
    C: tl.constexpr, K: tl.constexpr, P: tl.constexpr,
):  # fmt: skip
    """Write the gradients of the two gated maps, (pixels, 2 C), and sum those of weights and biases."""
    channel = tl.program_id(1) * K + tl.arange(0, K)
    taps = tl.arange(0, 16)[:, None]
    bias_one, bias_two = tl.zeros((K,), tl.float32), tl.zeros((K,), tl.float32)
    weight_one, weight_two = tl.zeros((16, K), tl.float32), tl.zeros((16, K), tl.float32)
    for block in range(tl.program_id(0), tl.cdiv(pixels, P), tl.num_programs(0)):
        pixel = block * P + tl.arange(0, P)
        one, two = _depthwise(u, weight, bias, pixel, channel, rows, columns, pixels, C, K, P)
        whole = (pixel < pixels)[:, None]
        slope = tl.load(given + pixel[:, None] * C + channel[None, :], mask=whole, other=0.0).to(tl.float32)
        slope_one, slope_two = slope * two, slope * one
        place = pixel[:, None] * (2 * C) + channel[None, :]
        tl.store(slopes + place, slope_one.to(slopes.dtype.element_ty), mask=whole)
        tl.store(slopes + place + C, slope_two.to(slopes.dtype.element_ty), mask=whole)
        bias_one += tl.sum(slope_one, 0)
        bias_two += tl.sum(slope_two, 0)
        for tap in tl.static_range(9):
            near, inside = _neighbour(pixel, rows, columns, pixels, tap // 3 - 1, tap % 3 - 1)
            first, second = _pair(u, near, channel, inside, C)
            weight_one += tl.where(taps == tap, tl.sum(slope_one * first, 0)[None, :], 0.0)
            weight_two += tl.where(taps == tap, tl.sum(slope_two * second, 0)[None, :], 0.0)
    tl.atomic_add(bias_sum + channel, bias_one)
    tl.atomic_add(bias_sum + C + channel, bias_two)
    tl.atomic_add(weight_sum + channel[None, :] * 9 + taps, weight_one, mask=taps < 9)
    tl.atomic_add(weight_sum + (C + channel[None, :]) * 9 + taps, weight_two, mask=taps < 9)


@triton.jit
def _spread(slopes, weight, wanted, rows, columns, pixels, C: tl.constexpr, K: tl.constexpr, P: tl.constexpr):
    """wanted = the transposed depthwise convolution of the slopes, (pixels, C)."""
    pixel = tl.program_id(0) * P + tl.arange(0, P)
    channel = tl.program_id(1) * K + tl.arange(0, K)
    total = tl.zeros((P, K), tl.float32)
    for tap in tl.static_range(9):
        place, inside = _neighbour(pixel, rows, columns, pixels, 1 - tap // 3, 1 - tap % 3)
        slope = tl.load(slopes + place * C + channel[None, :], mask=inside, other=0.0).to(tl.float32)
        total += slope * tl.load(weight + channel * 9 + tap)[None, :]
    place = pixel[:, None] * C + channel[None, :]
    tl.store(wanted + place, total.to(wanted.dtype.element_ty), mask=(pixel < pixels)[:, None])


@triton.jit
def _outer(x, given, weight_sum, bias_sum, pixels, IN: tl.constexpr, OUT: tl.constexpr, P: tl.constexpr):
    """weight_sum (OUT, IN) += sum over pixels of given times x; bias_sum (OUT,) += sum of given."""
    into, out = tl.arange(0, IN), tl.arange(0, OUT)
    total, light = tl.zeros((OUT, IN), tl.float32), tl.zeros((OUT,), tl.float32)
    for block in range(tl.program_id(0), tl.cdiv(pixels, P), tl.num_programs(0)):
        pixel = block * P + tl.arange(0, P)
        inside = pixel < pixels
        value = tl.load(x + pixel[:, None] * IN + into[None, :], mask=inside[:, None], other=0.0).to(tl.float32)
        slope = tl.load(given + pixel[None, :] * OUT + out[:, None], mask=inside[None, :], other=0.0).to(tl.float32)
        total += tl.dot(slope, value)
        light += tl.sum(slope, 1)
    tl.atomic_add(weight_sum + out[:, None] * IN + into[None, :], total)
    tl.atomic_add(bias_sum + out, light)


def _laid_out(maps: Tensor) -> Tensor:
    return maps.contiguous(memory_format=torch.channels_last)


@triton.jit
def _bilateral(image, color, out, rows, columns, SPACE: tl.constexpr, RADIUS: tl.constexpr, P: tl.constexpr):
    """Of images (B, 3, rows, columns) with a width in colour for each pixel, reflected at the border."""
    pixel = tl.program_id(0) * P + tl.arange(0, P)
    sheet = rows * columns
    inside = pixel < sheet
    base = image + tl.program_id(1) * 3 * sheet
    row, column = pixel // columns, pixel % columns
    red, green = tl.load(base + pixel, mask=inside, other=0.0), tl.load(base + sheet + pixel, mask=inside, other=0.0)
    blue = tl.load(base + 2 * sheet + pixel, mask=inside, other=0.0)
    width = tl.load(color + tl.program_id(1) * sheet + pixel, mask=inside, other=1.0)
    scale = -0.5 / (width * width)
    total = tl.zeros((P,), tl.float32)
    reds, greens, blues = tl.zeros((P,), tl.float32), tl.zeros((P,), tl.float32), tl.zeros((P,), tl.float32)
    for down in tl.static_range(-RADIUS, RADIUS + 1):
        for across in tl.static_range(-RADIUS, RADIUS + 1):
            y, x = tl.abs(row + down), tl.abs(column + across)
            y, x = tl.where(y >= rows, 2 * rows - 2 - y, y), tl.where(x >= columns, 2 * columns - 2 - x, x)
            place = base + y * columns + x
            one, two = tl.load(place, mask=inside, other=0.0), tl.load(place + sheet, mask=inside, other=0.0)
            three = tl.load(place + 2 * sheet, mask=inside, other=0.0)
            apart = tl.abs(one - red) + tl.abs(two - green) + tl.abs(three - blue)
            weight = tl.exp(apart * apart * scale - 0.5 * (down * down + across * across) / (SPACE * SPACE))
            total += weight
            reds += weight * one
            greens += weight * two
            blues += weight * three
    target = out + tl.program_id(1) * 3 * sheet + pixel
    tl.store(target, reds / total, mask=inside)
    tl.store(target + sheet, greens / total, mask=inside)
    tl.store(target + 2 * sheet, blues / total, mask=inside)


def bilateral(image: Tensor, color: Tensor, window: int, space: float) -> Tensor:
    """Filter as :func:`kornia_tidy.reconstruction.bilateral.bilateral_filter`, without gradients.

    Args:
        image: (B, 3, H, W) float32.
        color: (B, 1, H, W).
        window: odd.
        space: in pixels.
    """
    images, _, rows, columns = image.shape
    image, out = image.contiguous(), torch.empty_like(image, memory_format=torch.contiguous_format)
    color = color.expand(images, 1, rows, columns).contiguous()
    _bilateral[(triton.cdiv(rows * columns, 256), images)](image, color, out, rows, columns, space, window // 2, 256)
    return out


class _Norm(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, maps: Tensor, weight: Tensor, bias: Tensor, eps: float) -> Tensor:
        maps = _laid_out(maps)
        out = torch.empty_like(maps)
        channels = maps.shape[1]
        pixels, block = maps.numel() // channels, max(4, 4096 // channels)
        _norm[(triton.cdiv(pixels, block),)](maps, weight, bias, out, pixels, eps, channels, block)
        ctx.save_for_backward(maps, weight)
        ctx.eps = eps
        return out

    @staticmethod
    def backward(ctx: Any, *given: Tensor) -> Any:
        maps, weight = ctx.saved_tensors
        slope = _laid_out(given[0])
        channels = maps.shape[1]
        pixels, block = maps.numel() // channels, max(4, 2048 // channels)
        wanted = torch.empty_like(maps)
        sums = torch.zeros(2, channels, device=maps.device)
        grid = (min(PROGRAMS, triton.cdiv(pixels, block)),)
        _norm_back[grid](maps, weight, slope, wanted, sums[0], sums[1], pixels, ctx.eps, channels, block)
        return wanted, sums[0], sums[1], None


class _DepthwiseGate(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, maps: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
        maps, weight = _laid_out(maps), weight.contiguous()
        images, double, rows, columns = maps.shape
        channels, pixels = double // 2, images * rows * columns
        together = min(32, channels)
        out = torch.empty(images, channels, rows, columns, dtype=maps.dtype, device=maps.device)
        out = out.to(memory_format=torch.channels_last)
        grid = (triton.cdiv(pixels, PIXELS), channels // together)
        _depthwise_gate[grid](maps, weight, bias, out, rows, columns, pixels, channels, together, PIXELS)
        ctx.save_for_backward(maps, weight, bias)
        return out

    @staticmethod
    def backward(ctx: Any, *given: Tensor) -> Any:
        maps, weight, bias = ctx.saved_tensors
        slope = _laid_out(given[0])
        images, double, rows, columns = maps.shape
        channels, pixels = double // 2, images * rows * columns
        together = min(16, channels)
        slopes, wanted = torch.empty_like(maps), torch.empty_like(maps)
        weight_sum, bias_sum = torch.zeros_like(weight), torch.zeros_like(bias)
        parts = channels // together
        grid = (min(max(1, 2 * PROGRAMS // parts), triton.cdiv(pixels, PIXELS)), parts)
        _depthwise_gate_back[grid](
            maps, weight, bias, slope, slopes, weight_sum, bias_sum, rows, columns, pixels, channels, together, PIXELS
        )
        together = min(32, double)
        grid = (triton.cdiv(pixels, PIXELS), double // together)
        _spread[grid](slopes, weight, wanted, rows, columns, pixels, double, together, PIXELS)
        return wanted, weight_sum, bias_sum


class _OneByOne(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, maps: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
        maps = _laid_out(maps)
        flat = maps.permute(0, 2, 3, 1)
        matrix = weight.flatten(1).to(maps.dtype)
        ctx.save_for_backward(maps, matrix)
        return functional.linear(flat, matrix, bias.to(maps.dtype)).permute(0, 3, 1, 2)

    @staticmethod
    def backward(ctx: Any, *given: Tensor) -> Any:
        maps, matrix = ctx.saved_tensors
        slope = _laid_out(given[0])
        out, into = matrix.shape
        flat = slope.permute(0, 2, 3, 1)
        wanted = (flat.reshape(-1, out) @ matrix).view(*flat.shape[:3], into).permute(0, 3, 1, 2)
        if into * out <= 64 * 128:
            pixels = maps.numel() // into
            weight_sum = torch.zeros(out, into, device=maps.device)
            bias_sum = torch.zeros(out, device=maps.device)
            grid = (min(PROGRAMS, triton.cdiv(pixels, PIXELS)),)
            _outer[grid](maps, slope, weight_sum, bias_sum, pixels, into, out, PIXELS)
        else:
            flat = flat.reshape(-1, out)
            weight_sum = (flat.T @ maps.permute(0, 2, 3, 1).reshape(-1, into)).float()
            bias_sum = flat.float().sum(0)
        return wanted, weight_sum.view(out, into, 1, 1), bias_sum


def use_fast_blocks(network: Any, *, linear: bool = True) -> None:
    """Let a NAFNet compute by these kernels, in bfloat16, in place.

    Args:
        network: in channels-last memory.
        linear: use them for 1x1 convolutions too.
    """
    for module in network.modules():
        if type(module).__name__ == "_Block":
            module.forward = _FastBlock(module, linear=linear)
    network.first.forward = _Padded(network.first)
    network.last.forward = _Padded(network.last)
    if linear:
        for convolution in network.up:
            convolution.forward = _WithoutBias(convolution)


class _Padded:
    """A convolution with channels added up to a multiple of 16, for which there are faster kernels."""

    def __init__(self, convolution: nn.Conv2d) -> None:
        self.convolution = convolution

    def __call__(self, maps: Tensor) -> Tensor:
        weight, bias = self.convolution.weight, self.convolution.bias
        assert bias is not None
        more_out, more_in = -weight.shape[0] % 16, -weight.shape[1] % 16
        with torch.autocast(maps.device.type, enabled=False):
            maps = functional.pad(_laid_out(maps.to(torch.bfloat16)), (0, 0, 0, 0, 0, more_in))
            weight = functional.pad(weight.to(torch.bfloat16), (0, 0, 0, 0, 0, more_in, 0, more_out))
            out = functional.conv2d(
                _laid_out(maps), weight, functional.pad(bias.to(torch.bfloat16), (0, more_out)), padding=1
            )
        return out[:, : len(bias)]


class _WithoutBias:
    """A 1x1 convolution without bias."""

    def __init__(self, convolution: nn.Conv2d) -> None:
        self.convolution = convolution

    def __call__(self, maps: Tensor) -> Tensor:
        weight = self.convolution.weight
        with torch.autocast(maps.device.type, enabled=False):
            return _OneByOne.apply(maps.to(torch.bfloat16), weight, weight.new_zeros(len(weight)))


class _FastBlock:
    """The forward method of a block."""

    def __init__(self, block: Any, *, linear: bool) -> None:
        self.block, self.linear = block, linear

    def __call__(self, features: Tensor) -> Tensor:
        block = self.block
        features = features.to(torch.bfloat16)
        with torch.autocast(features.device.type, enabled=False):
            expanded = self._one_by_one(self._norm(block.norm1, features), block.expand1.weight, block.expand1.bias)
            mixed = _DepthwiseGate.apply(expanded, block.depthwise.weight, block.depthwise.bias)
            if block.attention is not None:
                around = functional.avg_pool2d(mixed, 3, 1, 1, count_include_pad=False)
                mixed = mixed * self._one_by_one(around, block.attention.weight, block.attention.bias)
            features = features + self._scaled(block.project1, block.beta, mixed)
            inner = self._one_by_one(self._norm(block.norm2, features), block.expand2.weight, block.expand2.bias)
            one, other = inner.chunk(2, 1)
            return features + self._scaled(block.project2, block.gamma, one * other)

    @staticmethod
    def _norm(norm: Any, maps: Tensor) -> Tensor:
        return _Norm.apply(maps, norm.weight, norm.bias, norm.eps)

    def _one_by_one(self, maps: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
        if self.linear:
            return _OneByOne.apply(maps, weight, bias)
        return functional.conv2d(maps, weight.to(maps.dtype), bias.to(maps.dtype))

    def _scaled(self, convolution: Any, scale: Tensor, maps: Tensor) -> Tensor:
        weight = convolution.weight * scale.transpose(0, 1)
        return self._one_by_one(maps, weight, convolution.bias * scale.flatten())
