"""The icosahedral correlation: from a signal on half a sphere to a function on the 60 rotations."""

import torch
from torch import Tensor, nn

from i2i.geometry.icosahedron import MeshAxis, icosahedron
from i2i.nn.native.correlation import can_correlate, correlate
from i2i.nn.precision import full_precision


class GroupCorrelation(nn.Module):
    """A signal from the image against learned features that the 60 rotations move: common part.

    `out[b, g, m] = Σ_v Σ_n f[moved[g, v], n] ψ[b, v, n, m] + bias[m]`.

    The tensor over elements, places and features is never made: ψ is multiplied with the features
    of the places, and the right pairs are added up for each of the 60 elements. `native` does it
    an image at a time, with the places that some element puts against each v; torch takes all V,
    and a constant 0/1 matrix adds up.

    Args:
        features: Width n of f.
        out_features: Outputs m for each group element.
        num_spheres: Sets of features to choose from by index: 1, or one for each class.
        moved: (60, H): the place of f that element g puts against place v of the signal.
        num_places: Places V that have features.

    Attributes:
        filter_channels: Channels of the signal: n · m.
        num_vertices: Length H of the signal.

    Shape:
        (B, H, filter_channels) and an index (B,) -> (B, 60, m).

    Raises:
        ValueError: If a shape does not fit, or several spheres are given no index.
    """

    pairs: Tensor
    moved: Tensor

    def __init__(
        self,
        features: int,
        out_features: int,
        *,
        num_spheres: int,
        moved: Tensor,
        num_places: int,
    ) -> None:
        super().__init__()
        self.features, self.out_features, self.num_spheres = features, out_features, num_spheres
        self.filter_channels = features * out_features
        self.num_vertices, self.sphere_size = moved.shape[1], num_places
        self.sphere = nn.Parameter(torch.empty(num_spheres, num_places, features))
        self.bias = nn.Parameter(torch.empty(num_spheres, out_features))
        self.register_buffer("pairs", _pair_matrix(moved, num_places), persistent=False)
        self.register_buffer("moved", moved.T.int().contiguous(), persistent=False)  # (H, 60)
        self.reset_parameters()

    def reset_parameters(self) -> None:
        """Xavier-uniform on the whole tensors, as in the published code."""
        nn.init.xavier_uniform_(self.sphere)
        nn.init.xavier_uniform_(self.bias)

    def forward(self, signal: Tensor, sphere_index: Tensor | None = None) -> Tensor:
        """Correlate: (B, H, filter_channels), index (B,) into the spheres or None -> (B, 60, m)."""
        check_signal(signal, (self.num_vertices, self.filter_channels))
        check_index(self.num_spheres, sphere_index)
        index = None if self.num_spheres == 1 else sphere_index
        bias = self.bias if index is None else self.bias[index]
        return self.sums(signal, index) + bias[:, None, :]

    def sums(self, signal: Tensor, sphere_index: Tensor | None) -> Tensor:
        """The correlation without its bias: (B, H, filter_channels) -> (B, 60, m)."""
        if can_correlate(signal, self.sphere):
            return correlate(signal, self.sphere, sphere_index, self.moved)
        psi = signal.reshape(signal.shape[0], -1, self.features, self.out_features).permute(
            0, 3, 1, 2
        )
        sphere = self.sphere[0] if sphere_index is None else self.sphere[sphere_index]
        # (B, m · H, n) with the rows of f: (B, m · H, V).
        products = psi.flatten(1, 2) @ sphere.mT
        return self.add_up(products.view(signal.shape[0], self.out_features, -1))

    def add_up(self, products: Tensor) -> Tensor:
        """Of the products (B, m, H · V) of places those that meet: (B, 60, m)."""
        # Sums of rounded products are kept in full precision: logits differ by little.
        with full_precision(products):
            return (products.to(self.pairs.dtype) @ self.pairs).transpose(1, 2)


class DynamicFilterConv(GroupCorrelation):
    """Correlate a dynamic filter from the image with a learned sphere of features (paper §4.3).

    `out[b, g, m] = Σ_v Σ_n f[g·v, n] ψ[b, v, n, m] + bias[m]`, v over the visible vertices: the
    image's signal ψ is the filter, the sphere f of the class is what it moves over. With f the
    features of an object, the largest output is at the group element nearest to `view`, the
    rotation from camera to object.

    Args:
        features: Width n of the sphere (paper: 128).
        out_features: Outputs m for each group element (pose: a logit and six numbers).
        num_spheres: Spheres to choose from by index: 1, or one for each class.
        mesh_level: 0, 1 or 2: spheres of 12, 42 or 162 vertices.
        mesh_axis: What of the mesh points to the viewer, see `icosahedron`.

    Attributes:
        filter_channels: n · m; channel `i · m + j` of the signal is ψ[i, j], i < n and j < m.
        num_vertices: Visible vertices, the length of the signal.

    Shape:
        (B, num_vertices, n · m) and an index (B,) -> (B, 60, m).

    Raises:
        ValueError: If a shape does not fit, or several spheres are given no index.

    Example:
        >>> conv = DynamicFilterConv(8, 7)
        >>> conv(torch.zeros(2, 16, 56)).shape
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
        # The action on vertex numbers is the same in both group frames: only the labels differ.
        mesh = icosahedron(mesh_level, mesh_axis=mesh_axis)
        super().__init__(
            features,
            out_features,
            num_spheres=num_spheres,
            # Element g of the group meets visible vertex v with the sphere's vertex g·v.
            moved=mesh.action[:, mesh.visible],
            num_places=len(mesh.vertices),
        )
        self.mesh_axis = mesh_axis

    def __repr__(self) -> str:
        return (
            f"DynamicFilterConv({spheres(self.num_spheres)}f: V{self.sphere_size} -> "
            f"R^{self.features}, ψ: V{self.num_vertices} -> R^({self.features}×"
            f"{self.out_features}); out(g) = Σ_v f(g·v)ᵀ ψ(v) + b: I60 -> R^{self.out_features})"
        )


def check_signal(signal: Tensor, expected: tuple[int, int]) -> None:
    """Refuse a signal whose shape is not (B, *expected).

    Raises:
        ValueError: Saying what was expected.
    """
    if signal.shape[1:] != expected:
        raise ValueError(
            f"expected a signal (B, {expected[0]}, {expected[1]}), got {tuple(signal.shape)}"
        )


def check_index(num_spheres: int, sphere_index: Tensor | None) -> None:
    """Refuse a missing index where there are several spheres.

    Raises:
        ValueError: Saying what to give.
    """
    if num_spheres > 1 and sphere_index is None:
        raise ValueError(
            f"{num_spheres} spheres and no index: give the class of each image (class_id)"
        )


def spheres(number: int) -> str:
    """`10 × ` for the formulas of several spheres, nothing for one."""
    return f"{number} × " if number > 1 else ""


def _pair_matrix(moved: Tensor, num_places: int) -> Tensor:
    """0/1 matrix (H · V, 60): entry (v·V + u, g) is 1 where g puts place u of f against v."""
    num_elements, length = moved.shape
    rows = torch.arange(length)[None, :] * num_places + moved
    matrix = torch.zeros(length * num_places, num_elements)
    matrix[rows, torch.arange(num_elements)[:, None]] = 1.0
    return matrix
