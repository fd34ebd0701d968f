"""What can stand in place of the icosahedral correlation, for the paper's ablation tables."""

import math

import torch
from torch import Tensor, nn

from i2i.geometry.icosahedron import Icosahedron, MeshAxis, icosahedron
from i2i.nn.group_convs import GroupCorrelation, check_index, check_signal, spheres
from i2i.nn.precision import full_precision

# Largest angle in degrees of the elements that carry the filter.
SUPPORTS = {"identity": 0.0, "local13": 72.0}
READINGS = ("sampled", "pooled")
_LEAST_REDUCED = 4  # channels; fewer may all be silenced by the ReLU


class VectorFilterConv(GroupCorrelation):
    """The correlation with the roles of the shapes exchanged ("vector projection" of the paper).

    `out[b, g, m] = Σ_v Σ_n f[g·v, n, m] ψ[b, v, n] + bias[m]`: the image gives a vector for each
    visible vertex, the learned sphere a matrix. So the image cannot choose a filter for each
    output, and the encoder's last layer is m times narrower.

    Args:
        features: Width n of the signal (paper: 128).
        out_features: Outputs m for each group element.
        num_spheres: Spheres to choose from by index: 1, or one for each class.
        mesh_level: 0, 1 or 2: spheres of 12, 42 or 162 vertices.
        mesh_axis: What of the mesh points to the viewer, see `icosahedron`.

    Attributes:
        filter_channels: n.
        num_vertices: Visible vertices, the length of the signal.

    Shape:
        (B, num_vertices, n) and an index (B,) -> (B, 60, m).

    Raises:
        ValueError: If a shape does not fit, or several spheres are given no index.

    Example:
        >>> VectorFilterConv(8, 7)(torch.zeros(2, 16, 8)).shape
        torch.Size([2, 60, 7])
    """

    def __init__(
        self,
        features: int,
        out_features: int,
        *,
        num_spheres: int = 1,
        mesh_level: int = 1,
        mesh_axis: MeshAxis = "vertex",
    ) -> None:
        mesh = icosahedron(mesh_level, mesh_axis=mesh_axis)
        super().__init__(
            features,
            out_features,
            num_spheres=num_spheres,
            moved=mesh.action[:, mesh.visible],
            num_places=len(mesh.vertices),
        )
        self.mesh_axis = mesh_axis
        self.filter_channels = features
        self.sphere = nn.Parameter(torch.empty(*self.sphere.shape, out_features))
        self.reset_parameters()

    def reset_parameters(self) -> None:
        """The range of the matrix-valued filter's sphere, so that outputs start equally large."""
        # Xavier's rule on (spheres, vertices, n): the outputs are separate spheres.
        bound = math.sqrt(6 / ((self.sphere.shape[0] + self.sphere_size) * self.features))
        nn.init.uniform_(self.sphere, -bound, bound)
        nn.init.xavier_uniform_(self.bias)

    def sums(self, signal: Tensor, sphere_index: Tensor | None) -> Tensor:
        """The correlation without its bias: (B, H, n) -> (B, 60, m)."""
        # (K, V, n, m) -> (K, n, V · m): one product with the signal's rows.
        rows = self.sphere.transpose(1, 2).flatten(2)
        products = signal @ (rows[0] if sphere_index is None else rows[sphere_index])
        # (B, H, V · m) -> (B, m, H · V)
        products = products.unflatten(2, (self.sphere_size, self.out_features)).movedim(3, 1)
        return self.add_up(products.flatten(2))

    def __repr__(self) -> str:
        n, m = self.features, self.out_features
        return (
            f"VectorFilterConv({spheres(self.num_spheres)}f: V{self.sphere_size} -> R^({n}×{m}), "
            f"ψ: V{self.num_vertices} -> R^{n}; out(g) = Σ_v f(g·v)ᵀ ψ(v) + b: I60 -> R^{m})"
        )


class FullGroupConv(GroupCorrelation):
    """A correlation on the group itself ("full group projection" of the paper).

    `out[b, g, m] = Σ_h Σ_n f[g·h, n] ψ[b, h, n, m] + bias[m]`, h over a support in the group. The
    features f belong to the 60 rotations instead of the vertices. With only the identity as
    support the layer is `f(g)ᵀ ψ + b`: each rotation has an embedding of its own and shares
    nothing with the others.

    Args:
        features: Width n of f (paper: 128).
        out_features: Outputs m for each group element.
        num_spheres: Sets of features to choose from by index: 1, or one for each class.
        support: `"identity"`, or `"local13"`: the identity and the 12 turns by 72°.
        mesh_axis: What of the icosahedron points to the viewer, see `icosahedron`.

    Attributes:
        filter_channels: n · m; channel `i · m + j` of the signal is ψ[i, j], i < n and j < m.
        num_vertices: Elements in the support, 1 or 13, rising, identity first.

    Shape:
        (B, num_vertices, n · m) and an index (B,) -> (B, 60, m).

    Raises:
        ValueError: If the support is unknown, a shape does not fit, or several spheres are given
            no index.

    Example:
        >>> FullGroupConv(8, 7)(torch.zeros(2, 1, 56)).shape
        torch.Size([2, 60, 7])
    """

    def __init__(
        self,
        features: int,
        out_features: int,
        *,
        num_spheres: int = 1,
        support: str = "identity",
        mesh_axis: MeshAxis = "vertex",
    ) -> None:
        mesh = icosahedron(mesh_axis=mesh_axis)
        super().__init__(
            features,
            out_features,
            num_spheres=num_spheres,
            moved=mesh.multiplication[:, support_elements(mesh, support)],
            num_places=len(mesh.rotations),
        )
        self.support, self.mesh_axis = support, mesh_axis

    def __repr__(self) -> str:
        n, m = self.features, self.out_features
        return (
            f"FullGroupConv({spheres(self.num_spheres)}f: I60 -> R^{n}, "
            f"ψ: {self.support} ({self.num_vertices}) -> R^({n}×{m}); "
            f"out(g) = Σ_h f(g·h)ᵀ ψ(h) + b: I60 -> R^{m})"
        )


