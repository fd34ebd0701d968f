"""Equivariance assertions for layers, ours or a user's own.

A layer E is equivariant when ``E(turn(x)) = turn'(E(x))`` for every element of the group. The
functions here measure the relative error of that for *all* elements, in float64, and return the
measurements, so that a test is three lines and a failing one says by how much and where::

    def test_my_layer_turns_with_the_image():
        report = assert_c4_equivariant(MyLayer(), torch.randn(2, 3, 17, 17))
        print(report)
"""

import copy
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import torch
from torch import Tensor, nn

from i2i.geometry.icosahedron import Icosahedron, icosahedron
from i2i.geometry.rotations import axis_rotation

# A few hundred rounding errors of each type: what an exact layer of ordinary depth stays below.
TOLERANCES: dict[torch.dtype, float] = {
    torch.float64: 1e-10,
    torch.float32: 1e-4,
    torch.float16: 5e-2,
    torch.bfloat16: 2e-1,
}

Action = Callable[[int, Tensor], Tensor]
C4Output = Literal["map", "regular", "invariant", "rotation"]


@dataclass(frozen=True)
class EquivarianceReport:
    """What was measured.

    Attributes:
        name: Layer and group.
        elements: The group elements that were tried.
        errors: ``|E(turn x) − turn' E(x)| / |E(x)|`` for each of them (Frobenius norms).
        tolerance: What was allowed.
    """

    name: str
    elements: tuple[int, ...]
    errors: tuple[float, ...]
    tolerance: float

    @property
    def max_error(self) -> float:
        """Largest relative error; NaN if any is."""
        return torch.tensor(self.errors).max().item()

    @property
    def worst_element(self) -> int:
        """Element with the largest error."""
        return self.elements[int(torch.tensor(self.errors).argmax())]

    @property
    def passed(self) -> bool:
        """Whether every error is within the tolerance; NaN is not."""
        return all(error <= self.tolerance for error in self.errors)

    def __str__(self) -> str:
        failing = sum(not error <= self.tolerance for error in self.errors)
        return (
            f"{self.name}: largest relative error {self.max_error:.3g} "
            f"at element {self.worst_element}, "
            f"tolerance {self.tolerance:.3g}, {failing} of {len(self.errors)} elements fail"
        )


def assert_equivariant(
    layer: Callable[[Tensor], Tensor],
    x: Tensor,
    *,
    input_action: Action,
    output_action: Action,
    elements: Sequence[int],
    dtype: torch.dtype = torch.float64,
    tolerance: float | None = None,
    name: str | None = None,
    raise_error: bool = True,
) -> EquivarianceReport:
    """Assert that a layer commutes with a group, for every element given.

    A module is copied, cast and put into evaluation mode; the one passed in is left as it is.

    Args:
        layer: A module or a function from tensor to tensor.
        x: Input, any shape; cast to ``dtype``.
        input_action: ``(element, x) -> x turned``.
        output_action: ``(element, E(x)) -> E(x) turned``.
        elements: Numbers of the group elements to try.
        dtype: Precision to compute in.
        tolerance: Largest relative error; by default `TOLERANCES` of ``dtype``.
        name: What to call it in the report.
        raise_error: False returns the report of a failing layer instead of raising.

    Returns:
        The measurements.

    Raises:
        AssertionError: If an error exceeds the tolerance or is not a number.
        ValueError: If there is nothing to test: no elements, or an output that is zero everywhere.
    """
    __tracebackhide__ = True
    report = _measure(
        _prepared(layer, dtype),
        x.to(dtype),
        input_action,
        output_action,
        tuple(elements),
        TOLERANCES[dtype] if tolerance is None else tolerance,
        name or type(layer).__name__,
    )
    if raise_error and not report.passed:
        raise AssertionError(str(report))
    return report


def _prepared(layer: Callable[[Tensor], Tensor], dtype: torch.dtype) -> Callable[[Tensor], Tensor]:
    if not isinstance(layer, nn.Module):
        return layer
    # train() first: modules that keep expanded kernels in evaluation mode rebuild them from the
    # cast weights only on the way from training to evaluation.
    return copy.deepcopy(layer).train().to(dtype).eval()


@torch.no_grad()
def _measure(
    layer: Callable[[Tensor], Tensor],
    x: Tensor,
    input_action: Action,
    output_action: Action,
    elements: tuple[int, ...],
    tolerance: float,
    name: str,
) -> EquivarianceReport:
    if not elements:
        raise ValueError("no group elements to test")
    reference = layer(x)
    scale = reference.norm().item()
    if scale == 0:
        raise ValueError(f"{name} gives zero everywhere on this input; that proves nothing")
    errors = []
    for element in elements:
        expected = output_action(element, reference)
        got = layer(input_action(element, x))
        if got.shape != expected.shape:
            raise ValueError(
                f"{name} gives shape {tuple(got.shape)} on the turned input, "
                f"expected {tuple(expected.shape)}"
            )
        errors.append((got - expected).norm().item() / scale)
    return EquivarianceReport(name, elements, tuple(errors), tolerance)


