"""What the baselines share: an encoder, one feature vector for an image, a loss on rotations."""

from collections.abc import Callable, Mapping

import torch
from torch import Tensor, nn

from i2i.models.prediction import ClassPrediction, PosePrediction
from i2i.nn.c4 import TURNS
from i2i.nn.encoders import check_encoder
from i2i.nn.losses import rotation_distance
from i2i.nn.precision import at_least_float32

LOSSES = ("frobenius", "mse")

Component = Callable[..., nn.Module]
Batch = Mapping[str, Tensor]


def make_encoder(
    encoder: Component | nn.Module, *, channels: int, image_size: int
) -> tuple[nn.Module, int]:
    """An encoder from its factory, or as it is, and how many channels come out of it.

    See `i2i.nn.encoders.Encoder`.

    Raises:
        TypeError: If it lacks an attribute that an encoder must have.
    """
    if not isinstance(encoder, nn.Module):
        encoder = encoder(in_channels=channels, image_size=image_size)
    check_encoder(encoder)
    out_channels: int = encoder.out_channels  # type: ignore[assignment]
    return encoder, out_channels


def check_regular(encoder: nn.Module) -> nn.Module:
    """Return `encoder` if it gives regular C4 fields.

    Raises:
        TypeError: If it has no `regular_map`.
    """
    if not hasattr(encoder, "regular_map"):
        raise TypeError(
            f"{type(encoder).__name__} has no `regular_map`: this network needs the fields of an "
            "encoder that turns with the image, such as model/encoder=c4_resnet18"
        )
    return encoder


def pool(features: Tensor) -> Tensor:
    """Spatial mean in float32 or wider: (B, C, H, W) -> (B, C)."""
    return at_least_float32(features).mean(dim=(2, 3))


def pool_regular(features: Tensor) -> Tensor:
    """Spatial mean of regular fields, in float32 or wider: (B, 4F, H, W) -> (B, F, 4)."""
    return pool(features).unflatten(1, (-1, TURNS))


def known_class(batch: Batch, num_classes: int) -> Tensor | None:
    """`class_id` (B,) where one network serves several classes, else None.

    Raises:
        ValueError: If it is needed and missing.
    """
    if num_classes == 1:
        return None
    if "class_id" not in batch:
        raise ValueError(
            f"the network serves {num_classes} classes and the batch has no class_id: "
            "give the index of each image's class"
        )
    return batch["class_id"]


def class_size(num_classes: int) -> int:
    """How many numbers `append_class` adds to a feature."""
    return num_classes if num_classes > 1 else 0


def append_class(feature: Tensor, class_id: Tensor | None, num_classes: int) -> Tensor:
    """The feature (B, F) with the one-hot class (B, K) behind it where a class is given."""
    if class_id is None:
        return feature
    one_hot = torch.eye(num_classes, dtype=feature.dtype, device=feature.device)[class_id]
    return torch.cat([feature, one_hot], dim=1)


class RotationLoss(nn.Module):
    """Distance of matrices, mean over the batch.

    Args:
        kind: `"frobenius"`: the norm of the difference, not squared (the published "L2" loss);
            `"mse"`: the mean of its nine squares.

    Raises:
        ValueError: If the kind is unknown.

    Example:
        >>> RotationLoss("mse")(torch.zeros(2, 3, 3), torch.ones(2, 3, 3))
        tensor(1.)
    """

    def __init__(self, kind: str = "frobenius") -> None:
        super().__init__()
        if kind not in LOSSES:
            raise ValueError(f"loss={kind!r} is not known: choose one of {', '.join(LOSSES)}")
        self.kind = kind

    def forward(self, rotation: Tensor, target: Tensor) -> Tensor:
        """A scalar for two stacks of matrices (B, 3, 3)."""
        if self.kind == "mse":
            return (rotation - target).square().mean()
        return rotation_distance(rotation, target).mean()

    def extra_repr(self) -> str:
        """The kind."""
        return self.kind


class PooledPose(nn.Module):
    """Encoder, spatial mean, head: one rotation (object -> camera) for an image.

    One network serves one class, as in the paper. Where the data have several, the known class is
    appended to the feature as a one-hot vector.

    Args:
        encoder: Called as `encoder(in_channels=..., image_size=...)`, or a module that is ready.
        head: Makes a module (B, F) -> (B, 3, 3), called with F.
        channels: Channels of the image.
        num_classes: Classes K of the data.
        image_size: Side of the image in pixels.
        loss: See `RotationLoss`.

    Raises:
        TypeError: If the encoder lacks an attribute.
        ValueError: If the loss is unknown.
    """

    def __init__(
        self,
        encoder: Component | nn.Module,
        head: Component,
        *,
        channels: int,
        num_classes: int,
        image_size: int,
        loss: str = "frobenius",
    ) -> None:
        super().__init__()
        self.num_classes = num_classes
        self.criterion = RotationLoss(loss)
        self.encoder, size = make_encoder(encoder, channels=channels, image_size=image_size)
        self.head = head(size + class_size(num_classes))

    def forward(self, batch: Batch) -> PosePrediction:
        """Predict for `image` (B, C, S, S), and `class_id` (B,) where there are several classes."""
        class_id = known_class(batch, self.num_classes)
        feature = append_class(pool(self.encoder(batch["image"])), class_id, self.num_classes)
        return PosePrediction(rotation=self.head(feature))

    def loss(self, prediction: PosePrediction, batch: Batch) -> dict[str, Tensor]:
        """`regression`: the distance of the rotations."""
        return {"regression": self.criterion(prediction.rotation, batch["rotation"])}


class FeatureClassifier(nn.Module):
    """Class of an object: a linear layer on one feature vector, which is the descriptor.

    Subclasses say in `feature` how the vector is made.

    Args:
        encoder: Called as `encoder(in_channels=..., image_size=...)`, or a module that is ready.
        channels: Channels of the image.
        num_classes: Number of classes.
        image_size: Side of the image in pixels.

    Raises:
        TypeError: If the encoder lacks an attribute.
    """

    def __init__(
        self,
        encoder: Component | nn.Module,
        *,
        channels: int,
        num_classes: int,
        image_size: int,
    ) -> None:
        super().__init__()
        self.num_classes = num_classes
        self.encoder, size = make_encoder(encoder, channels=channels, image_size=image_size)
        self.classifier = nn.Linear(size, num_classes)

    def feature(self, image: Tensor) -> Tensor:
        """One vector for each image: (B, channels, S, S) -> (B, F)."""
        raise NotImplementedError

    def forward(self, batch: Batch) -> ClassPrediction:
        """Logits (B, C) and descriptor (B, F) for `image` (B, channels, S, S)."""
        feature = self.feature(batch["image"])
        logits = at_least_float32(self.classifier(feature))
        return ClassPrediction(logits=logits, descriptor=feature)

    def loss(self, prediction: ClassPrediction, batch: Batch) -> dict[str, Tensor]:
        """Cross-entropy with `class_id` (B,)."""
        loss = nn.functional.cross_entropy(prediction.logits, batch["class_id"])
        return {"classification": loss}
