"""What the C4 network spends its time with, as compiled code, where a compiler was found.

`hatch_build.py` builds the sources beside this file when i2i is installed, once for each set of
instructions. Without a library for this processor, on other map sizes and on other devices
:func:`is_built_for` and :func:`has_compiled_transform` say so, and the callers compute the same
with torch: transforms and blocks (`c4_spectral`), layouts and the largest turn (`pixel_major`),
batch norm (`c4_norm`) and, in `native.stem`, the first layer (`c4_stem`).
"""

from __future__ import annotations

import contextlib
import ctypes
import functools
import hashlib
import math
from collections.abc import Iterator
from pathlib import Path

import torch
from torch import Tensor

from i2i.nn.c4_spectral_constants import ORDER, orbit_representatives, padded_size

_TYPES = {
    (torch.float32, torch.float32): 0,
    (torch.float32, torch.bfloat16): 1,
    (torch.float64, torch.float64): 2,
}  # of maps and spectrum, of coefficients and blocks
_MAP_SIZES = {(4, 5), (5, 7), (8, 9), (9, 11), (16, 17), (17, 19)}  # H and N that are built
_ENABLED = [True]


@functools.cache
def library() -> ctypes.CDLL | None:
    """The library for this processor that was made from the sources as they are, or None."""
    folder = Path(__file__).parent
    sources = sorted([*folder.glob("*.cpp"), *folder.glob("*.h")])
    digest = hashlib.sha256(b"".join(path.read_bytes() for path in sources)).hexdigest()[:12]
    for name in (torch.backends.cpu.get_cpu_capability().lower(), "default"):
        path = folder / f"c4_spectral_{name}_{digest}.so"
        if path.exists():
            with contextlib.suppress(OSError):
                return ctypes.CDLL(str(path))
    return None


def functions() -> ctypes.CDLL:
    """The library, which has to be there: ask :func:`is_built_for` first."""
    found = library()
    assert found is not None, "no library for this processor: ask is_built_for first"
    return found


@contextlib.contextmanager
def torch_only() -> Iterator[None]:
    """Leave the library aside for a while, for comparisons.

    Example:
        >>> with torch_only():
        ...     pass
    """
    before = _ENABLED[0]
    _ENABLED[0] = False
    try:
        yield
    finally:
        _ENABLED[0] = before


def is_traced() -> bool:
    """Whether a compiler, a tracer or a transform of `torch.func` is watching."""
    if torch.compiler.is_compiling() or torch.jit.is_tracing():
        return True
    return bool(torch._C._are_functorch_transforms_active())  # torch has no public question


def is_built_for(tensor: Tensor, dtype: torch.dtype) -> bool:
    """Whether the library takes maps or coefficients to spectra or blocks of `dtype`.

    Not what a tracer or compiler watches: it would not see what is written.
    """
    return (
        not is_traced()  # first: what follows would make a traced size a constant
        and _ENABLED[0]
        and tensor.device.type == "cpu"
        and (tensor.dtype, dtype) in _TYPES
        and tensor.numel() > 0
        and not tensor.is_neg()  # numbers whose sign is still to be turned, as `z.conj().imag`
        and type(tensor) in (Tensor, torch.nn.Parameter)
        and library() is not None
    )


def has_compiled_transform(map_size: int, kernel_size: int = 3) -> bool:
    """Whether maps of this size are transformed by the library."""
    size = padded_size(map_size, kernel_size)
    return _ENABLED[0] and (map_size, size) in _MAP_SIZES and library() is not None


