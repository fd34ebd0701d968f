"""What the project's networks are compared with: the same functions, made the usual way.

`escnn_encoder` and `DirectHead` take the weights of a network of ours, so that a benchmark can
check that both compute the same before it times them. `PlainResNet18` has the same widths in plain
`torch.nn` and knows nothing of C4.
"""

import warnings

import torch
from torch import Tensor, nn

from i2i.geometry.icosahedron import icosahedron
from i2i.models.i2i import I2IPose, I2ITrunk
from i2i.nn.c4 import C4Conv, regular_type
from i2i.nn.c4_norm import C4BatchNorm
from i2i.nn.c4_resnet import C4BasicBlock, C4ResNet18
from i2i.nn.group_convs import DynamicFilterConv
from i2i.nn.projectors import IcosahedralProjector

with warnings.catch_warnings():
    warnings.simplefilter("ignore")
    import escnn.nn as enn


def escnn_encoder(ours: C4ResNet18, *, initialize: bool = False) -> nn.Module:
    """The encoder in escnn's own layers (dense convolutions), with the weights of `ours`."""
    return _EscnnEncoder(ours, initialize)


class _EscnnEncoder(nn.Module):
    mask: Tensor

    def __init__(self, ours: C4ResNet18, initialize: bool) -> None:
        super().__init__()
        if ours.stem_mode not in ("ref", "odd"):
            raise ValueError(f"escnn has no even kernels: stem_mode={ours.stem_mode!r}")
        self.background = ours.background
        self.register_buffer("mask", ours.mask)
        self.out_channels, self.map_size = ours.out_channels, ours.map_size
        self.stem = _conv(ours.stem, initialize)
        self.norm = _norm(ours.norm)
        self.relu = enn.ReLU(self.stem.out_type)
        self.pool: nn.Module = nn.Identity()
        if isinstance(ours.max_pool, nn.MaxPool2d):
            self.pool = enn.PointwiseMaxPool(self.stem.out_type, kernel_size=3, stride=2, padding=1)
        self.blocks = nn.Sequential(*(_EscnnBlock(block, initialize) for block in ours.blocks))
        self.group_pool = enn.GroupPooling(self.blocks[-1].out_type)

    def forward(self, image: Tensor) -> Tensor:
        x = enn.GeometricTensor((image - self.background) * self.mask, self.stem.in_type)
        x = self.pool(self.relu(self.norm(self.stem(x))))
        return self.group_pool(self.blocks(x)).tensor


class _EscnnBlock(nn.Module):
    def __init__(self, ours: C4BasicBlock, initialize: bool) -> None:
        super().__init__()
        self.conv1, self.norm1 = _conv(ours.conv1, initialize), _norm(ours.norm1)
        self.conv2, self.norm2 = _conv(ours.conv2, initialize), _norm(ours.norm2)
        self.out_type = self.conv2.out_type
        self.relu = enn.ReLU(self.out_type)
        self.shortcut: nn.Module = nn.Identity()
        if isinstance(ours.shortcut, nn.Sequential):
            self.shortcut = nn.Sequential(
                _conv(ours.shortcut[0], initialize), _norm(ours.shortcut[1])
            )

    def forward(self, x: enn.GeometricTensor) -> enn.GeometricTensor:
        out = self.relu(self.norm1(self.conv1(x)))
        return self.relu(self.norm2(self.conv2(out)) + self.shortcut(x))


def _conv(ours: C4Conv, initialize: bool) -> enn.R2Conv:
    conv = enn.R2Conv(
        ours.in_type,
        ours.out_type,
        ours.kernel_size,
        stride=ours.stride,
        padding=ours.padding,
        bias=ours.bias is not None,
        initialize=initialize,
    )
    with torch.no_grad():
        conv.weights.copy_(ours.weights)
        if ours.bias is not None:
            conv.bias.copy_(ours.bias)
    return conv


def _norm(ours: C4BatchNorm) -> enn.InnerBatchNorm:
    norm = enn.InnerBatchNorm(regular_type(ours.num_features), eps=ours.eps)
    (inner,) = (m for m in norm.modules() if isinstance(m, nn.BatchNorm3d))
    inner.load_state_dict(ours.state_dict())
    return norm


