"""Group convolutions of multi-view networks: from views to the 60 rotations, and on them.

Features are functions on views or on rotations. Where the object is turned by an element h, view v
shows what view h⁻¹·v showed, so a function turns by `x'(v) = x(h⁻¹ v)`, and the outputs of both
layers turn alike, `out'(g) = out(h⁻¹ g)`: what moves with the object is on the left, the filters
are on the right.
"""

import torch
from torch import Tensor, nn

from i2i.geometry.icosahedron import icosahedron
from i2i.geometry.view_sets import view_permutations
from i2i.nn.group_conv_variants import support_elements


class TappedConv(nn.Module):
    """`out(g) = Σ_t W_t x(moved[g, t]) + b` at all 60 rotations: common part.

    Args:
        in_features: Width of x.
        out_features: Width of the output.
        moved: (60, T): the place of x that tap t reads for rotation g.
        num_places: Places of x.

    Attributes:
        taps: T.

    Shape:
        (B, num_places, in_features) -> (B, 60, out_features).

    Raises:
        ValueError: If the signal has another shape.
    """

    moved: Tensor

    def __init__(
        self, in_features: int, out_features: int, *, moved: Tensor, num_places: int
    ) -> None:
        super().__init__()
        self.in_features, self.out_features = in_features, out_features
        self.num_places, self.taps = num_places, moved.shape[1]
        self.weight = nn.Parameter(torch.empty(self.taps, in_features, out_features))
        self.bias = nn.Parameter(torch.empty(out_features))
        self.register_buffer("moved", moved, persistent=False)
        self.reset_parameters()

    def reset_parameters(self) -> None:
        """He's normal rule for a ReLU behind; no bias."""
        nn.init.normal_(self.weight, std=(2 / (self.taps * self.in_features)) ** 0.5)
        nn.init.zeros_(self.bias)

    def forward(self, x: Tensor) -> Tensor:
        """(B, num_places, in_features) -> (B, 60, out_features)."""
        if x.ndim != 3 or x.shape[1:] != (self.num_places, self.in_features):
            expected = f"(B, {self.num_places}, {self.in_features})"
            raise ValueError(f"expected a signal of shape {expected}, got {tuple(x.shape)}")
        read = x.index_select(1, self.moved.flatten())  # (B, 60 · T, n)
        read = read.view(len(x), len(self.moved), self.taps * self.in_features)
        return read @ self.weight.flatten(0, 1) + self.bias


class ViewsToGroup(TappedConv):
    """Correlate views with a filter on the places of their cameras: `out(g) = Σ_v W_v x(g·v) + b`.

    Args:
        in_features: Width of a view's feature.
        out_features: Width of the output.
        camera_set: `"icosahedron_12"` (12 taps) or `"dodecahedron_20"` (20).

    Shape:
        (B, V, in_features) -> (B, 60, out_features).

    Raises:
        ValueError: If the set is unknown or the signal has another shape.

    Reference:
        Esteves et al. 2019, "Equivariant Multi-View Networks", the layer on a homogeneous space.

    Example:
        >>> ViewsToGroup(8, 6)(torch.zeros(2, 12, 8)).shape
        torch.Size([2, 60, 6])
    """

    def __init__(
        self, in_features: int, out_features: int, *, camera_set: str = "icosahedron_12"
    ) -> None:
        moved = view_permutations(camera_set)
        super().__init__(in_features, out_features, moved=moved, num_places=moved.shape[1])

    def __repr__(self) -> str:
        return (
            f"ViewsToGroup(x: V{self.num_places} -> R^{self.in_features}; "
            f"out(g) = Σ_v W(v) x(g·v) + b: I60 -> R^{self.out_features})"
        )


class GroupConv(TappedConv):
    """Correlate on the group with a local filter: `out(g) = Σ_{h∈N} W_h x(g·h) + b`.

    Args:
        in_features: Width of x.
        out_features: Width of the output.
        support: The set N: `"local13"`, the identity and the 12 turns by 72°, or `"identity"`.

    Shape:
        (B, 60, in_features) -> (B, 60, out_features).

    Raises:
        ValueError: If the support is unknown or the signal has another shape.

    Reference:
        Esteves et al. 2019, "Equivariant Multi-View Networks".

    Example:
        >>> GroupConv(8, 6)(torch.zeros(2, 60, 8)).shape
        torch.Size([2, 60, 6])
    """

    def __init__(self, in_features: int, out_features: int, *, support: str = "local13") -> None:
        group = icosahedron(0)
        elements = support_elements(group, support)
        moved = group.multiplication[:, elements]
        super().__init__(in_features, out_features, moved=moved, num_places=len(moved))
        self.support = support

    def __repr__(self) -> str:
        return (
            f"GroupConv(x: I60 -> R^{self.in_features}, N: {self.support} ({self.taps}); "
            f"out(g) = Σ_h W(h) x(g·h) + b: I60 -> R^{self.out_features})"
        )
