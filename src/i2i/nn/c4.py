"""C4-equivariant layers on plain tensors: everything of the project that touches escnn.

A *regular field* is four channels, one for each quarter turn; F fields are a tensor (B, 4F, H, W)
whose channel index is `4 * field + turn`. A *trivial field* is one channel. escnn gives the spaces
of steerable kernels; the layers here own their weights, their initialisation and their kernel
cache, so that a state dict holds parameters only and means the same in training and in evaluation
mode.
"""

import math
import warnings
from collections.abc import Mapping
from functools import lru_cache
from typing import Any

import torch
from torch import Tensor, nn

from i2i.nn.c4_spectral import is_supported, prefers_spectral, spectral_conv2d
from i2i.nn.precision import full_precision

with warnings.catch_warnings():
    # escnn warns that py3nj (a Fortran package for SO(3)) is missing; C4 has no use for it.
    warnings.filterwarnings("ignore", message=".*py3nj.*", category=UserWarning)
    from escnn import gspaces
    from escnn.nn import FieldType, R2Conv

TURNS = 4
BASES = ("band_limited", "full")

# Kernels of even size have no centre cell: rings at the radii of the four inner and of the twelve
# outer cells, with the highest harmonics that the first resolves.
_EVEN_RINGS = {"rings": [math.sqrt(0.5), 1.9], "sigma": [0.4, 0.4]}


def _even_cutoff(radius: float) -> float:
    return 1.0 if radius < 1.0 else 2.0


@lru_cache(maxsize=1)
def _c4_plane() -> Any:  # noqa: ANN401 - escnn has no stubs
    return gspaces.rot2dOnR2(TURNS)


def trivial_type(num_fields: int) -> FieldType:
    """The type of `num_fields` ordinary channels that do not change when the image turns."""
    return FieldType(_c4_plane(), [_c4_plane().trivial_repr] * num_fields)


def regular_type(num_fields: int) -> FieldType:
    """The type of `num_fields` groups of four channels that shift when the image turns."""
    return FieldType(_c4_plane(), [_c4_plane().regular_repr] * num_fields)


def _describe(field_type: FieldType) -> tuple[str, int]:
    """`("trivial" | "regular", number of fields)` of a type whose fields are all alike."""
    plane = _c4_plane()
    kinds = {representation.name for representation in field_type.representations}
    for kind, representation in (("trivial", plane.trivial_repr), ("regular", plane.regular_repr)):
        if field_type.gspace == plane and kinds == {representation.name}:
            return kind, len(field_type)
    raise ValueError(
        f"C4Conv takes fields of one kind, trivial_type(n) or regular_type(n), not {field_type}"
    )


def _build_type(description: tuple[str, int]) -> FieldType:
    kind, num_fields = description
    return trivial_type(num_fields) if kind == "trivial" else regular_type(num_fields)


def _full_basis(in_kind: str, out_kind: str, kernel_size: int) -> Tensor:
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


def _symmetrise(basis: Tensor, in_kind: str, out_kind: str) -> Tensor:
    """The kernels (K, out, in, S) without rounding noise: entries that a turn relates become equal.

    escnn samples its harmonics in float32; left as they are, a network in float64 would be
    equivariant to 1e-7 only.
    """
    orbits = _full_basis(in_kind, out_kind, math.isqrt(basis.shape[-1])).flatten(1).double()
    means = basis.detach().flatten(1).double() @ orbits.T / orbits.sum(dim=1)
    return (means @ orbits).view(basis.shape).to(basis.dtype)


