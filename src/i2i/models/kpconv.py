"""Rigid KPConv: a class or a rotation from a point cloud."""

from collections.abc import Mapping

from torch import Tensor, nn

from i2i.models.pooled import RotationLoss, append_class, class_size, known_class
from i2i.models.prediction import ClassPrediction, PosePrediction
from i2i.nn.kernel_point_conv import KernelPointTrunk
from i2i.nn.precision import at_least_float32
from i2i.nn.rotation_heads import GramSchmidtHead

_SLOPE = 0.1

Batch = Mapping[str, Tensor]


class KernelPointClassifier(nn.Module):
    """Point-cloud classification baseline KPConv of the paper (Table 3): rigid KP-CNN.

    Kernel-point trunk, average over a cloud, a hidden layer, a linear layer. The descriptor is what
    the last layer sees.

    Args:
        num_points: Points of a cloud; others than these are taken as well.
        num_classes: Number of classes C.
        width: Channels of the first block, w; the descriptor has 32·w.
        cell: Side of a cell of the first grid, in radii of the cloud.
        neighbours: See `KernelPointTrunk`.
        seed: Of the kernel points, which the checkpoint keeps.

    Raises:
        ValueError: If the width is odd or the cell not positive.

    Reference:
        Thomas et al. 2019, "KPConv: Flexible and Deformable Convolution for Point Clouds".
    """

    def __init__(
        self,
        *,
        num_points: int,
        num_classes: int,
        width: int = 32,
        cell: float = 0.02,
        neighbours: int = 48,
        seed: int = 0,
    ) -> None:
        super().__init__()
        self.num_points = num_points
        self.trunk = KernelPointTrunk(width=width, cell=cell, neighbours=neighbours, seed=seed)
        size = self.trunk.out_channels
        self.hidden = nn.Sequential(nn.Linear(size, size), nn.LeakyReLU(_SLOPE))
        self.classifier = nn.Linear(size, num_classes)

    def forward(self, batch: Batch) -> ClassPrediction:
        """Logits (B, C) and descriptor (B, F) for `points` (B, N, 3)."""
        descriptor = self.hidden(self.trunk(batch["points"]))
        logits = self.classifier(descriptor)
        return ClassPrediction(
            logits=at_least_float32(logits), descriptor=at_least_float32(descriptor)
        )

    def loss(self, prediction: ClassPrediction, batch: Batch) -> dict[str, Tensor]:
        """Cross-entropy with `class_id` (B,)."""
        loss = nn.functional.cross_entropy(prediction.logits, batch["class_id"])
        return {"classification": loss}


class KernelPointPose(nn.Module):
    """Rotation (object -> camera) of a partial point cloud, by the trunk of the classifier.

    One of two readings of the paper's row KPConv (Table 1): average over the cloud, a hidden layer,
    six numbers, Gram-Schmidt.

    Args:
        num_points: Points of a cloud; others than these are taken as well.
        num_classes: Classes of the data; where there are several, the known one is appended to the
            average.
        width: See `KernelPointClassifier`.
        cell: See `KernelPointClassifier`.
        neighbours: See `KernelPointTrunk`.
        seed: See `KernelPointClassifier`.
        loss: See `RotationLoss`.

    Raises:
        ValueError: If the width is odd, the cell not positive or the loss unknown.
    """

    def __init__(
        self,
        *,
        num_points: int,
        num_classes: int,
        width: int = 32,
        cell: float = 0.02,
        neighbours: int = 48,
        seed: int = 0,
        loss: str = "frobenius",
    ) -> None:
        super().__init__()
        self.num_points, self.num_classes = num_points, num_classes
        self.criterion = RotationLoss(loss)
        self.trunk = KernelPointTrunk(width=width, cell=cell, neighbours=neighbours, seed=seed)
        size = self.trunk.out_channels
        self.hidden = nn.Sequential(
            nn.Linear(size + class_size(num_classes), size), nn.LeakyReLU(_SLOPE)
        )
        self.head = GramSchmidtHead(size)

    def forward(self, batch: Batch) -> PosePrediction:
        """Predict for `points` (B, N, 3), and `class_id` (B,) where there are several classes."""
        class_id = known_class(batch, self.num_classes)
        feature = append_class(self.trunk(batch["points"]), class_id, self.num_classes)
        return PosePrediction(rotation=self.head(self.hidden(feature)))

    def loss(self, prediction: PosePrediction, batch: Batch) -> dict[str, Tensor]:
        """`regression`: the distance of the rotations."""
        return {"regression": self.criterion(prediction.rotation, batch["rotation"])}
