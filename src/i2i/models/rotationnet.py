"""RotationNet: which view was seen from which camera is latent."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor, nn

from i2i.geometry.view_sets import view_permutations
from i2i.models.pooled import Component
from i2i.models.prediction import ClassPrediction
from i2i.models.views import ViewFeatures, camera_set_of
from i2i.nn.precision import at_least_float32


@dataclass
class AssignedClassPrediction(ClassPrediction):
    """Class scores by the best assignment of views to cameras.

    Attributes:
        pair_log_prob: (B, V, V, C + 1) for view i and camera v: log probabilities of the classes,
            and at the end that v is not where i was taken from.
        assignment: (B,) number of the best assignment.
    """

    pair_log_prob: Tensor
    assignment: Tensor


class RotationNet(nn.Module):
    """Multi-view classification baseline RotationNet of the paper (Table 3).

    Each view says for each of the V cameras of the set: an object of class c, seen from there, or
    "not from there". The views are those of the cameras up to one of the 60 rotations, so there are
    60 assignments of views to cameras. The class is that of the best pair of assignment and class;
    `logits` are the scores of all classes under that assignment, whose largest is the same. The
    descriptor is the mean of the trunk's features over the views. A permutation of the views by the
    group changes neither.

    Args:
        trunk: See `ViewFeatures`; AlexNet in the original.
        channels: Channels of a view, 1 or 3.
        num_classes: Number of classes C.
        image_size: Side of a view in pixels.
        num_views: V: 12, 20 or 60; says which cameras they are.
        pretrained: A weight file for the trunk; None starts from scratch.
        permutations: Assignments (J, V) in place of the group's: number of the view that camera v
            took under assignment j.

    Raises:
        ValueError: If the number of views fits no set of cameras, or the weights do not fit.

    Reference:
        Kanezaki et al. 2018, "RotationNet: Joint Object Categorization and Pose Estimation Using
        Multiviews from Unsupervised Viewpoints".
    """

    permutations: Tensor

    def __init__(
        self,
        trunk: Component | nn.Module,
        *,
        channels: int,
        num_classes: int,
        image_size: int,
        num_views: int,
        pretrained: str | Path | None = None,
        permutations: Tensor | None = None,
    ) -> None:
        super().__init__()
        if permutations is None:
            permutations = view_permutations(camera_set_of(num_views))
        if permutations.shape[1:] != (num_views,):
            raise ValueError(
                f"permutations {tuple(permutations.shape)} are not of num_views={num_views}"
            )
        self.num_classes, self.num_views = num_classes, num_views
        self.views = ViewFeatures(
            trunk, channels=channels, image_size=image_size, num_views=num_views,
            pretrained=pretrained,
        )  # fmt: skip
        self.classifier = nn.Linear(self.views.out_channels, num_views * (num_classes + 1))
        self.register_buffer("permutations", permutations, persistent=False)

    def forward(self, batch: Mapping[str, Tensor]) -> AssignedClassPrediction:
        """Scores (B, C), descriptor (B, F) and what the loss needs for `views` (B, V, ...)."""
        feature = self.views(batch["views"])
        pairs = at_least_float32(self.classifier(feature))  # (B, V, V · (C + 1))
        log_prob = pairs.unflatten(2, (self.num_views, -1)).log_softmax(dim=-1)
        with torch.no_grad():
            best = assignment_scores(log_prob, self.permutations).amax(dim=2).argmax(dim=1)
        return AssignedClassPrediction(
            logits=scores_under(log_prob, self.permutations[best]),
            descriptor=feature.mean(dim=1),
            pair_log_prob=log_prob,
            assignment=best,
        )

    def loss(
        self, prediction: AssignedClassPrediction, batch: Mapping[str, Tensor]
    ) -> dict[str, Tensor]:
        """Cross-entropy of all V·V pairs of view and camera, mean.

        The assignment is the one that is best for the true class `class_id` (B,).
        """
        log_prob, class_id = prediction.pair_log_prob, batch["class_id"]
        with torch.no_grad():
            scores = assignment_scores(log_prob, self.permutations)  # (B, 60, C)
            best = scores[torch.arange(len(scores)), :, class_id].argmax(dim=1)
            target = pair_targets(self.permutations[best], class_id, self.num_classes)
        loss = nn.functional.nll_loss(log_prob.flatten(0, 2), target.flatten())
        return {"classification": loss}

    def extra_repr(self) -> str:
        """How many views, assignments and classes."""
        return (
            f"{self.num_views} views, {len(self.permutations)} assignments, "
            f"{self.num_classes} classes"
        )


def pair_scores(log_prob: Tensor) -> Tensor:
    """By how much a class is likelier than "not from there": (..., C + 1) -> (..., C)."""
    return log_prob[..., :-1] - log_prob[..., -1:]


def scores_under(log_prob: Tensor, assignment: Tensor) -> Tensor:
    """Scores of the classes under one assignment for each object: (B, C).

    Args:
        log_prob: (B, V, V, C + 1) for view and camera.
        assignment: (B, V): the view that each camera took.
    """
    objects = torch.arange(len(log_prob), device=log_prob.device)[:, None]
    cameras = torch.arange(assignment.shape[1], device=log_prob.device)
    return pair_scores(log_prob[objects, assignment, cameras]).sum(dim=1)


def assignment_scores(log_prob: Tensor, permutations: Tensor) -> Tensor:
    """Scores of the classes under every assignment, `Σ_v s(perm[j, v], v, c)`: (B, J, C).

    Args:
        log_prob: (B, V, V, C + 1) for view and camera.
        permutations: (J, V): the view that each camera took.
    """
    cameras = torch.arange(permutations.shape[1], device=permutations.device)
    return pair_scores(log_prob)[:, permutations, cameras].sum(dim=2)


def pair_targets(assignment: Tensor, class_id: Tensor, num_classes: int) -> Tensor:
    """What every view should say for every camera, (B, V, V) for view and camera.

    The true class where the assignment (B, V) has the view at the camera; everywhere else
    `num_classes`, which is "not from there".
    """
    views = torch.arange(assignment.shape[1], device=assignment.device)
    placed = assignment[:, None, :] == views[:, None]
    return torch.where(placed, class_id[:, None, None], num_classes)
