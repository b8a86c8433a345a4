"""Direct convolution on graphics processors: kernels in Triton for gather, scatter, PSF gradients and occlusion.

A program computes a tile of the output, or a block of samples of the PSFs. Each pixel is multiplied by the PSFs of its
own one or two layers, which it looks up: the work does not depend on how layers lie in the image. The samples of a PSF
tap are stored for all layers side by side, so that the look-ups of neighbouring pixels share a line of the cache.

The sums of a row of a PSF, or of a row of the image, are added up separately: blocked summation has a smaller rounding
error than one long sum. No value is added atomically, so the same input gives the same bits.

This module needs Triton; :mod:`kornia_tidy.kernels.triton_ops` calls it. Widths, heights and strides count elements,
rows of pixels are contiguous, and images that share a map have a stride of 0. Pixels whose index is no layer become
NaN, except with occlusion.
"""

import triton  # ty: ignore[import-not-found]
import triton.language as tl  # ty: ignore[import-not-found]

# Sizes and strides of any value are served by one compiled kernel.
SIZES = ["height", "width", "light_height", "light_width", "channels", "layers", "offset", "side", "parts"]
SIZES += ["rows_each", "images", "light_image", "light_channel", "light_row", "values_image", "values_channel"]
SIZES += ["values_row", "map_image", "map_row", "weight_image", "weight_row"]


