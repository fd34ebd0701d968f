"""Rotation error and what is reported of it."""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor
from torchmetrics import Metric
from torchmetrics.utilities import dim_zero_cat

from i2i.geometry.rotations import geodesic_angle_rad
from i2i.geometry.symmetries import symmetric_angle_rad
from i2i.metrics.bootstrap import Interval, instance_bootstrap

FLIP_DEG = 150.0
ACCURACY_DEG = (15, 30)


def error_deg(prediction: Tensor, target: Tensor) -> Tensor:
    """Angle of the rotation between two rotations in degrees, in float64: (..., 3, 3) -> (...,).

    Example:
        >>> half_turn = torch.diag(torch.tensor([-1.0, -1.0, 1.0]))
        >>> error_deg(half_turn, torch.eye(3)).item()
        180.0
    """
    return torch.rad2deg(geodesic_angle_rad(prediction.double(), target.double()))


def pose_scores(errors: Tensor) -> dict[str, Tensor]:
    """Median, mean, accuracies and flip rate of errors in degrees (N,).

    The median averages the two middle values: `torch.median` takes the lower one.
    """
    scores = {"median_error_deg": errors.quantile(0.5), "mean_error_deg": errors.mean()}
    for limit in ACCURACY_DEG:
        scores[f"acc_at_{limit}deg"] = (errors < limit).double().mean()
    scores["flip_rate"] = (errors > FLIP_DEG).double().mean()
    return scores


class PoseErrors(Metric):
    """Errors of all views and their scores: over all views and for each class.

    `compute()` gives `median_error_deg`, `mean_error_deg`, `acc_at_15deg`, `acc_at_30deg`,
    `flip_rate` (beyond 150°) and, where it was told, `group_accuracy`; each as `<class>/<score>`;
    `mean_class_median_error_deg`, the paper's average; and `<class>/median_symmetric_error_deg`,
    the error to the nearest rotation that looks the same, for classes with a symmetry.

    Args:
        class_names: Names by class id.
        symmetry: `"none"`, `"z"` or `"z2"` for each class; all `"none"` when left out.
        **options: Of `torchmetrics.Metric`, such as `sync_on_compute=False`.

    Example:
        >>> metric = PoseErrors(["car"])
        >>> metric.update(torch.eye(3)[None], torch.eye(3)[None])
        >>> metric.compute()["median_error_deg"].item()
        0.0
    """

    is_differentiable = False
    higher_is_better = False
    full_state_update = False

    errors: list[Tensor]
    symmetric_errors: list[Tensor]
    class_ids: list[Tensor]
    instance_ids: list[Tensor]
    group_flags: list[Tensor]

    def __init__(
        self,
        class_names: Sequence[str] = ("all",),
        symmetry: Sequence[str] | None = None,
        **options: Any,  # noqa: ANN401 - torchmetrics' own
    ) -> None:
        super().__init__(**options)
        self.class_names = tuple(class_names)
        self.symmetry = tuple(symmetry) if symmetry is not None else ("none",) * len(class_names)
        if len(self.symmetry) != len(self.class_names):
            raise ValueError(
                f"{len(self.class_names)} classes and {len(self.symmetry)} symmetries: "
                "give one for each class"
            )
        for name in ("errors", "symmetric_errors", "class_ids", "instance_ids", "group_flags"):
            self.add_state(name, default=[], dist_reduce_fx="cat")

    def update(
        self,
        prediction: Tensor,
        target: Tensor,
        class_id: Tensor | None = None,
        instance_id: Tensor | None = None,
        group_correct: Tensor | None = None,
    ) -> None:
        """Add a batch.

        Args:
            prediction: (B, 3, 3) predicted `rotation`.
            target: (B, 3, 3) true `rotation`.
            class_id: (B,); zeros when left out.
            instance_id: (B,), which object each view shows; only for intervals.
            group_correct: (B,) bool: whether the right group element was chosen. Give it for all
                batches or for none.
        """
        prediction, target = prediction.detach(), target.detach()
        zeros = torch.zeros(len(target), dtype=torch.int64, device=target.device)
        self.errors.append(error_deg(prediction, target))
        class_id = zeros if class_id is None else class_id
        self.symmetric_errors.append(self._symmetric_error_deg(prediction, target, class_id))
        self.class_ids.append(class_id)
        self.instance_ids.append(zeros if instance_id is None else instance_id)
        if group_correct is not None:
            self.group_flags.append(group_correct)

    def _symmetric_error_deg(self, prediction: Tensor, target: Tensor, class_id: Tensor) -> Tensor:
        errors = torch.zeros(len(target), dtype=torch.float64, device=target.device)
        for index, symmetry in enumerate(self.symmetry):
            mine = class_id == index
            angle = symmetric_angle_rad(prediction[mine].double(), target[mine].double(), symmetry)
            errors[mine] = torch.rad2deg(angle)
        return errors

    def compute(self) -> dict[str, Tensor]:
        """The scores, see the class."""
        errors, class_ids = dim_zero_cat(self.errors), dim_zero_cat(self.class_ids)
        flags = dim_zero_cat(self.group_flags).double() if len(self.group_flags) else None
        scores = pose_scores(errors)
        if flags is not None:
            scores["group_accuracy"] = flags.mean()
        medians = []
        for index, name in enumerate(self.class_names):
            mine = class_ids == index
            if not mine.any():
                continue
            of_class = pose_scores(errors[mine])
            medians.append(of_class["median_error_deg"])
            if flags is not None:
                of_class["group_accuracy"] = flags[mine].mean()
            if self.symmetry[index] != "none":
                symmetric = dim_zero_cat(self.symmetric_errors)[mine]
                of_class["median_symmetric_error_deg"] = symmetric.quantile(0.5)
            scores |= {f"{name}/{key}": value for key, value in of_class.items()}
        scores["mean_class_median_error_deg"] = torch.stack(medians).mean()
        return scores

    def median_intervals(self, *, num_resamples: int = 1000, seed: int = 0) -> dict[str, Interval]:
        """95 % intervals of the median error of each class, resampling instances."""
        errors, class_ids = dim_zero_cat(self.errors), dim_zero_cat(self.class_ids)
        instance_ids = dim_zero_cat(self.instance_ids)
        intervals = {}
        for index, name in enumerate(self.class_names):
            mine = class_ids == index
            if mine.any():
                intervals[name] = instance_bootstrap(
                    errors[mine], instance_ids[mine], num_resamples=num_resamples, seed=seed
                )
        return intervals
