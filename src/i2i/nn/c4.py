"""C4-equivariant layers on plain tensors: everything of the project that touches escnn.

A *regular field* is four channels, one for each quarter turn; F fields are a tensor (B, 4F, H, W)
whose channel index is `4 * field + turn`. A *trivial field* is one channel. escnn gives the spaces
of steerable kernels; the layers here own their weights, their initialisation and their kernel
cache, so that a state dict holds parameters only and means the same in training and in evaluation
mode.
"""

import math
import warnings
from collections.abc import Callable, Mapping
from functools import lru_cache
from typing import Any

import torch
from torch import Tensor, nn

from i2i.nn.c4_basis import TURNS, full_basis, symmetrise
from i2i.nn.c4_dispatch import takes_patches
from i2i.nn.c4_spectral import (
    product_dtype,
    spectral_conv_pixel_major,
    spectral_product,
    transform_filters,
    transform_matrix,
)
from i2i.nn.native import is_traced
from i2i.nn.native.products import multiply, product
from i2i.nn.precision import full_precision

with warnings.catch_warnings():
    # escnn warns that py3nj (a Fortran package for SO(3)) is missing; C4 has no use for it.
    warnings.filterwarnings("ignore", message=".*py3nj.*", category=UserWarning)
    from escnn import gspaces
    from escnn.nn import FieldType, R2Conv

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
            kernel_basis = full_basis(in_kind, out_kind, kernel_size)
        else:
            # escnn hands the same tensor to every layer: a copy keeps `.double()` or `.cuda()` of
            # one network from changing another.
            kernel_basis = symmetrise(next(self._basisexpansion.buffers()), in_kind, out_kind)
        bias_column = (
            self.bias_expansion[: out_type.size // out_fields, 0].clone() if bias else None
        )
        self._strip_escnn_state()
        self.basis = basis
        self.in_fields, self.out_fields = in_fields, out_fields
        self.register_buffer("kernel_basis", kernel_basis, persistent=False)
        self.register_buffer("bias_scale", bias_column, persistent=False)
        self.weights = nn.Parameter(torch.empty(out_fields * in_fields * kernel_basis.shape[0]))
        # A snapshot of the weights and what was computed from it, by key.
        self._cache: tuple[Tensor, dict[object, Tensor]] | None = None
        self._matrices: dict[object, Tensor] = {}
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

    def _kernel(self, dtype: torch.dtype) -> Tensor:
        """The expanded kernel, from the cache where that is safe."""
        return self._cached(("dense", dtype), lambda: self.expand_parameters()[0].to(dtype))

    def _cached(self, key: object, make: Callable[[], Tensor]) -> Tensor:
        """What `make` computes from the weights, kept in evaluation for as long as they last."""
        weights = self.weights
        needs_grad = torch.is_grad_enabled() and weights.requires_grad
        # On a GPU comparing would wait for the device and expanding is cheap: no cache there.
        if self.training or needs_grad or weights.device.type != "cpu" or is_traced():
            self._cache = None
            return make()
        # Compared by value: an optimiser, an average or `weights.data.copy_()` that goes around
        # every version counter is seen as well.
        with torch.inference_mode(mode=False), torch.no_grad():
            if self._cache is None or not _same(self._cache[0], weights):
                self._cache = (weights.detach().clone(), {})
            kept = self._cache[1]
            if key not in kept:
                kept[key] = make()
        return kept[key]

    def _spectral_matrix(self, map_size: int) -> Tensor:
        """From the weights of a pair of fields to its spectral blocks (16 (n + 1), K)."""
        basis = self.kernel_basis
        key = (map_size, basis.dtype, basis.device)
        if key not in self._matrices:
            with torch.inference_mode(mode=False), torch.no_grad(), full_precision(basis):
                taps = transform_matrix(map_size, self.kernel_size, dtype=torch.float64)
                rows = basis[:, 0].flatten(1).double().cpu()  # (K, 4 · cells): K[0, j]
                matrix = taps @ rows.T
                # What should be zero is: `native` leaves it out.
                matrix[matrix.abs() < 1e-12] = 0.0
                self._matrices[key] = matrix.to(basis)
        return self._matrices[key]

    def pixel_major(self, x: Tensor) -> Tensor:
        """The same convolution on pixel-major maps: 1×1 as it is, others through the spectrum.

        Only for regular fields, odd kernels, stride 1 and padding k // 2: see `c4_spectral`.

        Shape:
            (H · H, 4, in_fields, B) -> (H · H, 4, out_fields, B).
        """
        out = self._pointwise(x) if self.kernel_size == 1 else self._spectral(x)
        if self.bias is None:
            return out
        return out + (self.bias_scale[:, None] * self.bias)[..., None]  # (4, out_fields, 1)

    def _pointwise(self, x: Tensor) -> Tensor:
        """A 1×1 convolution as two products, of x_g + x_{g+2} and of x_g − x_{g+2}."""
        pixels, _, _, batch = x.shape
        kernel = self._kernel(self.weights.dtype).view(
            self.out_fields, TURNS, self.in_fields, TURNS
        )
        first, second = kernel[:, :2].permute(1, 0, 3, 2).unflatten(2, (2, 2)).unbind(2)
        halves = x.view(pixels, 2, -1, batch)
        mixed = []
        for sign in (1, -1):
            weights = (first + sign * second).reshape(2 * self.out_fields, -1)
            columns = halves[:, 0] + sign * halves[:, 1]
            columns = columns.transpose(0, 1).reshape(2 * self.in_fields, -1)
            # Half of the sum and of the difference of the two results.
            mixed.append(product(0.5 * weights, columns).view(-1, pixels, batch).to(x.dtype))
        out = torch.stack([mixed[0] + mixed[1], mixed[0] - mixed[1]])  # (2, 2 · fields, P, B)
        # The batch norm that follows wants it contiguous.
        return out.permute(2, 0, 1, 3).reshape(pixels, TURNS, self.out_fields, batch).contiguous()

    def _spectral(self, x: Tensor) -> Tensor:
        matrix = self._spectral_matrix(math.isqrt(len(x)))
        coefficients = self.weights.view(self.out_fields, self.in_fields, -1)
        if torch.is_grad_enabled() and (self.weights.requires_grad or x.requires_grad):
            self._cache = None  # what evaluation kept is many times the weights
            return spectral_conv_pixel_major(x, coefficients, matrix, kernel_size=self.kernel_size)
        dtype = product_dtype(x)
        with full_precision(x):
            blocks = self._cached(
                (len(x), dtype), lambda: transform_filters(coefficients, matrix, dtype=dtype)
            )
        return spectral_product(x, blocks, kernel_size=self.kernel_size)

    def forward(self, input: Tensor) -> Tensor:
        """Convolve `input` (B, in_type.size, H, W), a plain tensor."""
        if input.ndim != 4 or input.shape[1] != self.in_type.size:
            raise ValueError(
                f"expected (B, {self.in_type.size}, H, W) for {self.in_fields} fields, "
                f"got {tuple(input.shape)}"
            )
        kernel = self._kernel(product_dtype(self.weights))
        where = {"stride": self.stride, "padding": self.padding}
        if takes_patches(input, kernel):
            # A library's convolution rearranges the kernel at every call: with one image that is
            # most of its time.
            size = [(side + 2 * self.padding - self.kernel_size) // self.stride + 1
                    for side in input.shape[2:]]  # fmt: skip
            patches = nn.functional.unfold(input.to(kernel.dtype), self.kernel_size, **where)
            out = multiply(kernel.flatten(1), patches[0]).view(1, -1, *size)
        else:
            out = nn.functional.conv2d(input, kernel, **where)
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
        state["_cache"], state["_matrices"] = None, {}
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


def group_max_pool(x: Tensor) -> Tensor:
    """The largest of each field's four turns: (B, 4F, H, W) -> (B, F, H, W), trivial fields."""
    batch, channels, height, width = x.shape
    return x.view(batch, channels // TURNS, TURNS, height, width).amax(dim=2)