class DirectHead(nn.Module):
    """Projector and group convolution as published: the tensor over group, vertices and features.

    The map goes through the 1×1 convolution first and is sampled then; every group element meets
    the whole filter: (B, 60, V, n, m) numbers.
    """

    moved: Tensor
    sampling: Tensor

    def __init__(self, projector: IcosahedralProjector, group_conv: DynamicFilterConv) -> None:
        super().__init__()
        self.linear = projector.linear
        self.register_buffer("sampling", projector.sampling)
        self.sphere, self.bias = group_conv.sphere, group_conv.bias
        self.features, self.out_features = group_conv.features, group_conv.out_features
        mesh = icosahedron(1)
        self.register_buffer("moved", mesh.action[:, mesh.visible])

    def forward(self, features: Tensor, index: Tensor | None = None) -> Tensor:
        """(B, C, S, S) -> (B, 60, out_features)."""
        weight = self.linear.weight[:, :, None, None]
        wide = nn.functional.conv2d(features, weight, self.linear.bias)
        signal = torch.relu(torch.einsum("bcs,vs->bvc", wide.flatten(2), self.sampling))
        psi = signal.view(len(signal), 1, -1, self.features, self.out_features)
        placed = self.sphere[0][self.moved][None, ..., None]  # (1, 60, V, n, 1)
        return (placed * psi).sum(dim=(2, 3)) + self.bias[0]


class _Trunk(nn.Module):
    def __init__(self, encoder: nn.Module, head: nn.Module) -> None:
        super().__init__()
        self.encoder, self.head = encoder, head

    def forward(self, image: Tensor, index: Tensor | None = None) -> Tensor:
        return self.head(self.encoder(image), index)


def published(ours: I2IPose) -> I2IPose:
    """`ours` with escnn's encoder and the direct head, in its place; the weights are copies."""
    trunk = ours.trunk
    assert isinstance(trunk, I2ITrunk)
    assert isinstance(trunk.encoder, C4ResNet18)
    head = DirectHead(trunk.projector, trunk.group_conv)  # type: ignore[arg-type]
    ours.trunk = _Trunk(escnn_encoder(trunk.encoder), head)  # type: ignore[assignment]
    return ours


class PlainResNet18(nn.Module):
    """The encoder's widths and strides in plain `torch.nn`: what its dense convolutions cost."""

    def __init__(self, ours: C4ResNet18) -> None:
        super().__init__()
        self.out_channels, self.map_size = ours.out_channels, ours.map_size

        def conv(layer: C4Conv) -> nn.Conv2d:
            return nn.Conv2d(
                layer.in_type.size, layer.out_type.size, layer.kernel_size,
                stride=layer.stride, padding=layer.padding, bias=layer.bias is not None,
            )  # fmt: skip

        self.stem = nn.Sequential(conv(ours.stem), nn.BatchNorm2d(ours.stem.out_type.size))
        self.pool = ours.max_pool
        self.blocks = nn.ModuleList()
        for block in ours.blocks:
            size = block.conv1.out_type.size
            parts = nn.ModuleDict(
                {
                    "first": nn.Sequential(conv(block.conv1), nn.BatchNorm2d(size), nn.ReLU()),
                    "second": nn.Sequential(conv(block.conv2), nn.BatchNorm2d(size)),
                    "shortcut": nn.Identity(),
                }
            )
            if isinstance(block.shortcut, nn.Sequential):
                parts["shortcut"] = nn.Sequential(conv(block.shortcut[0]), nn.BatchNorm2d(size))
            self.blocks.append(parts)

    def forward(self, image: Tensor) -> Tensor:
        """(B, C, H, W) -> (B, out_channels, S, S)."""
        x = self.pool(torch.relu(self.stem(image)))
        for block in self.blocks:
            x = torch.relu(block["second"](block["first"](x)) + block["shortcut"](x))
        return x.view(len(x), -1, 4, *x.shape[2:]).amax(dim=2)