class C4Conv(R2Conv):
    """A convolution between C4 fields, on plain tensors.

    Differences from `escnn.nn.R2Conv`: construction takes milliseconds (the variance of the weights
    follows from the basis); the state dict is `weights` and `bias` whatever the mode, and loading
    also accepts escnn's own dicts (`basis="band_limited"`); the sampled basis belongs to this layer
    alone; in evaluation mode the expanded kernel is cached and checked against the weights, so that
    it can never be stale.

    Args:
        in_type: Input fields, `trivial_type(n)` or `regular_type(n)`.
        out_type: Output fields.
        kernel_size: Side of the square kernel; even sizes sample half-way between cells.
        stride: Step in both directions.
        padding: Zeros on each side.
        bias: One number per output field.
        basis: `"band_limited"` (escnn's smooth rings: 24 weights per 3×3 pair of regular fields) or
            `"full"` (every cell free: 36).

    Shape:
        (B, in_type.size, H, W) -> (B, out_type.size, H', W').

    Raises:
        ValueError: If the fields are mixed or the basis is unknown.

    Example:
        >>> conv = C4Conv(trivial_type(1), regular_type(8), 5, padding=2)
        >>> conv(torch.zeros(2, 1, 9, 9)).shape
        torch.Size([2, 32, 9, 9])
    """

    kernel_basis: Tensor
    bias_scale: Tensor
    in_type: FieldType
    out_type: FieldType

    def __init__(
        self,
        in_type: FieldType,
        out_type: FieldType,
        kernel_size: int,
        *,
        stride: int = 1,
        padding: int = 0,
        bias: bool = True,
        basis: str = "band_limited",
    ) -> None:
        if basis not in BASES:
            raise ValueError(f"basis={basis!r} is not known: choose one of {', '.join(BASES)}")
        (in_kind, in_fields), (out_kind, out_fields) = _describe(in_type), _describe(out_type)
        rings: dict[str, Any] = {}
        if kernel_size % 2 == 0:
            rings = {**_EVEN_RINGS, "frequencies_cutoff": _even_cutoff}
        super().__init__(
            in_type,
            out_type,
            kernel_size,
            stride=stride,
            padding=padding,
            bias=bias,
            initialize=False,
            **rings,
        )
        if basis == "full":
            kernel_basis = _full_basis(in_kind, out_kind, kernel_size)
        else:
            # escnn hands the same tensor to every layer: a copy keeps `.double()` or `.cuda()` of
            # one network from changing another.
            kernel_basis = _symmetrise(next(self._basisexpansion.buffers()), in_kind, out_kind)
        bias_column = (
            self.bias_expansion[: out_type.size // out_fields, 0].clone() if bias else None
        )
        self._strip_escnn_state()
        self.basis = basis
        self.in_fields, self.out_fields = in_fields, out_fields
        self.is_regular = in_kind == out_kind == "regular"
        self.register_buffer("kernel_basis", kernel_basis, persistent=False)
        self.register_buffer("bias_scale", bias_column, persistent=False)
        self.weights = nn.Parameter(torch.empty(out_fields * in_fields * kernel_basis.shape[0]))
        self._cache: tuple[Tensor, Tensor] | None = None
        self.reset_parameters()

    def _strip_escnn_state(self) -> None:
        """Drop what escnn keeps beside the parameters: it changes with the mode and is shared."""
        for name in ("filter", "expanded_bias", "bias_expansion", "_basisexpansion"):
            if hasattr(self, name):
                delattr(self, name)
        self.expanded_bias = None  # escnn's own spelling of "none" for layers without a bias

    def reset_parameters(self) -> None:
        """He initialisation: the squared kernel of one output channel sums to 2 in expectation."""
        energy = self.kernel_basis.double().pow(2).sum().item() / self.kernel_basis.shape[1]
        nn.init.normal_(self.weights, std=math.sqrt(2.0 / (self.in_fields * energy)))
        if self.bias is not None:
            nn.init.zeros_(self.bias)

    def expand_parameters(self) -> tuple[Tensor, Tensor | None]:
        """The dense kernel (out, in, k, k) and bias (out,) that the weights stand for."""
        num_basis, out_size, in_size, cells = self.kernel_basis.shape
        # Expanded in full precision: under autocast only the convolution itself is rounded.
        with full_precision(self.weights):
            kernel = self.weights.view(-1, num_basis) @ self.kernel_basis.flatten(1)
        kernel = kernel.view(self.out_fields, self.in_fields, out_size, in_size, cells)
        kernel = kernel.transpose(1, 2).reshape(
            self.out_fields * out_size, self.in_fields * in_size, self.kernel_size, self.kernel_size
        )
        if self.bias is None:
            return kernel, None
        return kernel, (self.bias[:, None] * self.bias_scale).flatten()

    def _kernel(self) -> Tensor:
        """The expanded kernel, from the cache where that is safe."""
        weights = self.weights
        needs_grad = torch.is_grad_enabled() and weights.requires_grad
        # On a GPU comparing would wait for the device and expanding is cheap: no cache there.
        if self.training or needs_grad or weights.device.type != "cpu" or _is_traced():
            self._cache = None
            return self.expand_parameters()[0]
        # Compared by value: an optimiser, an average or `weights.data.copy_()` that goes around
        # every version counter is seen as well.
        if self._cache is None or not _same(self._cache[0], weights):
            with torch.inference_mode(mode=False), torch.no_grad():
                snapshot = weights.detach().clone()
                self._cache = (snapshot, self.expand_parameters()[0])
        return self._cache[1]

    def _convolve(self, x: Tensor, kernel: Tensor) -> Tensor:
        """The convolution proper, without the bias; spectral where that is faster."""
        if self._is_spectral(x):
            return spectral_conv2d(x, kernel)
        return nn.functional.conv2d(x, kernel, stride=self.stride, padding=self.padding)

    def _is_spectral(self, x: Tensor) -> bool:
        """Whether the spectral form applies here, and pays (docs/c4_spectral.md)."""
        square = x.shape[-1] == x.shape[-2]
        if not (self.training and self.is_regular and square) or _is_traced():
            return False
        if x.device.type != "cpu" or self.padding != self.kernel_size // 2:
            return False
        if not is_supported(x.shape[-1], self.kernel_size, self.stride):
            return False
        dtype = torch.get_autocast_dtype("cpu") if torch.is_autocast_enabled("cpu") else x.dtype
        return prefers_spectral(
            self.in_fields,
            self.out_fields,
            map_size=x.shape[-1],
            batch=len(x),
            dtype=dtype,
            kernel_size=self.kernel_size,
        )

    def forward(self, input: Tensor) -> Tensor:
        """Convolve `input` (B, in_type.size, H, W), a plain tensor."""
        if input.ndim != 4 or input.shape[1] != self.in_type.size:
            raise ValueError(
                f"expected (B, {self.in_type.size}, H, W) for {self.in_fields} fields, "
                f"got {tuple(input.shape)}"
            )
        out = self._convolve(input, self._kernel())
        if self.bias is None:
            return out
        bias = (self.bias[:, None] * self.bias_scale).flatten()
        return out + bias.to(out.dtype)[:, None, None]

    def train(self, mode: bool = True) -> "C4Conv":
        """Set the mode; unlike escnn's, this neither makes nor drops buffers."""
        return nn.Module.train(self, mode)

    def export(self) -> nn.Conv2d:
        """A plain `torch.nn.Conv2d` with the same function."""
        conv = nn.Conv2d(
            self.in_type.size,
            self.out_type.size,
            self.kernel_size,
            stride=self.stride,
            padding=self.padding,
            bias=self.bias is not None,
        ).to(self.weights)
        kernel, bias = self.expand_parameters()
        with torch.no_grad():
            conv.weight.copy_(kernel)
            if conv.bias is not None and bias is not None:
                conv.bias.copy_(bias)
        return conv.eval()

    def _load_from_state_dict(
        self,
        state_dict: Mapping[str, Any],
        prefix: str,
        local_metadata: Mapping[str, Any],
        strict: bool,
        missing_keys: list[str],
        unexpected_keys: list[str],
        error_msgs: list[str],
    ) -> None:
        """Load `weights` and `bias`; what escnn stores beside them is expanded anew here."""
        unexpected: list[str] = []
        super()._load_from_state_dict(
            state_dict, prefix, local_metadata, strict, missing_keys, unexpected, error_msgs
        )
        escnn_names = ("filter", "expanded_bias", "bias_expansion", "_basisexpansion")
        unexpected_keys += [
            key for key in unexpected if not key[len(prefix) :].startswith(escnn_names)
        ]
        self._cache = None

    def __getstate__(self) -> dict[str, Any]:
        """Copies and pickles: no cache, and escnn's types (not picklable) by description."""
        state = self.__dict__.copy()
        state["_cache"] = None
        state["in_type"], state["out_type"] = _describe(self.in_type), _describe(self.out_type)
        # Closures and a group that only construction needs.
        for name in ("space", "_maximum_frequency", "_rings", "_sigma"):
            state.pop(name, None)
        return state

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Rebuild what `__getstate__` left out."""
        super().__setstate__(state)
        self.in_type, self.out_type = _build_type(self.in_type), _build_type(self.out_type)
        self.space = self.in_type.gspace

    def extra_repr(self) -> str:
        """`1 trivial -> 38 regular, 5×5`."""
        (in_kind, n), (out_kind, m) = _describe(self.in_type), _describe(self.out_type)
        size = f"{self.kernel_size}×{self.kernel_size}"
        text = (
            f"{n} {in_kind} -> {m} {out_kind}, {size}, {self.kernel_basis.shape[0]} weights a pair"
        )
        text += f", stride {self.stride}" if self.stride != 1 else ""
        return text + (", bias" if self.bias is not None else "")


def _same(snapshot: Tensor, weights: Tensor) -> bool:
    return (
        snapshot.dtype == weights.dtype
        and snapshot.device == weights.device
        and torch.equal(snapshot, weights)
    )


def _is_traced() -> bool:
    return torch.compiler.is_compiling() or torch.jit.is_tracing()


class C4BatchNorm(nn.BatchNorm2d):
    """Batch norm with one affine pair per regular field, statistics pooled over the four turns.

    Shape:
        (B, 4 · num_fields, H, W) -> the same.

    Example:
        >>> C4BatchNorm(3)(torch.randn(2, 12, 5, 5)).shape
        torch.Size([2, 12, 5, 5])
    """

    def forward(self, input: Tensor) -> Tensor:
        """Normalise `input` (B, 4 · num_fields, H, W)."""
        batch, channels, height, width = input.shape
        # One row per field: (B, F, 4·H, W), a view of a contiguous tensor. torch's channels-last
        # batch norm is much less accurate in float32: rows are made contiguous where they are not.
        rows = input.reshape(batch, channels // TURNS, TURNS * height, width)
        return super().forward(rows).view(batch, channels, height, width)


def group_max_pool(x: Tensor) -> Tensor:
    """The largest of each field's four turns: (B, 4F, H, W) -> (B, F, H, W), trivial fields."""
    batch, channels, height, width = x.shape
    return x.view(batch, channels // TURNS, TURNS, height, width).amax(dim=2)
