"""C4 group convolution in the frequency domain: the same function with about 7x fewer products.

**What is computed.** A regular-to-regular C4 convolution maps fields x_g(p) to

    y_h(p) = sum_g sum_t K_{h,g}(t) x_g(p + t),        K_{h+1,g+1}(R t) = K_{h,g}(t),

g, h in Z4, R the quarter turn of ``torch.rot90(k=1)``: R(row, column) = (-column, row). One group
row K_{0,j} ("base filters") therefore fixes all four. Channel = field * 4 + g, as in escnn.

**No wrap-around.** The H x H map is padded with zeros to N x N, N the smallest odd number with
N >= H + k // 2. A cyclic convolution of that length equals the zero-padded one on the map, and
for odd N zero is the only frequency that equals its negative. Per frequency w,

    Y_h(w) = sum_g A_{h,g}(w) X_g(w),    A_{h,g}(w) = sum_t K_{h,g}(t) exp(i w.t).

**No complex numbers.** Turning twice takes w to -w, and the signals are real; together:
A_{h+2,g+2} = conj(A_{h,g}). Write s_g = X_g + X_{g+2}, d_g = X_g - X_{g+2} (g = 0, 1) and
e_g = -i d_g. With P_{h,g} = A_{h,g} + A_{h,g+2} and M_{h,g} = A_{h,g} - A_{h,g+2} one finds

    | s' |   | Re P   -Im M | | s |
    | e' | = | Im P    Re M | | e |,

a *real* 4 x 4 block per pair of fields. It acts alike on the real and on the imaginary part, so
one real matrix product per frequency serves both. The (N^2 - 1) / 2 pairs {w, -w} and w = 0 (there
Im P = Im M = 0 and d itself takes the place of e) make N^2 real rows per field, each costing four
products per field pair: 4 N^2 / H^2 = 5.06 per pixel and pair of channels' group rows, i.e. 20.25
per pixel and pair of fields at H = 8, against 16 * 9 = 144 for the direct sum.

**Orthonormal.** Sums and differences, cosines and sines are scaled so that the analysis S has
orthonormal columns. Synthesis is then its transpose, y = S^T A S x, errors are not amplified, and
the backward pass consists of the same three pieces: with Z = S dy,

    dx = S^T A^T Z,        dA = Z (S x)^T.

**Layout.** The spectrum is (frequency row, (sum/difference, g, field), batch): the analysis is two
matrix products with constant N^2 x H^2 matrices that write straight into it, the product over
fields is a batched matrix product on slices of it, and the synthesis reads it in place. The only
permutations are those of the sums and differences, which move whole maps of H^2 numbers.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.autograd.function import FunctionCtx, once_differentiable

__all__ = [
    "base_filters",
    "is_supported",
    "prefers_spectral",
    "spectral_conv2d",
    "spectral_conv2d_base",
    "spectral_product",
    "transform_filters",
]

_ORDER = 4  # of the group
_MAX_MAP_SIZE = 17  # the transform is a dense N^2 x H^2 matrix: pointless beyond such maps


def is_supported(map_size: int, kernel_size: int, stride: int = 1) -> bool:
    """Tell whether the spectral form computes this convolution.

    Args:
        map_size: H of the square H x H map, in cells.
        kernel_size: k of the k x k kernel; the padding is k // 2.
        stride: Stride of the convolution.

    Returns:
        True for stride 1, odd k that is not larger than the map, and 2 <= H <= 17.
    """
    return (
        stride == 1
        and kernel_size % 2 == 1
        and kernel_size <= map_size
        and 2 <= map_size <= _MAX_MAP_SIZE
    )


def prefers_spectral(
    c_in: int,
    c_out: int,
    *,
    map_size: int,
    batch: int,
    dtype: torch.dtype = torch.float32,
    kernel_size: int = 3,
    cached: bool = False,
) -> bool:
    """Tell where the spectral form was measured to be faster than the dense one on a CPU.

    The rule is cautious: it says yes only where the gain stood out from the noise of repeated runs
    (see docs/c4_spectral.md). Transforming the filters costs as much as some twenty images,
    whatever the number of fields; the dense transforms of 16 x 16 maps cost more than they save;
    in bfloat16 with matrix units (AMX) runs contradicted each other.

    Args:
        c_in: Input fields (channels / 4).
        c_out: Output fields.
        map_size: H of the H x H map.
        batch: Number of images.
        dtype: What the products run in (the autocast dtype under autocast).
        kernel_size: k of the k x k kernel.
        cached: The transformed filters are at hand (evaluation), so their cost does not count.

    Returns:
        True if the spectral form is supported and expected to be faster.
    """
    return (
        is_supported(map_size, kernel_size)
        and kernel_size >= 3
        and map_size in (8, 9)
        and dtype in (torch.float32, torch.float64)
        and min(c_in, c_out) >= 16
        and c_in * c_out >= 1024
        and batch >= (16 if cached else 32)
    )


def padded_size(map_size: int, kernel_size: int) -> int:
    """Return N, the smallest odd length that keeps a k x k kernel from wrapping round."""
    length = map_size + kernel_size // 2
    return length if length % 2 == 1 else length + 1


def base_filters(kernel: Tensor) -> Tensor:
    """Take the first group row K[0, j] of an expanded C4 kernel.

    Args:
        kernel: Expanded kernel, shape (C_out * 4, C_in * 4, k, k), channel = field * 4 + g.

    Returns:
        A view, shape (C_out, C_in * 4, k, k).
    """
    return kernel[::_ORDER]


@dataclass(frozen=True)
class _Constants:
    """Constant matrices for one map size and kernel size.

    Attributes:
        analysis: Shape (2, N^2, H^2): the transform of the sums and that of the differences. Rows:
            real parts of the pairs {w, -w}, then w = 0, then imaginary parts.
        filters: Shape ((pairs + 1) * 16, 4 * k^2): from the base filters (j, tap) of a field pair
            to its real blocks (frequency, s'|e', h, s|e, g).
    """

    analysis: Tensor
    filters: Tensor


@functools.lru_cache(maxsize=32)
@torch.inference_mode(mode=False)  # kept for later training steps, whoever asks first
def _constants(
    map_size: int, kernel_size: int, dtype: torch.dtype, device: torch.device
) -> _Constants:
    """Build the constant matrices in float64 and cast them."""
    size = padded_size(map_size, kernel_size)
    # One of w and -w; zero, its own negative, comes last.
    pairs = [
        (a, b) for a in range(size) for b in range(size) if (a, b) > ((-a) % size, (-b) % size)
    ]
    omega = torch.tensor([*pairs, (0, 0)], dtype=torch.float64) * (2.0 * math.pi / size)

    cells = torch.arange(map_size, dtype=torch.float64)
    phase = omega @ torch.cartesian_prod(cells, cells).T  # (pairs + 1, H^2)
    cosine, sine = phase.cos(), phase.sin()
    # X(w) = sum_p x(p) exp(-i w.p); 1/sqrt(2) per sum or difference; sqrt(2) for the pairs.
    scale = 1.0 / size
    zero = cosine[-1:] * (scale / math.sqrt(2.0))
    real, imaginary = cosine[:-1] * scale, -sine[:-1] * scale
    analysis = torch.stack(
        [
            torch.cat([real, zero, imaginary]),  # s = (Re, Im)
            torch.cat([imaginary, zero, -real]),  # e = -i d = (Im, -Re)
        ]
    )

    offset = torch.arange(kernel_size, dtype=torch.float64) - kernel_size // 2
    tap = torch.cartesian_prod(offset, offset)  # (k^2, 2), (row, column)
    filters = omega.new_zeros(len(omega), 2, 2, 2, 2, _ORDER, len(tap))
    for h in range(2):  # A_{h,g}(w) = sum_t K_{0,g-h}(t) exp(i w . R^h t)
        angle = omega @ tap.T  # (pairs + 1, k^2)
        for g in range(2):
            for j, sign in (((g - h) % _ORDER, 1.0), ((g + 2 - h) % _ORDER, -1.0)):
                filters[:, 0, h, 0, g, j] = angle.cos()  # Re P
                filters[:, 0, h, 1, g, j] = -sign * angle.sin()  # -Im M
                filters[:, 1, h, 0, g, j] = angle.sin()  # Im P
                filters[:, 1, h, 1, g, j] = sign * angle.cos()  # Re M
        tap = torch.stack([-tap[:, 1], tap[:, 0]], dim=1)
    filters = filters.view(-1, _ORDER * len(tap))
    return _Constants(analysis.to(device, dtype), filters.to(device, dtype))


def _analyse(x: Tensor, analysis: Tensor) -> Tensor:
    """Apply S: maps (B, C * 4, H, W) to the spectrum (N^2, 4 * C, B), rows (s|e, g, field)."""
    batch, channels = x.shape[:2]
    fields, pixels = channels // _ORDER, x.shape[2] * x.shape[3]
    halves = x.reshape(batch, fields, 2, 2, pixels).permute(2, 3, 1, 0, 4)  # (g // 2, g % 2, C, B)
    mixed = x.new_empty(2, 2, fields, batch, pixels)
    torch.add(halves[0], halves[1], out=mixed[0])
    torch.sub(halves[0], halves[1], out=mixed[1])
    spectrum = x.new_empty(analysis.shape[1], 2, 2 * fields * batch)
    torch.bmm(analysis, mixed.view(2, -1, pixels).mT, out=spectrum.transpose(0, 1))
    return spectrum.view(-1, channels, batch)


def _synthesise(spectrum: Tensor, analysis: Tensor, map_size: int) -> Tensor:
    """Apply S^T: the spectrum (N^2, 4 * C, B) to maps (B, C * 4, H, H), contiguous."""
    rows, channels, batch = spectrum.shape
    fields, pixels = channels // _ORDER, map_size * map_size
    spectrum = spectrum.view(rows, 2, -1)
    mixed = torch.bmm(spectrum.permute(1, 2, 0), analysis).view(2, 2, fields, batch, pixels)
    y = spectrum.new_empty(batch, fields, 2, 2, pixels)
    halves = y.permute(2, 3, 1, 0, 4)
    torch.add(mixed[0], mixed[1], out=halves[0])
    torch.sub(mixed[0], mixed[1], out=halves[1])
    return y.view(batch, channels, map_size, map_size)


def _multiply(blocks: Tensor, spectrum: Tensor) -> Tensor:
    """Multiply blocks (F, M, K) with a spectrum (2 F - 1, K, B): real and imaginary parts."""
    count = blocks.shape[0]
    product = spectrum.new_empty(spectrum.shape[0], blocks.shape[1], spectrum.shape[2])
    torch.bmm(blocks, spectrum[:count], out=product[:count])
    torch.bmm(blocks[:-1], spectrum[count:], out=product[count:])
    return product


def _correlate(left: Tensor, right: Tensor) -> Tensor:
    """Sum left @ right^T over batch and over real and imaginary parts: (F, M, K)."""
    count = (left.shape[0] + 1) // 2
    total = torch.bmm(left[:count], right[:count].mT)
    total[:-1].baddbmm_(left[count:], right[count:].mT)
    return total


class _SpectralProduct(torch.autograd.Function):
    """y = S^T A S x; the products run in the dtype of ``blocks``, the transforms in x's."""

    @staticmethod
    def forward(ctx: FunctionCtx, x: Tensor, blocks: Tensor, kernel_size: int) -> Tensor:
        analysis = _constants(x.shape[2], kernel_size, x.dtype, x.device).analysis
        spectrum = _analyse(x, analysis).to(blocks.dtype)
        ctx.save_for_backward(spectrum, blocks)
        ctx.analysis, ctx.map_size = analysis, x.shape[2]  # type: ignore[attr-defined]
        return _synthesise(_multiply(blocks, spectrum).to(x.dtype), analysis, x.shape[2])

    @staticmethod
    @once_differentiable
    def backward(ctx: FunctionCtx, grad: Tensor) -> tuple[Tensor | None, Tensor | None, None]:
        spectrum, blocks = ctx.saved_tensors  # type: ignore[attr-defined]
        analysis: Tensor = ctx.analysis  # type: ignore[attr-defined]
        upstream = _analyse(grad.to(analysis.dtype), analysis).to(blocks.dtype)
        need_x, need_blocks, _ = ctx.needs_input_grad  # type: ignore[attr-defined]
        grad_x = grad_blocks = None
        if need_x:
            product = _multiply(blocks.mT, upstream).to(analysis.dtype)
            grad_x = _synthesise(product, analysis, ctx.map_size)  # type: ignore[attr-defined]
        if need_blocks:
            grad_blocks = _correlate(upstream, spectrum)
        return grad_x, grad_blocks, None


