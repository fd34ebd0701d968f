"""C4 group convolution in the frequency domain: the same function with a seventh of the products.

**What is computed.** A regular-to-regular C4 convolution maps fields x_g(p) to

    y_h(p) = sum_g sum_t K_{h,g}(t) x_g(p + t),        K_{h+1,g+1}(R t) = K_{h,g}(t),

g, h in Z4, R the quarter turn of ``torch.rot90(k=1)``: R(row, column) = (-column, row). One group
row K_{0,j} ("base filters") therefore fixes all four. Channel = field * 4 + g, as in escnn.

**No wrap-around.** The H x H map is padded with zeros to N x N, N the smallest odd number with
N >= H + k // 2. A cyclic convolution of that length equals the zero-padded one on the map, and
for odd N zero is the only frequency that a turn leaves alone. Per frequency w,

    Y_h(w) = sum_g A_{h,g}(w) X_g(w),    A_{h,g}(w) = sum_t K_{h,g}(t) exp(i w.t).

**One block for four frequencies.** A_{h+1,g+1}(R w) = A_{h,g}(w): numbering the fields one further
at R w, both frequencies have the same matrix. Two turns take w to -w, where real signals have
conjugate values, so that A_{h+2,g+2} = conj(A_{h,g}).

**No complex numbers.** Write s_g = X_g + X_{g+2}, d_g = X_g - X_{g+2} (g = 0, 1) and e_g = -i d_g.
With P_{h,g} = A_{h,g} + A_{h,g+2} and M_{h,g} = A_{h,g} - A_{h,g+2} one finds

    | s' |   | Re P   -Im M | | s |
    | e' | = | Im P    Re M | | e |,

a *real* 4 x 4 block per pair of fields, which acts alike on real and imaginary parts. Each of the
(N^2 - 1) / 4 orbits {w, Rw, -w, -Rw} is thus one real matrix (4 C_out x 4 C_in) and four columns
an image: Re and Im at w and at R w. At w = 0, where Im P = Im M = 0 and d itself takes the place
of e, it is one column. Together 4 N^2 / H^2 = 5.06 products per pixel and pair of channels' group
rows, i.e. 20.25 per pixel and pair of fields at H = 8, against 16 * 9 = 144 for the direct sum.

**Orthonormal.** Sums and differences, cosines and sines are scaled so that the analysis S has
orthonormal columns. Synthesis is then its transpose, y = S^T A S x, errors are not amplified, and
the backward pass consists of the same three pieces: with Z = S dy,

    dx = S^T A^T Z,        dA = Z (S x)^T.

**Layout.** Between layers maps are *pixel-major*: (pixels, 4, fields, batch), see
`i2i.nn.pixel_major`. Analysis and synthesis are then products of small constant matrices with whole
rows of all fields and images. What they write is put together by orbit, so that each block meets
its four columns of all images in one product.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.autograd.function import FunctionCtx, once_differentiable

from i2i.nn import native
from i2i.nn.c4_spectral_constants import (
    MAX_MAP_SIZE,
    ORDER,
    constants,
    is_supported,
    padded_size,
)
from i2i.nn.c4_transforms import Spectrum, analyse, synthesise
from i2i.nn.native.products import multiply
from i2i.nn.pixel_major import from_pixel_major, to_pixel_major

__all__ = [
    "base_filters", "is_supported",
    "product_dtype",
    "spectral_conv2d",
    "spectral_conv2d_base",
    "spectral_conv_pixel_major",
    "spectral_product",
    "transform_filters",
    "transform_matrix",
]  # fmt: skip


_ORBITS_AT_ONCE = 4


def base_filters(kernel: Tensor) -> Tensor:
    """Take the first group row K[0, j] of an expanded C4 kernel.

    Args:
        kernel: Expanded kernel, shape (C_out * 4, C_in * 4, k, k), channel = field * 4 + g.

    Returns:
        A view, shape (C_out, C_in * 4, k, k).
    """
    return kernel[::ORDER]


def _multiply(blocks: Tensor, spectrum: Spectrum) -> Spectrum:
    """Multiply the blocks (n + 1, M, K) with a spectrum."""
    return multiply(blocks[:-1], spectrum[0]), multiply(blocks[-1], spectrum[1])


def _coefficient_gradient(upstream: Spectrum, spectrum: Spectrum, matrix: Tensor) -> Tensor:
    """dL/d(coefficients), (C_out, C_in, K)."""
    # A few orbits after the other: dA is never whole.
    if native.is_built_for(matrix, upstream[0].dtype):
        return _compiled_gradient(upstream, spectrum, matrix)
    out_size, in_size = len(upstream[1]), len(spectrum[1])
    out_fields, in_fields = out_size // ORDER, in_size // ORDER
    total = matrix.new_zeros(out_fields, matrix.shape[1], in_fields)
    block = upstream[1].new_empty(out_size, in_size)
    columns = zip((*upstream[0], upstream[1]), (*spectrum[0], spectrum[1]), strict=True)
    for part, (left, right) in zip(matrix.split(ORDER**2), columns, strict=True):
        torch.mm(left, right.mT, out=block)
        pairs = block.view(out_fields, ORDER**2, in_fields).to(matrix.dtype)
        total.baddbmm_(part.mT.expand(out_fields, -1, -1), pairs)
    return total.mT.contiguous()


def _compiled_gradient(upstream: Spectrum, spectrum: Spectrum, matrix: Tensor) -> Tensor:
    """:func:`_coefficient_gradient` by `native`."""
    out_size, in_size = len(upstream[1]), len(spectrum[1])
    total = matrix.new_zeros(out_size // ORDER, matrix.shape[1], in_size // ORDER)
    block = upstream[1].new_empty(_ORBITS_AT_ONCE, out_size, in_size)
    orbits = len(upstream[0])
    for first in range(0, orbits, _ORBITS_AT_ONCE):
        some = slice(first, min(first + _ORBITS_AT_ONCE, orbits))
        part = block[: some.stop - first]
        multiply(upstream[0][some], spectrum[0][some].mT, out=part)
        native.add_coefficient_gradient(
            total, part, matrix[ORDER**2 * first : ORDER**2 * some.stop]
        )
    multiply(upstream[1], spectrum[1].mT, out=block[0])
    native.add_coefficient_gradient(total, block[:1], matrix[ORDER**2 * orbits :])
    return total.mT.contiguous()


class _SpectralConv(torch.autograd.Function):
    """y = S^T A S x with A = transform_filters(coefficients, matrix), in the dtype ``dtype``."""

    @staticmethod
    def forward(
        ctx: FunctionCtx,
        x: Tensor,
        coefficients: Tensor,
        matrix: Tensor,
        kernel_size: int,
        dtype: torch.dtype,
    ) -> Tensor:
        blocks = transform_filters(coefficients, matrix, dtype=dtype)
        y, spectrum = _apply(x, blocks, kernel_size)
        ctx.save_for_backward(*spectrum, blocks, matrix)
        ctx.kernel_size = kernel_size  # type: ignore[attr-defined]
        return y

    @staticmethod
    @once_differentiable
    def backward(
        ctx: FunctionCtx, grad: Tensor
    ) -> tuple[Tensor | None, Tensor | None, None, None, None]:
        main, zero, blocks, matrix = ctx.saved_tensors  # type: ignore[attr-defined]
        grad = grad.contiguous()
        kernel_size = ctx.kernel_size  # type: ignore[attr-defined]
        upstream = analyse(grad, blocks.dtype, kernel_size=kernel_size, fields_first=True)
        need_x, need_coefficients = ctx.needs_input_grad[:2]  # type: ignore[attr-defined]
        grad_x = grad_coefficients = None
        if need_coefficients:
            grad_coefficients = _coefficient_gradient(upstream, (main, zero), matrix)
        if need_x:
            grad_x = synthesise(_multiply(blocks.mT, upstream), grad, kernel_size=kernel_size)
        return grad_x, grad_coefficients, None, None, None


def _apply(x: Tensor, blocks: Tensor, kernel_size: int) -> tuple[Tensor, Spectrum]:
    """S^T A S x and the spectrum S x."""
    spectrum = analyse(x, blocks.dtype, kernel_size=kernel_size)
    product = _multiply(blocks, spectrum)
    return synthesise(product, x, kernel_size=kernel_size, fields_first=True), spectrum


def transform_matrix(
    map_size: int, kernel_size: int, *, dtype: torch.dtype, device: torch.device | str = "cpu"
) -> Tensor:
    """The matrix from base filters to blocks, for :func:`transform_filters`.

    A layer whose filters are ``weights @ basis`` multiplies it with ``basis`` once and passes its
    weights as the coefficients.

    Args:
        map_size: H of the H x H maps.
        kernel_size: k of the k x k kernel.
        dtype: Of the coefficients.
        device: Of the coefficients.

    Returns:
        Shape (16 * ((N^2 - 1) / 4 + 1), 4 * k^2); columns (j, row, column) of K[0, j].
    """
    return constants(map_size, kernel_size, dtype, torch.device(device)).filters


def transform_filters(
    coefficients: Tensor, matrix: Tensor, *, dtype: torch.dtype | None = None
) -> Tensor:
    """Transform filters to the real blocks that :func:`spectral_product` multiplies with.

    In evaluation mode the result can be kept for as long as the filters do not change; it has
    (N^2 + 3) / k^2 times the memory of the base filters (9x for 3 x 3 on 8 x 8 maps).

    Args:
        coefficients: Shape (C_out, C_in, K): of each pair of fields.
        matrix: Result of :func:`transform_matrix`, or its product with a basis (4 * k^2, K).
        dtype: Of the result; that of ``coefficients`` by default.

    Returns:
        Blocks, shape ((N^2 - 1) / 4 + 1, 4 * C_out, 4 * C_in), w = 0 last; rows (field, s'|e', h),
        columns (s|e, g, field).
    """
    fitting = coefficients.shape[2] == matrix.shape[1] and coefficients.dtype == matrix.dtype
    if (
        fitting
        and coefficients.device == matrix.device
        and native.is_built_for(coefficients, dtype or coefficients.dtype)
    ):
        return native.blocks(coefficients, matrix, dtype or coefficients.dtype)
    (out_fields, in_fields), parts = coefficients.shape[:2], matrix.split(ORDER**2)
    columns = coefficients.mT.contiguous()  # (C_out, K, C_in)
    blocks = columns.new_empty(
        len(parts), out_fields, ORDER**2, in_fields, dtype=dtype or columns.dtype
    )
    rounded = blocks.dtype != columns.dtype
    pairs = columns.new_empty(blocks.shape[1:])
    for part, block in zip(parts, blocks, strict=True):
        # One orbit at a time: if it has to be rounded, it is still in the cache.
        out = pairs if rounded else block
        torch.bmm(part.expand(out_fields, -1, -1), columns, out=out)
        if rounded:
            block.copy_(pairs)
    return blocks.view(len(parts), ORDER * out_fields, ORDER * in_fields)


def spectral_conv_pixel_major(
    x: Tensor, coefficients: Tensor, matrix: Tensor, *, kernel_size: int
) -> Tensor:
    """Convolve pixel-major maps; differentiable once in maps and coefficients.

    Under autocast everything between the sums and differences of the maps runs in the lower
    precision; the result has the dtype of ``x``.

    Args:
        x: Maps, shape (H * H, 4, C_in, B), contiguous, see `to_pixel_major`.
        coefficients: Shape (C_out, C_in, K), see :func:`transform_filters`.
        matrix: See :func:`transform_filters`.
        kernel_size: k of the filters.

    Returns:
        Maps, shape (H * H, 4, C_out, B).
    """
    dtype = product_dtype(x)
    with torch.autocast(x.device.type, enabled=False):
        return _SpectralConv.apply(x, coefficients, matrix, kernel_size, dtype)


def spectral_product(x: Tensor, blocks: Tensor, *, kernel_size: int) -> Tensor:
    """Convolve pixel-major maps with transformed filters that are kept; not differentiable.

    Args:
        x: Maps, shape (H * H, 4, C_in, B), contiguous.
        blocks: Result of :func:`transform_filters` for this H; the products run in its dtype.
        kernel_size: k of the filters that ``blocks`` was made from.

    Returns:
        Maps, shape (H * H, 4, C_out, B), in the dtype of ``x``.

    Raises:
        ValueError: if the blocks are those of another map or kernel size.
    """
    count = (padded_size(math.isqrt(len(x)), kernel_size) ** 2 + 3) // 4
    if blocks.shape[0] != count or blocks.shape[2] != ORDER * x.shape[2]:
        raise ValueError(
            f"The blocks {tuple(blocks.shape)} do not fit maps {tuple(x.shape)} and a "
            f"{kernel_size}x{kernel_size} kernel, which take ({count}, *, {ORDER * x.shape[2]}): "
            "call transform_filters with the transform_matrix of this map size."
        )
    with torch.no_grad(), torch.autocast(x.device.type, enabled=False):
        return _apply(x, blocks, kernel_size)[0]


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
    matrix = transform_matrix(x.shape[2], base.shape[-1], dtype=base.dtype, device=base.device)
    coefficients = base.reshape(len(base), base.shape[1] // ORDER, matrix.shape[1])
    y = spectral_conv_pixel_major(
        to_pixel_major(x), coefficients, matrix, kernel_size=base.shape[-1]
    )
    return from_pixel_major(y)


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
    if kernel.ndim != 4 or kernel.shape[0] % ORDER:
        raise ValueError(
            f"Expected an expanded kernel (C_out * 4, C_in * 4, k, k), got {tuple(kernel.shape)}; "
            "base filters go to spectral_conv2d_base."
        )
    return spectral_conv2d_base(x, base_filters(kernel))


def product_dtype(x: Tensor) -> torch.dtype:
    """What the products run in: the autocast dtype under autocast, double precision excepted."""
    if torch.is_autocast_enabled(x.device.type) and x.dtype != torch.float64:
        return torch.get_autocast_dtype(x.device.type)
    return x.dtype


def _check(x: Tensor, channels: int, kernel_size: int) -> None:
    """Raise a ValueError that names the shapes unless the convolution is supported."""
    if x.ndim != 4 or x.shape[2] != x.shape[3] or x.shape[1] != channels or channels % ORDER:
        raise ValueError(
            f"Expected square maps (B, {channels}, H, H) for filters with {channels} input "
            f"channels (a multiple of {ORDER}), got {tuple(x.shape)}."
        )
    if not is_supported(x.shape[2], kernel_size):
        raise ValueError(
            f"No spectral form for a {kernel_size}x{kernel_size} kernel on a {x.shape[2]}x"
            f"{x.shape[2]} map: allowed are odd kernels not larger than the map and maps of 2 to "
            f"{MAX_MAP_SIZE} cells. Use torch.nn.functional.conv2d."
        )
