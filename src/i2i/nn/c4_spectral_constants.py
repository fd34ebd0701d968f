"""The constant matrices of the C4-spectral convolution, see `c4_spectral` for what they are."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

import torch
from torch import Tensor

ORDER = 4  # of the group
MAX_MAP_SIZE = 17  # the transform is a dense N^2 x H^2 matrix: pointless beyond such maps


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
        and 2 <= map_size <= MAX_MAP_SIZE
    )


def padded_size(map_size: int, kernel_size: int) -> int:
    """Return N, the smallest odd length that keeps a k x k kernel from wrapping round."""
    length = map_size + kernel_size // 2
    return length if length % 2 == 1 else length + 1


@dataclass(frozen=True)
class Constants:
    """Constant matrices for one map size and kernel size.

    Attributes:
        orbits: Number n of orbits of non-zero frequencies.
        analysis: ``analysis[half][turn]``, shapes (2 n + 1, H^2) for turn 0 and (2 n, H^2) for
            turn 1: the transform of the sums (half 0) or differences at w and at R w. Rows: real
            parts of the orbits, w = 0 (turn 0 only), imaginary parts.
        filters: Shape ((n + 1) * 16, 4 * k^2): from the base filters (j, tap) of a field pair to
            its real blocks (orbit, s'|e', h, s|e, g), w = 0 last.
    """

    orbits: int
    analysis: tuple[tuple[Tensor, Tensor], tuple[Tensor, Tensor]]
    filters: Tensor


@functools.lru_cache(maxsize=64)
@torch.inference_mode(mode=False)  # kept for later training steps, whoever asks first
def constants(
    map_size: int, kernel_size: int, dtype: torch.dtype, device: torch.device
) -> Constants:
    """Build the constant matrices in float64 and cast them."""
    size = padded_size(map_size, kernel_size)
    orbits = orbit_representatives(size)
    omega = torch.tensor([*orbits, (0, 0)], dtype=torch.float64) * (2.0 * math.pi / size)
    analysis = tuple(
        tuple(part.to(device, dtype) for part in half)
        for half in _analysis(omega, map_size, 1.0 / size)
    )
    filters = _filters(omega, kernel_size).to(device, dtype)
    return Constants(len(orbits), analysis, filters)  # type: ignore[arg-type]


def orbit_representatives(size: int) -> list[tuple[int, int]]:
    """One frequency of each {w, Rw, -w, -Rw}, w non-zero on the N x N torus, from -N/2 to N/2."""
    found: list[tuple[int, int]] = []
    seen = {(0, 0)}
    middle = size // 2
    for a in range(size):
        for b in range(size):
            if (a, b) not in seen:
                found.append((a - size if a > middle else a, b - size if b > middle else b))
                for _ in range(ORDER):
                    seen.add((a, b))
                    a, b = -b % size, a
    return found


def _turn(vectors: Tensor) -> Tensor:
    """R(row, column) = (-column, row) of the rows of ``vectors``."""
    return torch.stack([-vectors[:, 1], vectors[:, 0]], dim=1)


def _analysis(omega: Tensor, map_size: int, scale: float) -> list[list[Tensor]]:
    """``Constants.analysis`` in float64; the last row of ``omega`` is zero."""
    # Counted from the middle of the map: any origin does, and this one halves `native`'s work.
    cells = torch.arange(map_size, dtype=torch.float64) - (map_size - 1) / 2
    cells = torch.cartesian_prod(cells, cells)
    halves: list[list[Tensor]] = [[], []]
    for turn, frequencies in enumerate((omega, _turn(omega[:-1]))):
        # X(w) = sum_p x(p) exp(-i w.p); 1/sqrt(2) per sum or difference; sqrt(2) for the pairs.
        phase = frequencies @ cells.T
        real, imaginary = phase.cos() * scale, -phase.sin() * scale
        zero = real[-1:] / math.sqrt(2.0) if turn == 0 else real[:0]
        if turn == 0:
            real, imaginary = real[:-1], imaginary[:-1]
        halves[0].append(torch.cat([real, imaginary, zero]))  # s = (Re, Im)
        halves[1].append(torch.cat([imaginary, -real, zero]))  # e = -i d = (Im, -Re)
    return halves


def _filters(omega: Tensor, kernel_size: int) -> Tensor:
    """``Constants.filters`` in float64."""
    offset = torch.arange(kernel_size, dtype=torch.float64) - kernel_size // 2
    tap = torch.cartesian_prod(offset, offset)  # (k^2, 2), (row, column)
    filters = omega.new_zeros(len(omega), 2, 2, 2, 2, ORDER, len(tap))
    for h in range(2):  # A_{h,g}(w) = sum_t K_{0,g-h}(t) exp(i w . R^h t)
        angle = omega @ tap.T  # (orbits + 1, k^2)
        for g in range(2):
            for j, sign in (((g - h) % ORDER, 1.0), ((g + 2 - h) % ORDER, -1.0)):
                filters[:, 0, h, 0, g, j] = angle.cos()  # Re P
                filters[:, 0, h, 1, g, j] = -sign * angle.sin()  # -Im M
                filters[:, 1, h, 0, g, j] = angle.sin()  # Im P
                filters[:, 1, h, 1, g, j] = sign * angle.cos()  # Re M
        tap = _turn(tap)
    return filters.view(-1, ORDER * len(tap))