def transform_filters(base: Tensor, map_size: int) -> Tensor:
    """Transform base filters to the real blocks that :func:`spectral_product` multiplies with.

    In evaluation mode the result can be kept for as long as the filters do not change; it has
    2 (N^2 + 1) / k^2 times the memory of ``base`` (18x for 3 x 3 filters on 8 x 8 maps).

    Args:
        base: Filters K[0, j] of the first group row, shape (C_out, C_in * 4, k, k), channel =
            field * 4 + j.
        map_size: H of the H x H maps that will be convolved.

    Returns:
        Blocks, shape ((N^2 + 1) / 2, 4 * C_out, 4 * C_in), in the dtype of ``base``.
    """
    out_fields, channels, kernel_size = base.shape[:3]
    matrix = _constants(map_size, kernel_size, base.dtype, base.device).filters
    with torch.autocast(base.device.type, enabled=False):
        # (frequency * s'|e' * h * s|e * g, C_out * C_in): then only runs of C_in numbers move.
        blocks = matrix @ base.reshape(-1, matrix.shape[1]).t()
        blocks = blocks.view(-1, _ORDER, _ORDER, out_fields, channels // _ORDER)
        return blocks.transpose(2, 3).reshape(-1, _ORDER * out_fields, channels)


def spectral_product(x: Tensor, blocks: Tensor, *, kernel_size: int) -> Tensor:
    """Convolve maps with transformed filters.

    Under autocast, or with ``blocks`` of a lower precision, only the products over the fields run
    in the lower precision; the transforms stay in the precision of ``x``.

    Args:
        x: Maps, shape (B, C_in * 4, H, H), channel = field * 4 + g.
        blocks: Result of :func:`transform_filters` for this H.
        kernel_size: k of the filters that ``blocks`` was made from.

    Returns:
        Maps, shape (B, C_out * 4, H, H), contiguous, in the dtype of ``x``. Differentiable once.

    Raises:
        ValueError: if the shapes do not fit together or the convolution is not supported.
    """
    _check(x, blocks.shape[2], kernel_size)
    count = (padded_size(x.shape[2], kernel_size) ** 2 + 1) // 2
    if blocks.shape[0] != count:
        raise ValueError(
            f"The filters were transformed for {blocks.shape[0]} frequencies, but a "
            f"{x.shape[2]}x{x.shape[3]} map with a {kernel_size}x{kernel_size} kernel has {count}: "
            f"call transform_filters(base, map_size={x.shape[2]})."
        )
    device = x.device.type
    if torch.is_autocast_enabled(device) and blocks.dtype != torch.float64:
        blocks = blocks.to(torch.get_autocast_dtype(device))
    with torch.autocast(device, enabled=False):
        return _SpectralProduct.apply(x, blocks, kernel_size)


def spectral_conv2d_base(x: Tensor, base: Tensor) -> Tensor:
    """Convolve with a C4 kernel that is given by its first group row.

    Args:
        x: Maps, shape (B, C_in * 4, H, H), channel = field * 4 + g.
        base: Filters K[0, j], shape (C_out, C_in * 4, k, k).

    Returns:
        Maps, shape (B, C_out * 4, H, H): what ``F.conv2d(x, kernel, padding=k // 2)`` gives for the
        expanded kernel K[h, g] = rot90^h(K[0, g - h]).

    Raises:
        ValueError: if the shapes do not fit together or the convolution is not supported.
    """
    _check(x, base.shape[1], base.shape[-1])
    blocks = transform_filters(base, x.shape[2])
    return spectral_product(x, blocks, kernel_size=base.shape[-1])


def spectral_conv2d(x: Tensor, kernel: Tensor) -> Tensor:
    """Convolve with an expanded C4 kernel, of which only every fourth row is read.

    The other rows follow by symmetry, so the whole gradient with respect to the kernel arrives in
    the rows h = 0 (the others get zero). For parameters *behind* the expansion it is the same
    gradient as that of the dense convolution. A kernel that is not C4-equivariant is not noticed.

    Args:
        x: Maps, shape (B, C_in * 4, H, H), channel = field * 4 + g.
        kernel: Expanded regular-to-regular kernel, shape (C_out * 4, C_in * 4, k, k).

    Returns:
        Maps, shape (B, C_out * 4, H, H), equal to ``F.conv2d(x, kernel, padding=k // 2)``.

    Raises:
        ValueError: if the shapes do not fit together or the convolution is not supported.
    """
    if kernel.ndim != 4 or kernel.shape[0] % _ORDER:
        raise ValueError(
            f"Expected an expanded kernel (C_out * 4, C_in * 4, k, k), got {tuple(kernel.shape)}; "
            "base filters go to spectral_conv2d_base."
        )
    return spectral_conv2d_base(x, base_filters(kernel))


def _check(x: Tensor, channels: int, kernel_size: int) -> None:
    """Raise a ValueError that names the shapes unless the convolution is supported."""
    if x.ndim != 4 or x.shape[2] != x.shape[3] or x.shape[1] != channels or channels % _ORDER:
        raise ValueError(
            f"Expected square maps (B, {channels}, H, H) for filters with {channels} input "
            f"channels (a multiple of {_ORDER}), got {tuple(x.shape)}."
        )
    if not is_supported(x.shape[2], kernel_size):
        raise ValueError(
            f"No spectral form for a {kernel_size}x{kernel_size} kernel on a {x.shape[2]}x"
            f"{x.shape[2]} map: allowed are odd kernels not larger than the map and maps of 2 to "
            f"{_MAX_MAP_SIZE} cells. Use torch.nn.functional.conv2d."
        )