@triton.jit(do_not_specialize=SIZES)
def gather_kernel(
    light,  # (B, C, light_height, light_width)
    taps,  # (C, P, P, D)
    index,  # (B, height, width) int32
    weight,  # like index, of the light's dtype
    out,  # (B, C, height, width)
    height,
    width,
    light_height,
    light_width,
    channels,
    layers,
    offset,
    side,
    light_image,
    light_channel,
    light_row,
    map_image,
    map_row,
    weight_image,
    weight_row,
    PADDED: tl.constexpr,
    LINEAR: tl.constexpr,
    WEIGHT_GRADIENT: tl.constexpr,
    ROWS: tl.constexpr,
    COLUMNS: tl.constexpr,
):
    """out[y, x] = sum over j, k of taps[j, k] of the layers of (y, x), times light[y + j - offset, x + k - offset]."""
    across, down = tl.cdiv(width, COLUMNS), tl.cdiv(height, ROWS)
    number = tl.program_id(0)
    tile, plane = number % (across * down), (number // (across * down)).to(tl.int64)
    channel, image = plane % channels, plane // channels
    y = (tile // across) * ROWS + tl.arange(0, ROWS)[:, None]
    x = (tile % across) * COLUMNS + tl.arange(0, COLUMNS)[None, :]
    inside = (y < height) & (x < width)

    layer = tl.load(index + image * map_image + y * map_row + x, mask=inside, other=0)
    valid = (layer >= 0) & (layer < layers)
    has_next = valid & (layer + 1 < layers)
    light += image * light_image + channel * light_channel + (y - offset) * light_row + x - offset
    tap = taps + channel * side * side * layers + layer

    dtype = light.dtype.element_ty
    below = tl.zeros([ROWS, COLUMNS], dtype)
    above = tl.zeros([ROWS, COLUMNS], dtype)
    for j in range(side):
        row = y + (j - offset)
        in_rows = inside & (row >= 0) & (row < light_height)
        seen = in_rows
        row_below = tl.zeros([ROWS, COLUMNS], dtype)
        row_above = tl.zeros([ROWS, COLUMNS], dtype)
        for k in range(side):
            if PADDED:
                seen = in_rows & (x + k >= offset) & (x + k < light_width + offset)
            value = tl.load(light + k, mask=seen, other=0)
            row_below += value * tl.load(tap, mask=valid, other=float("nan"))
            if LINEAR:
                row_above += value * tl.load(tap + 1, mask=has_next, other=0)
            tap += layers
        below += row_below
        above += row_above
        light += light_row
    if WEIGHT_GRADIENT:
        below = above - below
    elif LINEAR:
        share = tl.load(weight + image * weight_image + y * weight_row + x, mask=inside, other=0)
        below = (1 - share) * below + share * above
    tl.store(out + (plane * height + y) * width + x, below, mask=inside)


@triton.jit(do_not_specialize=SIZES)
def scatter_kernel(
    light,  # (B, C, light_height, light_width)
    taps,  # (C, P, P, D)
    index,  # (B, light_height, light_width) int32
    weight,  # like index, of the light's dtype
    out,  # (B, C, height, width)
    height,
    width,
    light_height,
    light_width,
    channels,
    layers,
    offset,
    side,
    light_image,
    light_channel,
    light_row,
    map_image,
    map_row,
    weight_image,
    weight_row,
    PADDED: tl.constexpr,
    LINEAR: tl.constexpr,
    ROWS: tl.constexpr,
    COLUMNS: tl.constexpr,
):
    """As ``gather_kernel``, with the taps of the layers of the pixel (y + j - offset, x + k - offset) of the light."""
    across, down = tl.cdiv(width, COLUMNS), tl.cdiv(height, ROWS)
    number = tl.program_id(0)
    tile, plane = number % (across * down), (number // (across * down)).to(tl.int64)
    channel, image = plane % channels, plane // channels
    y = (tile // across) * ROWS + tl.arange(0, ROWS)[:, None]
    x = (tile % across) * COLUMNS + tl.arange(0, COLUMNS)[None, :]
    inside = (y < height) & (x < width)

    light += image * light_image + channel * light_channel + (y - offset) * light_row + x - offset
    index += image * map_image + (y - offset) * map_row + x - offset
    weight += image * weight_image + (y - offset) * weight_row + x - offset
    taps += channel * side * side * layers

    dtype = light.dtype.element_ty
    total = tl.zeros([ROWS, COLUMNS], dtype)
    for j in range(side):
        row = y + (j - offset)
        in_rows = inside & (row >= 0) & (row < light_height)
        seen = in_rows
        of_row = tl.zeros([ROWS, COLUMNS], dtype)
        for k in range(side):
            if PADDED:
                seen = in_rows & (x + k >= offset) & (x + k < light_width + offset)
            layer = tl.load(index + k, mask=seen, other=0)
            valid = (layer >= 0) & (layer < layers)
            psf = tl.load(taps + layer, mask=valid, other=float("nan"))
            if LINEAR:
                share = tl.load(weight + k, mask=seen, other=0)
                above = tl.load(taps + layer + 1, mask=valid & (layer + 1 < layers), other=0)
                psf = (1 - share) * psf + share * above
            of_row += tl.load(light + k, mask=seen, other=0) * psf
            taps += layers
        total += of_row
        light += light_row
        index += map_row
        weight += weight_row
    tl.store(out + (plane * height + y) * width + x, total, mask=inside)


@triton.jit(do_not_specialize=SIZES)
def correlate_kernel(
    light,  # (B, C, light_height, light_width)
    values,  # (B, C, height, width)
    index,  # (B, height, width) int32
    weight,  # like index, of the light's dtype
    out,  # (parts, D, C, P, P)
    images,
    height,
    width,
    light_height,
    light_width,
    channels,
    layers,
    offset,
    side,
    parts,
    rows_each,
    light_image,
    light_channel,
    light_row,
    values_image,
    values_channel,
    values_row,
    map_image,
    map_row,
    weight_image,
    weight_row,
    LINEAR: tl.constexpr,
    WEIGHT_GRADIENT: tl.constexpr,
    LAYERS: tl.constexpr,
    TAPS: tl.constexpr,
    PIXELS: tl.constexpr,
):
    """out[d, j, k] = sum over y, x of weight_d[y, x] values[y, x] light[y + j - offset, x + k - offset].

    A product of matrices for each row of the image: layers by pixels, and pixels by the taps of a row of the PSF. Parts
    of the image's rows have sums of their own.
    """
    chunks, blocks = tl.cdiv(layers, LAYERS), tl.cdiv(side, TAPS)
    number = tl.program_id(0)
    block, number = number % blocks, number // blocks
    j, number = number % side, number // side
    chunk, number = number % chunks, number // chunks
    channel, part = (number % channels).to(tl.int64), number // channels

    layer = chunk * LAYERS + tl.arange(0, LAYERS)
    k = block * TAPS + tl.arange(0, TAPS)
    pixel = tl.arange(0, PIXELS)
    dtype = light.dtype.element_ty
    total = tl.zeros([LAYERS, TAPS], dtype)
    first = part * rows_each
    for row in range(first, tl.minimum(first + rows_each, images * height)):
        image, y = (row // height).to(tl.int64), row % height
        from_row = y + j - offset
        of_index = index + image * map_image + y * map_row
        of_weight = weight + image * weight_image + y * weight_row
        of_values = values + image * values_image + channel * values_channel + y * values_row
        of_light = light + image * light_image + channel * light_channel + from_row * light_row
        of_row = tl.zeros([LAYERS, TAPS], dtype)
        for left in range(0, tl.where((from_row >= 0) & (from_row < light_height), width, 0), PIXELS):
            x = left + pixel
            inside = x < width
            own = tl.load(of_index + x, mask=inside, other=-1)[None, :]
            value = tl.load(of_values + x, mask=inside, other=0)[None, :]
            here, next_one = own == layer[:, None], (own >= 0) & (own + 1 == layer[:, None])
            if WEIGHT_GRADIENT:
                factor = tl.where(here, -value, tl.where(next_one, value, 0.0))
            elif LINEAR:
                share = tl.load(of_weight + x, mask=inside, other=0)[None, :]
                factor = tl.where(here, (1 - share) * value, tl.where(next_one, share * value, 0.0))
            else:
                factor = tl.where(here, value, 0.0)
            from_column = x[:, None] + (k[None, :] - offset)
            seen = inside[:, None] & (k < side)[None, :] & (from_column >= 0) & (from_column < light_width)
            shifted = tl.load(of_light + from_column, mask=seen, other=0)
            of_row += tl.dot(factor.to(dtype), shifted, input_precision="ieee", out_dtype=dtype)
        total += of_row
    to = (((part * layers + layer[:, None]).to(tl.int64) * channels + channel) * side + j) * side + k[None, :]
    tl.store(out + to, total, mask=(layer < layers)[:, None] & (k < side)[None, :])


@triton.jit
def _layers_within(index, rows, columns, row_stride, layers, SPAN: tl.constexpr):
    """Return the lowest and the highest layer of a window's pixels; the highest is -1 if there is none."""
    lowest, highest = layers, -1
    span = tl.arange(0, SPAN)
    for row in range(rows):
        for column in range(0, columns, SPAN):
            layer = tl.load(index + row * row_stride + column + span, mask=column + span < columns, other=layers)
            lowest = tl.minimum(lowest, tl.min(layer, 0))
            highest = tl.maximum(highest, tl.max(tl.where(layer < layers, layer, -1), 0))
    return tl.maximum(lowest, 0), highest


@triton.jit
def _blur_layer(
    light,
    taps,
    index,
    weight,
    d,
    stray,
    evenly,
    inside,
    layers,
    side,
    light_row,
    map_row,
    weight_row,
    LINEAR: tl.constexpr,
    ROWS: tl.constexpr,
    COLUMNS: tl.constexpr,
):
    """Return the blurred light of layer d, its alpha, and its cumulative alpha."""
    dtype = light.dtype.element_ty
    lit = tl.zeros([ROWS, COLUMNS], dtype)
    alpha = tl.zeros([ROWS, COLUMNS], dtype)
    cumulative = tl.zeros([ROWS, COLUMNS], dtype)
    for j in range(side):
        row_lit = tl.zeros([ROWS, COLUMNS], dtype)
        row_alpha = tl.zeros([ROWS, COLUMNS], dtype)
        row_cumulative = tl.zeros([ROWS, COLUMNS], dtype)
        for k in range(side):
            psf = tl.load(taps + (j * side + k) * layers + d)
            value = (1 - stray) * tl.load(light + j * light_row + k, mask=inside, other=0) + evenly
            layer = tl.load(index + j * map_row + k, mask=inside, other=layers)
            share = tl.zeros([ROWS, COLUMNS], dtype)
            if LINEAR:
                share = tl.load(weight + j * weight_row + k, mask=inside, other=0)
            of_layer = tl.where(layer == d, (1 - share) * psf, 0.0)
            row_cumulative += tl.where(layer < d, psf, of_layer)
            if LINEAR:
                of_layer = tl.where(layer + 1 == d, share * psf, of_layer)
            row_lit += of_layer * value
            row_alpha += of_layer
        lit += row_lit
        alpha += row_alpha
        cumulative += row_cumulative
    return lit, alpha, cumulative


@triton.jit(do_not_specialize=SIZES)
def occlusion_kernel(
    light,  # (B, C, height + P - 1, width + P - 1)
    taps,  # (C, P, P, D)
    index,  # (B, height + P - 1, width + P - 1) int32: D is no layer
    weight,  # like index, of the light's dtype
    mean,  # (B, C)
    stray_light,  # (D, C)
    out,  # (B, C, height, width)
    height,
    width,
    channels,
    layers,
    side,
    light_image,
    light_channel,
    light_row,
    map_image,
    map_row,
    weight_image,
    weight_row,
    EPSILON: tl.constexpr,
    LINEAR: tl.constexpr,
    STRAY: tl.constexpr,
    ROWS: tl.constexpr,
    COLUMNS: tl.constexpr,
    SPAN: tl.constexpr,
):
    """Composite the layers in a tile's window from near to far, each blurred and normalised."""
    across, down = tl.cdiv(width, COLUMNS), tl.cdiv(height, ROWS)
    number = tl.program_id(0)
    tile, plane = number % (across * down), (number // (across * down)).to(tl.int64)
    channel, image = plane % channels, plane // channels
    top, left = (tile // across) * ROWS, (tile % across) * COLUMNS
    y, x = top + tl.arange(0, ROWS)[:, None], left + tl.arange(0, COLUMNS)[None, :]
    inside = (y < height) & (x < width)

    index += image * map_image
    rows, columns = tl.minimum(top + ROWS, height) - top, tl.minimum(left + COLUMNS, width) - left
    window = index + top * map_row + left
    lowest, highest = _layers_within(window, rows + side - 1, columns + side - 1, map_row, layers, SPAN)
    if LINEAR:
        highest = tl.minimum(highest + 1, layers - 1)

    light += image * light_image + channel * light_channel + y * light_row + x
    index += y * map_row + x
    weight += image * weight_image + y * weight_row + x
    taps += channel * side * side * layers
    dtype = light.dtype.element_ty
    total = tl.zeros([ROWS, COLUMNS], dtype)
    transmitted = tl.full([ROWS, COLUMNS], 1, dtype)
    for step in range(highest - lowest + 1):
        d = highest - step
        stray, evenly = 0.0, 0.0
        if STRAY:
            stray = tl.load(stray_light + d * channels + channel)
            evenly = stray * tl.load(mean + plane)
        lit, alpha, cumulative = _blur_layer(
            light,
            taps,
            index,
            weight,
            d,
            stray,
            evenly,
            inside,
            layers,
            side,
            light_row,
            map_row,
            weight_row,
            LINEAR,
            ROWS,
            COLUMNS,
        )
        scale = transmitted / (tl.maximum(cumulative, 0.0) + EPSILON)
        total += scale * lit
        transmitted -= scale * alpha
    tl.store(out + (plane * height + y) * width + x, total, mask=inside)