@functools.lru_cache(maxsize=16)
@torch.inference_mode(mode=False)
def _tables(map_size: int, size: int, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
    """Frequencies (n, 2, 4), int32: |a|, |b| and their signs at w and R w; waves (2, M + 1, h)."""
    middle = size // 2
    frequencies = []
    for a, b in orbit_representatives(size):
        for w in ((a, b), (-b, a)):
            frequencies.append([abs(part) for part in w] + [1 if part >= 0 else -1 for part in w])
    half = (map_size + 1) // 2
    distance = torch.arange(half, dtype=torch.float64, device="cpu") + (0.5 - 0.5 * (map_size % 2))
    angle = torch.arange(middle + 1, dtype=torch.float64, device="cpu")[:, None] * distance
    angle = angle * (2 * math.pi / size)
    waves = torch.stack([angle.cos(), angle.sin()]) / math.sqrt(size)
    table = torch.tensor(frequencies, dtype=torch.int32, device="cpu").view(-1, 2, 4)
    return table.contiguous(), waves.to(dtype).contiguous()


def analyse(
    maps: Tensor, dtype: torch.dtype, *, kernel_size: int, fields_first: bool
) -> tuple[Tensor, Tensor]:
    """Transform pixel-major maps (H * H, 4, C, B); only where they are built.

    Returns:
        The spectrum as in `c4_spectral`: (n, 4 C, 4 B) and (4 C, B), in ``dtype``.
    """
    maps = maps.contiguous()
    pixels, _, fields, batch = maps.shape
    orbits = (padded_size(math.isqrt(pixels), kernel_size) ** 2 - 1) // ORDER
    main = maps.new_empty(orbits, ORDER * fields, ORDER * batch, dtype=dtype)
    zero = maps.new_empty(ORDER * fields, batch, dtype=dtype)
    _transform_call("i2i_analyse", (maps, main, zero), maps, dtype, kernel_size, fields_first)
    return main, zero


def synthesise(
    main: Tensor, zero: Tensor, maps: Tensor, *, kernel_size: int, fields_first: bool
) -> Tensor:
    """Transform a spectrum back, into ``maps`` (H * H, 4, C, B), contiguous."""
    arrays = (main.contiguous(), zero.contiguous(), maps)
    _transform_call("i2i_synthesise", arrays, maps, main.dtype, kernel_size, fields_first)
    return maps


def turn_over(maps: Tensor, *, to_pixel_major: bool) -> Tensor:
    """(B, 4 C, P) to (P, 4, C, B), or back; float32 or float64 where :func:`is_built_for`."""
    maps = maps.contiguous()
    rows, columns = maps.shape[0], maps.shape[-1]
    fields = maps.shape[1] // ORDER if to_pixel_major else maps.shape[2]
    shape = (columns, ORDER, fields, rows) if to_pixel_major else (columns, fields * ORDER, rows)
    result = maps.new_empty(shape)
    functions().i2i_turn_over(
        pointer(maps),
        pointer(result),
        int(to_pixel_major),
        int(maps.dtype == torch.float64),
        ctypes.c_int64(rows),
        ctypes.c_int64(fields),
        ctypes.c_int64(columns),
        torch.get_num_threads(),
    )
    return result


def turn_max_backward(maps: Tensor, grad: Tensor) -> Tensor:
    """Gradient of the maximum over turns: (P, 4, C, B), float32 or float64, and (P, C, B)."""
    maps, grad = in_order(maps), in_order(grad.to(maps.dtype))
    result = torch.empty_like(maps)
    functions().i2i_turn_max_backward(
        *map(pointer, (maps, grad, result)),
        int(maps.dtype == torch.float64),
        ctypes.c_int64(len(maps)),
        ctypes.c_int64(grad[0].numel()),
        torch.get_num_threads(),
    )
    return result


def blocks(coefficients: Tensor, matrix: Tensor, dtype: torch.dtype) -> Tensor:
    """Make the blocks, see `c4_spectral.transform_filters`; only where :func:`is_built_for`."""
    out_fields, in_fields, _ = coefficients.shape
    orbits = len(matrix) // ORDER**2
    result = coefficients.new_empty(orbits, ORDER * out_fields, ORDER * in_fields, dtype=dtype)
    columns = coefficients.mT.contiguous()  # (C_out, K, C_in)
    _filters_call("i2i_blocks", columns, matrix, result, columns, result)
    return result


def add_coefficient_gradient(total: Tensor, upstream: Tensor, matrix: Tensor) -> None:
    """Add dL/d(coefficients) to ``total`` (C_out, K, C_in).

    Args:
        total: In the dtype of ``matrix``, contiguous.
        upstream: dL/d(blocks) of some orbits (m, 4 C_out, 4 C_in).
        matrix: Their rows of the transform matrix (16 m, K).
    """
    upstream = upstream.contiguous()
    _filters_call("i2i_coefficient_gradient", upstream, matrix, total, total, upstream)


def _filters_call(
    name: str, source: Tensor, matrix: Tensor, target: Tensor, columns: Tensor, blocks: Tensor
) -> None:
    """From ``source`` to ``target``: columns (C_out, K, C_in) and blocks, or the reverse."""
    out_fields, count, in_fields = columns.shape
    entries = matrix.view(-1, ORDER**2, matrix.shape[1]).mT.contiguous()  # (m, K, 16)
    getattr(functions(), name)(
        *map(pointer, (source, entries, target)),
        _TYPES[columns.dtype, blocks.dtype],
        ctypes.c_int64(len(entries)),
        ctypes.c_int64(out_fields),
        ctypes.c_int64(in_fields),
        ctypes.c_int64(count),
        torch.get_num_threads(),
    )


def _transform_call(
    name: str,
    arrays: tuple[Tensor, Tensor, Tensor],
    maps: Tensor,
    dtype: torch.dtype,
    kernel_size: int,
    fields_first: bool,
) -> None:
    pixels, _, fields, batch = maps.shape
    map_size = math.isqrt(pixels)
    size = padded_size(map_size, kernel_size)
    frequencies, waves = _tables(map_size, size, maps.dtype)
    status = getattr(functions(), name)(
        *map(pointer, arrays),
        map_size,
        size,
        _TYPES[maps.dtype, dtype],
        ctypes.c_int64(len(frequencies)),
        ctypes.c_int64(fields),
        ctypes.c_int64(batch),
        int(fields_first),
        pointer(frequencies),
        pointer(waves),
        torch.get_num_threads(),
    )
    if status:
        raise RuntimeError(f"{name} is not built for {map_size} x {map_size} maps")


def norm(
    x: Tensor,
    shortcut: Tensor | None,
    weight: Tensor,
    bias: Tensor,
    moments: Tensor,
    *,
    eps: float,
    relu: bool,
    fresh: bool,
) -> Tensor:
    """Normalise pixel-major maps (..., F, B), add ``shortcut`` and clip.

    Args:
        x: Maps whose types :func:`is_built_for` takes.
        shortcut: Maps of the same shape, or None.
        weight: (F,), like ``bias`` in the dtype of ``x``.
        bias: (F,).
        moments: Mean and biased variance, (2, F), float64.
        eps: Added to the variance.
        relu: Whether to clip.
        fresh: Take the moments of ``x``, and write them to ``moments``.
    """
    x, weight, bias = in_order(x), in_order(weight), in_order(bias)
    shortcut = None if shortcut is None else in_order(shortcut)
    y = torch.empty_like(x)
    functions().i2i_norm(
        *map(pointer, (x, shortcut, weight, bias, *moments, y)),
        ctypes.c_double(eps),
        int(relu),
        int(fresh),
        *_rows(x),
    )
    return y


def norm_moments(x: Tensor) -> Tensor:
    """Mean and biased variance of the fields of pixel-major maps (..., F, B): (2, F), float64."""
    x = x.contiguous()
    moments = x.new_empty(2, x.shape[-2], dtype=torch.float64)
    nothing = (None, None, None)
    functions().i2i_norm(
        *map(pointer, (x, *nothing, *moments, None)), ctypes.c_double(0), 0, 1, *_rows(x)
    )
    return moments


def norm_backward(
    grad: Tensor,
    clipped: Tensor | None,
    x: Tensor,
    weight: Tensor,
    moments: Tensor,
    *,
    eps: float,
    wants: tuple[bool, bool],
    given: tuple[Tensor, float] | None = None,
) -> tuple[Tensor | None, Tensor | None, Tensor]:
    """Gradient of :func:`norm` of the batch's own moments.

    Args:
        grad: Upstream, (..., F, B).
        clipped: What :func:`norm` gave, where it clipped.
        x: What it was given.
        weight: (F,).
        moments: Those of the batch, (2, F).
        eps: Added to the variance.
        wants: Whether the gradients of x and of the shortcut are wanted.
        given: The sums below and how many numbers of a field they are of, where processes share
            a batch; otherwise they are taken here.

    Returns:
        The gradients, and the sums over each field of the gradient before the clipping and of
        its product with x - mean, (2, F), float64: the gradient of the bias, and of the weight
        times the standard deviation.
    """
    fields = x.shape[-2]
    sums, count = given or (moments.new_empty(2, fields), x.numel() / fields)
    of_x, of_shortcut = (torch.empty_like(x) if wanted else None for wanted in wants)
    arrays = (in_order(grad), clipped, x, in_order(weight), *moments, sums)
    functions().i2i_norm_backward(
        *map(pointer, (*arrays, of_x, of_shortcut)),
        ctypes.c_double(eps),
        ctypes.c_double(count),
        int(given is None),
        *_rows(x),
    )
    return of_x, of_shortcut, sums


def in_order(tensor: Tensor) -> Tensor:
    """Itself, or a copy: contiguous, its numbers in memory as they are (no sign left to turn)."""
    return tensor.resolve_neg().contiguous()


def pointer(tensor: Tensor | None) -> ctypes.c_void_p:
    """Of a tensor's first number, for a call of the library; None gives the null pointer."""
    return ctypes.c_void_p(None if tensor is None else tensor.data_ptr())


def _rows(x: Tensor) -> tuple[object, ...]:
    """The last arguments of the norm's functions for maps (..., F, B)."""
    sizes = (math.prod(x.shape[:-2]), *x.shape[-2:])
    return int(x.dtype == torch.float64), *map(ctypes.c_int64, sizes), torch.get_num_threads()
