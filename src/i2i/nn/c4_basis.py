"""Bases of C4-steerable kernels that need no escnn: all of them, and clean copies of escnn's."""

import math

import torch
from torch import Tensor

TURNS = 4


def full_basis(in_kind: str, out_kind: str, kernel_size: int) -> Tensor:
    """All kernels that commute with quarter turns, one free weight per cell: (K, out, in, S).

    `kernel[s, j] = rot90^s(kernel[0, j − s])`: the filters of a plain group convolution.
    """
    cells = kernel_size**2
    deltas = torch.eye(cells).view(cells, kernel_size, kernel_size)
    out_turns = TURNS if out_kind == "regular" else 1
    in_turns = TURNS if in_kind == "regular" else 1
    basis = torch.zeros(in_turns, cells, out_turns, in_turns, cells)
    for shift in range(in_turns):
        for turn in range(out_turns):
            turned = torch.rot90(deltas, turn, dims=(1, 2)).reshape(cells, cells)
            basis[shift, :, turn, (shift + turn) % in_turns] = turned
    return basis.flatten(0, 1)


def symmetrise(basis: Tensor, in_kind: str, out_kind: str) -> Tensor:
    """The kernels (K, out, in, S) without rounding noise: entries that a turn relates become equal.

    escnn samples its harmonics in float32; left as they are, a network in float64 would be
    equivariant to 1e-7 only.
    """
    orbits = full_basis(in_kind, out_kind, math.isqrt(basis.shape[-1])).flatten(1).double()
    means = basis.detach().flatten(1).double() @ orbits.T / orbits.sum(dim=1)
    return (means @ orbits).view(basis.shape).to(basis.dtype)