def assert_icosahedral_equivariant(
    layer: Callable[[Tensor], Tensor],
    signal: Tensor,
    *,
    side: Literal["feature", "filter"] = "feature",
    mesh: Icosahedron | None = None,
    vertex_dim: int = -2,
    group_dim: int = -2,
    elements: Sequence[int] | None = None,
    **options: Any,  # noqa: ANN401  passed on as they are
) -> EquivarianceReport:
    """Assert the symmetry of ``out(g) = Σ_v f(g v) ψ(v)`` in one of its two arguments.

    - "feature": ``f'(v) = f(h v)`` must give ``out'(g) = out(h g)``.
    - "filter": ``ψ'(v) = ψ(h⁻¹ v)`` must give ``out'(g) = out(g h)``; ψ must have all vertices.

    Args:
        layer: Function of the argument that is tried, the other one held fixed.
        signal: That argument, with the vertices along ``vertex_dim``.
        side: Which argument it is.
        mesh: Icosahedron whose numbering the layer uses; level 1 by default.
        vertex_dim: Where the vertices are in the input.
        group_dim: Where the 60 elements are in the output.
        elements: Elements h to try; all 60 by default.
        **options: ``dtype``, ``tolerance``, ``name``, ``raise_error`` of `assert_equivariant`.

    Returns:
        The measurements.

    Raises:
        AssertionError: If an error exceeds the tolerance.
        ValueError: If the side is another.
    """
    __tracebackhide__ = True
    mesh = icosahedron(1) if mesh is None else mesh
    if side == "feature":

        def turn(h: int, x: Tensor) -> Tensor:
            return x.index_select(vertex_dim, mesh.action[h])

        def turned(h: int, out: Tensor) -> Tensor:
            return out.index_select(group_dim, mesh.multiplication[h])
    elif side == "filter":

        def turn(h: int, x: Tensor) -> Tensor:
            return x.index_select(vertex_dim, mesh.action[mesh.inverse[h]])

        def turned(h: int, out: Tensor) -> Tensor:
            return out.index_select(group_dim, mesh.multiplication[:, h])
    else:
        raise ValueError(f"side {side!r} is not one of feature, filter")
    options.setdefault("name", f"{type(layer).__name__} under I60, {side} side")
    every = range(60) if elements is None else elements
    return assert_equivariant(
        layer, signal, input_action=turn, output_action=turned, elements=every, **options
    )


def assert_c4_equivariant(
    layer: Callable[[Tensor], Tensor],
    image: Tensor,
    *,
    output: C4Output | Action = "map",
    input_fields: Literal["trivial", "regular"] = "trivial",
    **options: Any,  # noqa: ANN401  passed on as they are
) -> EquivarianceReport:
    """Assert how a layer answers to quarter turns of the image, all four of them.

    Args:
        layer: A module or function of an image.
        image: Shape (..., C, S, S), square.
        output: What must happen to the output when the image is turned by k quarters:
            "map": it turns with it (..., C, S', S'); "regular": it turns and the four channels of
            each field are shifted by k, fields outermost; "invariant": nothing; "rotation":
            it is multiplied from the left by Rz(90°·k), shape (..., 3, 3); or your own
            ``(k, output) -> output``.
        input_fields: "regular" shifts the channels of the input likewise.
        **options: ``dtype``, ``tolerance``, ``name``, ``raise_error`` of `assert_equivariant`.

    Returns:
        The measurements.

    Raises:
        AssertionError: If an error exceeds the tolerance.
        ValueError: If the image is not square or the output kind is another.
    """
    __tracebackhide__ = True
    if image.shape[-1] != image.shape[-2]:
        raise ValueError(f"quarter turns want a square image, got {tuple(image.shape)}")
    actions: dict[str, Action] = {
        "map": turn_map,
        "trivial": turn_map,
        "regular": turn_regular_map,
        "invariant": lambda _, out: out,
        "rotation": lambda k, out: axis_rotation("z", 90 * k).to(out) @ out,
    }
    if not callable(output) and output not in actions:
        raise ValueError(f"output {output!r} is not one of map, regular, invariant, rotation")
    options.setdefault("name", f"{type(layer).__name__} under C4")
    return assert_equivariant(
        layer,
        image,
        input_action=actions[input_fields],
        output_action=output if callable(output) else actions[output],
        elements=range(4),
        **options,
    )


def turn_map(quarters: int, x: Tensor) -> Tensor:
    """Turn a raster counter-clockwise by quarter turns, shape (..., S, S)."""
    return torch.rot90(x, quarters, dims=(-2, -1))


def turn_regular_map(quarters: int, x: Tensor) -> Tensor:
    """Turn a map of regular C4 fields: the raster turns, the four channels of a field shift.

    Channels are field·4 + s; a turn by k moves channel s to s + k.
    """
    fields = x.unflatten(-3, (-1, 4)).roll(quarters, dims=-3).flatten(-4, -3)
    return turn_map(quarters, fields)
