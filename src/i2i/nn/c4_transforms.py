"""Analysis and synthesis of the C4-spectral convolution: maps to spectra and back.

The mathematics is in `c4_spectral`. Where a compiler was found when i2i was installed, the loops of
`native` do it in one pass; the torch form here computes the same for every map size, type and
device.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from i2i.nn import native
from i2i.nn.c4_spectral_constants import ORDER, Constants, constants

# Of fields x images: all non-zero orbits (n, 4 C, 4 B), columns (Re, Im at R w; Re, Im at w), and
# w = 0 (4 C, B). What goes into the blocks has rows (sum|difference, slot, field), what comes out
# (field, sum|difference, slot): so the blocks are written in order, see transform_filters.
Spectrum = tuple[Tensor, Tensor]


def analyse(
    x: Tensor, dtype: torch.dtype, *, kernel_size: int, fields_first: bool = False
) -> Spectrum:
    """Apply S to maps (H^2, 4, C, B), in ``dtype``."""
    if _is_native(x, dtype, kernel_size):
        return native.analyse(x, dtype, kernel_size=kernel_size, fields_first=fields_first)
    matrices = constants(math.isqrt(len(x)), kernel_size, dtype, x.device)
    return _analyse(x, matrices, dtype, fields_first=fields_first)


def synthesise(
    spectrum: Spectrum, like: Tensor, *, kernel_size: int, fields_first: bool = False
) -> Tensor:
    """Apply S^T: a spectrum to maps (H^2, 4, C, B), in the type and batch size of ``like``."""
    dtype = spectrum[0].dtype
    if _is_native(like, dtype, kernel_size):
        fields = spectrum[1].shape[0] // ORDER
        maps = like.new_empty(like.shape[0], ORDER, fields, like.shape[3])
        return native.synthesise(
            *spectrum, maps, kernel_size=kernel_size, fields_first=fields_first
        )
    matrices = constants(math.isqrt(len(like)), kernel_size, dtype, like.device)
    return _synthesise(spectrum, matrices, like, fields_first=fields_first)


def _is_native(maps: Tensor, dtype: torch.dtype, kernel_size: int) -> bool:
    map_size = math.isqrt(len(maps))
    return (
        maps.shape[:2] == (map_size**2, ORDER)
        and native.is_built_for(maps, dtype)
        and native.has_compiled_transform(map_size, kernel_size)
    )


def _turns(half: int, slot: int) -> tuple[tuple[int, int, float], tuple[int, int, float]]:
    """(turn, g, sign): what a slot of the spectrum holds at R w and at w.

    At R w the fields are numbered one further: slot 0 holds g = 1, and slot 1 holds g = 2, which
    is g = 0 again, with the opposite sign for differences.
    """
    return (1, 1 - slot, -1.0 if half and slot else 1.0), (0, slot, 1.0)


def _part(spectrum: Spectrum, half: int, slot: int, *, fields_first: bool) -> Spectrum:
    """Views of one slot of a spectrum: (n, C, 4, B) and (C, B)."""
    fields = spectrum[1].shape[0] // ORDER
    batch = spectrum[1].shape[1]
    if fields_first:
        main = spectrum[0].view(-1, fields, 2, 2, ORDER, batch)[:, :, half, slot]
        return main, spectrum[1].view(fields, 2, 2, batch)[:, half, slot]
    main = spectrum[0].view(-1, 2, 2, fields, ORDER, batch)[:, half, slot]
    return main, spectrum[1].view(2, 2, fields, batch)[half, slot]


def _analyse(
    x: Tensor, matrices: Constants, dtype: torch.dtype, *, fields_first: bool = False
) -> Spectrum:
    """Apply S to maps (H^2, 4, C, B), in ``dtype``."""
    pixels, _, fields, batch = x.shape
    halves = x.view(pixels, 2, 2, fields * batch)
    mixed = x.new_empty(pixels, 2, 2, fields * batch, dtype=dtype)
    torch.add(halves[:, 0], halves[:, 1], out=mixed[:, 0])
    torch.sub(halves[:, 0], halves[:, 1], out=mixed[:, 1])
    orbits = matrices.orbits
    spectrum = (
        mixed.new_empty(orbits, ORDER * fields, ORDER * batch),
        mixed.new_empty(ORDER * fields, batch),
    )
    rows = mixed.new_empty(ORDER * orbits + 1, fields * batch)
    parts = {1: rows[: 2 * orbits], 0: rows[2 * orbits :]}
    for half in range(2):
        for slot in range(2):
            for turn, g, sign in _turns(half, slot):
                torch.mm(sign * matrices.analysis[half][turn], mixed[:, half, g], out=parts[turn])
            main, zero = _part(spectrum, half, slot, fields_first=fields_first)
            main.copy_(rows[:-1].view(ORDER, orbits, fields, batch).permute(1, 2, 0, 3))
            zero.copy_(rows[-1].view(fields, batch))
    return spectrum


def _synthesise(
    spectrum: Spectrum, matrices: Constants, like: Tensor, *, fields_first: bool = False
) -> Tensor:
    """Apply S^T: a spectrum to maps (H^2, 4, C, B) in the dtype and batch size of ``like``."""
    pixels, batch = like.shape[0], like.shape[3]
    orbits, fields = matrices.orbits, spectrum[1].shape[0] // ORDER
    mixed = spectrum[0].new_empty(pixels, 2, 2, fields * batch)
    rows = mixed.new_empty(ORDER * orbits + 1, fields * batch)
    parts = {1: rows[: 2 * orbits], 0: rows[2 * orbits :]}
    for half in range(2):
        for slot in range(2):
            main, zero = _part(spectrum, half, slot, fields_first=fields_first)
            rows[:-1].view(ORDER, orbits, fields, batch).copy_(main.permute(2, 0, 1, 3))
            rows[-1].view(fields, batch).copy_(zero)
            for turn, g, sign in _turns(half, slot):
                matrix, sums = matrices.analysis[half][turn].mT, mixed[:, half, g]
                # The first slot writes both parities, the second adds to both.
                if slot == 0:
                    torch.mm(sign * matrix, parts[turn], out=sums)
                else:
                    sums.addmm_(matrix, parts[turn], alpha=sign)
    y = like.new_empty(pixels, 2, 2, fields * batch)
    torch.add(mixed[:, 0], mixed[:, 1], out=y[:, 0])
    torch.sub(mixed[:, 0], mixed[:, 1], out=y[:, 1])
    return y.view(pixels, ORDER, fields, batch)
