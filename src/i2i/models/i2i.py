"""I2I: encoder, projector, icosahedral group convolution and head, for pose and for class."""

import inspect
from collections.abc import Callable, Mapping

import torch
from torch import Tensor, nn

from i2i.geometry.icosahedron import Frame, MeshAxis, icosahedron
from i2i.models.prediction import ClassPrediction, PosePrediction
from i2i.nn.encoders import check_encoder
from i2i.nn.heads import (
    POSE_FEATURES,
    TARGETS,
    candidate_rotations,
    pose_target,
    split_group_output,
)
from i2i.nn.losses import ClassifyThenRegressLoss, GroupTarget, group_target
from i2i.nn.precision import at_least_float32

POOLINGS = ("max", "mean", "mean_after_relu")

Component = Callable[..., nn.Module]
Batch = Mapping[str, Tensor]


class I2ITrunk(nn.Module):
    """Image -> map -> signal on the icosahedron -> function on the group.

    Args:
        encoder: Called as `encoder(in_channels=..., image_size=...)`, or a module that is ready. It
            must have `out_channels` and `map_size`.
        projector: Called as `projector(in_channels, out_channels, map_size=...)`.
        group_conv: Called as `group_conv(out_features=..., num_spheres=...)`; its
            `filter_channels` is what the projector gives. One that names a parameter
            `in_channels` is told the encoder's width.
        channels: Channels of the image.
        image_size: Side of the image in pixels.
        out_features: Outputs for each group element.
        num_spheres: Feature spheres to choose from.

    Raises:
        TypeError: If the encoder lacks an attribute.
        ValueError: If projector and group convolution do not fit each other.
    """

    def __init__(
        self,
        encoder: Component | nn.Module,
        projector: Component,
        group_conv: Component,
        *,
        channels: int,
        image_size: int,
        out_features: int,
        num_spheres: int,
    ) -> None:
        super().__init__()
        if not isinstance(encoder, nn.Module):
            encoder = encoder(in_channels=channels, image_size=image_size)
        self.encoder = check_encoder(encoder)
        told = {}
        if "in_channels" in inspect.signature(group_conv).parameters:
            told["in_channels"] = self.encoder.out_channels
        self.group_conv = group_conv(out_features=out_features, num_spheres=num_spheres, **told)
        self.projector = projector(
            self.encoder.out_channels,
            self.group_conv.filter_channels,
            map_size=self.encoder.map_size,
        )
        self._check_fit()

    def _check_fit(self) -> None:
        """Refuse a projector that samples another mesh than the group convolution works on."""
        for name, what, remedy in (
            (
                "num_vertices",
                "a signal of length",
                "give both the same mesh_level, or choose a model/projector and a model/group_conv "
                "that belong together (full_group with full_group and the same support; none with "
                "the same reading)",
            ),
            ("mesh_axis", "the mesh_axis", "give both the same, with model.mesh_axis"),
        ):
            given = getattr(self.projector, name, None)
            wanted = getattr(self.group_conv, name, given)
            if given is not None and given != wanted:
                raise ValueError(
                    f"the projector gives {what} {given} and the group convolution wants "
                    f"{wanted}: {remedy}"
                )

    def forward(self, image: Tensor, sphere_index: Tensor | None = None) -> Tensor:
        """(B, C, S, S) and an index (B,) or None -> (B, 60, out_features)."""
        return self.group_conv(self.projector(self.encoder(image)), sphere_index)