def support_elements(mesh: Icosahedron, support: str) -> Tensor:
    """The elements that carry the filter of `FullGroupConv`, rising, identity first.

    Raises:
        ValueError: If the support is unknown.
    """
    if support not in SUPPORTS:
        raise ValueError(f"support={support!r} is not known: choose one of {', '.join(SUPPORTS)}")
    return mesh.elements_within(SUPPORTS[support])


class UnconstrainedMap(nn.Module):
    """One linear map from the whole signal to all outputs, in place of the group convolution.

    The control of the paper's ablation ("w/o GroupConv"), which the paper does not define. Two
    readings: the samples at the visible vertices, reduced to few channels, all go into a linear
    map with 60·m outputs; or the map's global average does. No weight is shared between rotations.

    Args:
        features: Width n of the sphere that is left out; decides how many channels are kept.
        out_features: Outputs m for each group element.
        in_channels: Channels of the encoder's map.
        num_spheres: Maps to choose from by index: 1, or one for each class.
        mesh_level: That of the projector, for reading `"sampled"`.
        mesh_axis: That of the projector; the 60 outputs belong to the elements of its frame.
        reading: `"sampled"` or `"pooled"`.
        reduced: Channels of each sample in reading `"sampled"`. None: as many as make this map and
            the projector's as large as I2I's projector and sphere of one class (paper: 40), but at
            least 4.

    Attributes:
        filter_channels: Channels of the signal.
        num_vertices: Length of the signal: the visible vertices, or 1.

    Shape:
        (B, num_vertices, filter_channels) and an index (B,) -> (B, 60, m).

    Raises:
        ValueError: If the reading is unknown, a shape does not fit, or several spheres are given
            no index.

    Example:
        >>> conv = UnconstrainedMap(128, 7, in_channels=304)
        >>> conv(torch.zeros(2, 16, 40)).shape
        torch.Size([2, 60, 7])
    """

    def __init__(
        self,
        features: int,
        out_features: int,
        *,
        in_channels: int,
        num_spheres: int = 1,
        mesh_level: int = 1,
        mesh_axis: MeshAxis = "vertex",
        reading: str = "sampled",
        reduced: int | None = None,
    ) -> None:
        super().__init__()
        if reading not in READINGS:
            raise ValueError(
                f"reading={reading!r} is not known: choose one of {', '.join(READINGS)}"
            )
        mesh = icosahedron(mesh_level, mesh_axis=mesh_axis)
        self.out_features, self.num_spheres, self.reading = out_features, num_spheres, reading
        self.mesh_axis = mesh_axis
        self.num_vertices = 1 if reading == "pooled" else len(mesh.visible)
        if reading == "pooled":
            self.filter_channels = in_channels
        elif reduced is None:
            self.filter_channels = matched_channels(in_channels, features, out_features, mesh)
        else:
            self.filter_channels = reduced
        inputs, outputs = self.num_vertices * self.filter_channels, 60 * out_features
        self.weight = nn.Parameter(torch.empty(num_spheres, inputs, outputs))
        self.bias = nn.Parameter(torch.empty(num_spheres, outputs))
        self.reset_parameters()

    def reset_parameters(self) -> None:
        """As a linear layer: uniform within one over the root of the inputs."""
        bound = 1 / math.sqrt(self.weight.shape[1])
        nn.init.uniform_(self.weight, -bound, bound)
        nn.init.uniform_(self.bias, -bound, bound)

    def forward(self, signal: Tensor, sphere_index: Tensor | None = None) -> Tensor:
        """Map: (B, num_vertices, filter_channels), index (B,) or None -> (B, 60, m)."""
        check_signal(signal, (self.num_vertices, self.filter_channels))
        check_index(self.num_spheres, sphere_index)
        with full_precision(signal):
            flat = signal.flatten(1).to(self.weight.dtype)
            if self.num_spheres == 1:
                out = flat @ self.weight[0] + self.bias
            else:
                out = (flat[:, None] @ self.weight[sphere_index])[:, 0] + self.bias[sphere_index]
        return out.unflatten(1, (60, self.out_features))

    def __repr__(self) -> str:
        inputs = f"{self.num_vertices}·{self.filter_channels}"
        return (
            f"UnconstrainedMap({spheres(self.num_spheres)}{self.reading}: R^({inputs}) -> "
            f"R^(60·{self.out_features}))"
        )


def matched_channels(in_channels: int, features: int, out_features: int, mesh: Icosahedron) -> int:
    """Channels k' whose 1×1 map and linear map are as large as I2I's 1×1 map and sphere.

    `(C+1)·k' + (V_half·k' + 1)·60·m  ≈  (C+1)·n·m + V·n + m`, rounded, at least 4.
    """
    outputs = 60 * out_features
    wanted = (in_channels + 1) * features * out_features
    wanted += len(mesh.vertices) * features + out_features
    each = in_channels + 1 + len(mesh.visible) * outputs
    return max(_LEAST_REDUCED, round((wanted - outputs) / each))
