"""The icosahedral correlation: from a signal on half a sphere to a function on the 60 rotations."""

import torch
from torch import Tensor, nn

from i2i.geometry.icosahedron import icosahedron
from i2i.nn.precision import full_precision


class DynamicFilterConv(nn.Module):
    """Correlate a dynamic filter from the image with a learned sphere of features (paper §4.3).

    `out[b, g, m] = Σ_v Σ_n f[g·v, n] ψ[b, v, n, m] + bias[m]`, v over the visible vertices: the
    image's signal ψ is the filter, the sphere f of the class is what it moves over. With f the
    features of an object, the largest output is at the group element nearest to `view`, the
    rotation from camera to object.

    The tensor over elements, vertices and features is never made: ψ is multiplied with all V
    vertices of the sphere, and a constant 0/1 matrix adds up the right pairs for each of the 60
    elements.

    Args:
        features: Width n of the sphere (paper: 128).
        out_features: Outputs m for each group element (pose: a logit and six numbers).
        num_spheres: Spheres to choose from by index: 1, or one for each class.
        mesh_level: 0, 1 or 2: spheres of 12, 42 or 162 vertices.

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

    pairs: Tensor

    def __init__(
        self,
        features: int,
        out_features: int,
        *,
        num_spheres: int = 1,
        mesh_level: int = 1,
    ) -> None:
        super().__init__()
        # The action on vertex numbers is the same in both group frames: only the labels differ.
        mesh = icosahedron(mesh_level)
        self.features, self.out_features, self.num_spheres = features, out_features, num_spheres
        self.filter_channels = features * out_features
        self.num_vertices, self.sphere_size = len(mesh.visible), len(mesh.vertices)
        self.sphere = nn.Parameter(torch.empty(num_spheres, self.sphere_size, features))
        self.bias = nn.Parameter(torch.empty(num_spheres, out_features))
        # Element g of the group meets visible vertex v with the sphere's vertex g·v.
        moved = mesh.action[:, mesh.visible]  # (60, V_half)
        self.register_buffer("pairs", _pair_matrix(moved, self.sphere_size), persistent=False)
        self.reset_parameters()

    def reset_parameters(self) -> None:
        """Xavier-uniform on the whole tensors, as in the published code."""
        nn.init.xavier_uniform_(self.sphere)
        nn.init.xavier_uniform_(self.bias)

    def forward(self, signal: Tensor, sphere_index: Tensor | None = None) -> Tensor:
        """Correlate: (B, V_half, n · m), index (B,) into the spheres or None -> (B, 60, m)."""
        batch = signal.shape[0]
        if signal.shape[1:] != (self.num_vertices, self.filter_channels):
            raise ValueError(
                f"expected a signal (B, {self.num_vertices}, {self.filter_channels}), "
                f"got {tuple(signal.shape)}"
            )
        # (B, V_half, n, m) -> (B, V_half, m, n): one product with the sphere's rows.
        psi = signal.view(batch, self.num_vertices, self.features, self.out_features)
        psi = psi.transpose(2, 3).reshape(batch, -1, self.features)
        if self.num_spheres == 1:
            products = psi @ self.sphere[0].T
        elif sphere_index is None:
            raise ValueError(
                f"{self.num_spheres} spheres and no index: give the class of each image (class_id)"
            )
        else:
            products = psi @ self.sphere[sphere_index].transpose(1, 2)
        # (B, V_half · m, V) -> (B, m, V_half · V): entry (v, u) is ψ(v)·f(u).
        products = products.view(batch, self.num_vertices, self.out_features, self.sphere_size)
        products = products.transpose(1, 2).reshape(batch, self.out_features, -1)
        # Sums of rounded products are kept in full precision: logits differ by little.
        with full_precision(products):
            out = products.to(self.pairs.dtype) @ self.pairs  # (B, m, 60)
        bias = self.bias if self.num_spheres == 1 else self.bias[sphere_index]
        return out.transpose(1, 2) + bias[:, None, :]

    def __repr__(self) -> str:
        spheres = f"{self.num_spheres} × " if self.num_spheres > 1 else ""
        return (
            f"DynamicFilterConv({spheres}f: V{self.sphere_size} -> R^{self.features}, "
            f"ψ: V{self.num_vertices} -> R^({self.features}×{self.out_features}); "
            f"out(g) = Σ_v f(g·v)ᵀ ψ(v) + b: I60 -> R^{self.out_features})"
        )


def _pair_matrix(moved: Tensor, sphere_size: int) -> Tensor:
    """0/1 matrix (V_half · V, 60): entry (v·V + u, g) is 1 where g·v is the sphere's vertex u."""
    num_elements, num_vertices = moved.shape
    rows = torch.arange(num_vertices)[None, :] * sphere_size + moved
    matrix = torch.zeros(num_vertices * sphere_size, num_elements)
    matrix[rows, torch.arange(num_elements)[:, None]] = 1.0
    return matrix