class I2IPose(nn.Module):
    """Rotation of an object from one image (paper §4).

    Each of the 60 group elements gets a logit and a residual rotation; the prediction is the
    residual of the best element times that element.

    Args:
        encoder: See `I2ITrunk`.
        projector: See `I2ITrunk`.
        group_conv: See `I2ITrunk`.
        channels: Channels of the image.
        num_classes: Classes of the data; each has its own feature sphere, chosen by `class_id`.
        image_size: Side of the image in pixels.
        target: What is classified: `"view"` (camera -> object), which fits the convolution, or
            `"rotation"` (object -> camera) as in the published code.
        group_frame: Which 60 matrices the labels refer to: `"conjugated"`, those of the mesh as it
            is sampled, or `"standard"`, the published code's, without the tilt of the mesh.
        regression_weight: λ of the residual term (paper: 100).
        reg_on: Which residuals are trained, see `ClassifyThenRegressLoss`.
        labels: `"hard"` or `"soft"`.
        soft_width_rad: Width of soft labels.
        squared: Square the residual's norm.

    Raises:
        ValueError: If a choice is unknown or the parts do not fit.
    """

    elements: Tensor

    def __init__(
        self,
        encoder: Component | nn.Module,
        projector: Component,
        group_conv: Component,
        *,
        channels: int,
        num_classes: int,
        image_size: int,
        target: str = "view",
        group_frame: Frame = "conjugated",
        regression_weight: float = 100.0,
        reg_on: str = "auto",
        labels: str = "hard",
        soft_width_rad: float = 0.35,
        squared: bool = False,
    ) -> None:
        super().__init__()
        if target not in TARGETS:
            raise ValueError(f"target={target!r} is not known: choose one of {', '.join(TARGETS)}")
        self.target, self.num_classes = target, num_classes
        self.trunk = I2ITrunk(
            encoder,
            projector,
            group_conv,
            channels=channels,
            image_size=image_size,
            out_features=POSE_FEATURES,
            num_spheres=num_classes,
        )
        self.criterion = ClassifyThenRegressLoss(
            regression_weight=regression_weight,
            reg_on=reg_on,
            labels=labels,
            soft_width_rad=soft_width_rad,
            squared=squared,
        )
        # The labels' group is turned with the mesh whose numbers the group convolution uses.
        mesh_axis: MeshAxis = getattr(self.trunk.group_conv, "mesh_axis", "vertex")
        elements = icosahedron(frame=group_frame, mesh_axis=mesh_axis).rotations.float()
        self.register_buffer("elements", elements, persistent=False)

    def forward(self, batch: Batch) -> PosePrediction:
        """Predict for `image` (B, C, S, S), and `class_id` (B,) where there are several classes."""
        index = batch.get("class_id") if self.num_classes > 1 else None
        logits, residual = split_group_output(self.trunk(batch["image"], index))
        candidates = candidate_rotations(residual, self.elements, self.target)
        return PosePrediction.of_candidates(logits, candidates, residual=residual)

    def group_target(self, batch: Batch) -> GroupTarget:
        """The label of each sample: nearest element, angles and residuals of the `rotation`."""
        return group_target(pose_target(batch["rotation"], self.target), self.elements)

    def group_correct(self, prediction: PosePrediction, batch: Batch) -> Tensor:
        """Whether the best element is the one nearest to the target: (B,) bool."""
        if prediction.logits is None:
            raise ValueError("the prediction has no logits over the group")
        return prediction.logits.argmax(dim=1) == self.group_target(batch).element

    def loss(self, prediction: PosePrediction, batch: Batch) -> dict[str, Tensor]:
        """`classification` and `regression`, weighted, to be added up."""
        if prediction.logits is None:
            raise ValueError("the prediction has no logits over the group")
        return self.criterion(
            prediction.logits, prediction.extras["residual"], self.group_target(batch)
        )

    def extra_repr(self) -> str:
        """The label's frame."""
        return f"target={self.target}"


class I2IClassifier(nn.Module):
    """Class of an object in any orientation (paper appendix).

    The function on the group has one channel for each class and is pooled over the 60 elements.

    Args:
        encoder: See `I2ITrunk`.
        projector: See `I2ITrunk`.
        group_conv: See `I2ITrunk`; one sphere serves all classes.
        channels: Channels of the image.
        num_classes: Number of classes C.
        image_size: Side of the image in pixels.
        pooling: `"max"` (published code), `"mean"` (paper appendix; the layer is linear, so this
            is a read-out of the signal summed over the two vertex orbits and knows nothing of
            rotations), or `"mean_after_relu"`.

    Raises:
        ValueError: If the pooling is unknown or the parts do not fit.
    """

    def __init__(
        self,
        encoder: Component | nn.Module,
        projector: Component,
        group_conv: Component,
        *,
        channels: int,
        num_classes: int,
        image_size: int,
        pooling: str = "max",
    ) -> None:
        super().__init__()
        if pooling not in POOLINGS:
            raise ValueError(
                f"pooling={pooling!r} is not known: choose one of {', '.join(POOLINGS)}"
            )
        self.pooling, self.num_classes = pooling, num_classes
        self.trunk = I2ITrunk(
            encoder,
            projector,
            group_conv,
            channels=channels,
            image_size=image_size,
            out_features=num_classes,
            num_spheres=1,
        )

    def forward(self, batch: Batch) -> ClassPrediction:
        """Logits (B, C) for `image` (B, channels, S, S); they are the descriptor as well."""
        output = at_least_float32(self.trunk(batch["image"]))  # (B, 60, C)
        if self.pooling == "max":
            logits = output.amax(dim=1)
        elif self.pooling == "mean":
            logits = output.mean(dim=1)
        else:
            logits = torch.relu(output).mean(dim=1)
        return ClassPrediction(logits=logits, descriptor=logits)

    def loss(self, prediction: ClassPrediction, batch: Batch) -> dict[str, Tensor]:
        """Cross-entropy with `class_id` (B,)."""
        loss = nn.functional.cross_entropy(prediction.logits, batch["class_id"])
        return {"classification": loss}

    def extra_repr(self) -> str:
        """The pooling."""
        return f"pooling={self.pooling}"
