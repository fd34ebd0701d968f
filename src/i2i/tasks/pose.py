"""Orientation of an object from one image."""

from typing import Any

import torch
from torch import Tensor, nn
from torchmetrics import MeanMetric

from i2i.metrics.likelihood import ConcentrationFit, probability_within, spread_deg
from i2i.metrics.rotation import PoseErrors
from i2i.models.prediction import PosePrediction
from i2i.tasks.base import Batch, Task

_MEANS = ("log_likelihood", "spread_deg", "point_log_likelihood", "point_spread_deg")
_SAMPLES = 200  # of each image's distribution, for its calibration


class PoseTask(Task):
    """Trains and scores a pose network; errors are angles in degrees.

    Logs `val/...` and `test/...` of `PoseErrors`: median and mean error, fractions under 15° and
    30°, flips beyond 150°, accuracy over the 60 elements where the network has them, and each
    per class.

    A network without a density of its own is given one: isotropic components of one concentration
    around its candidates, or around its best guess, fitted on the images of each validation and
    kept with the weights. So log-likelihood, spread and calibration can be compared between all
    networks, and each with the point estimate it would be without its distribution.

    Args:
        network: Maps a batch to a `PosePrediction`.
        **settings: Of `Task`.
    """

    concentration: Tensor
    point_concentration: Tensor

    def __init__(self, network: nn.Module, **settings: Any) -> None:  # noqa: ANN401 - see Task
        super().__init__(network, **settings)
        names, symmetry = self.info.class_names, self.info.symmetry
        self.errors = nn.ModuleDict({s: PoseErrors(names, symmetry) for s in ("val", "test")})
        self.fit = ConcentrationFit()
        self.density = nn.ModuleDict({name: MeanMetric() for name in _MEANS})
        for name in ("concentration", "point_concentration"):
            self.register_buffer(name, torch.tensor(torch.nan, dtype=torch.float64))

    def _errors(self, stage: str) -> PoseErrors:
        metric = self.errors[stage]
        assert isinstance(metric, PoseErrors)
        return metric

    def _mean(self, name: str) -> MeanMetric:
        mean = self.density[name]
        assert isinstance(mean, MeanMetric)
        return mean

    def forward(self, batch: Batch) -> PosePrediction:
        """The network's prediction, with the fitted concentration where there is one."""
        prediction: PosePrediction = self.network(batch)
        if not self.training and not torch.isnan(self.concentration):
            prediction.concentration = self.concentration
        return prediction

    def update_metrics(
        self, stage: str, prediction: PosePrediction, batch: Batch
    ) -> dict[str, Tensor]:
        """Add the errors of a batch.

        Hands on `group_correct` (B,) where there is a group and, at the test, what
        `_density_scores` gives.
        """
        more: dict[str, Tensor] = {}
        group_correct = getattr(self.network, "group_correct", None)
        if prediction.logits is not None and group_correct is not None:
            more["group_correct"] = group_correct(prediction, batch)
        self._errors(stage).update(
            prediction.rotation,
            batch["rotation"],
            class_id=batch["class_id"],
            instance_id=batch["instance_id"],
            group_correct=more.get("group_correct"),
        )
        if stage == "val":
            has_mixture = prediction.candidates is not None and not prediction.equal_volume
            self.fit.update(
                prediction.rotation,
                batch["rotation"],
                prediction.log_prob if has_mixture else None,
                prediction.candidates if has_mixture else None,
            )
        else:
            scores = self._density_scores(prediction, batch)
            for name in _MEANS:
                if name in scores:
                    self._mean(name).update(scores[name])
            more |= scores
        return more

    def _density_scores(self, prediction: PosePrediction, batch: Batch) -> dict[str, Tensor]:
        """What the distribution of each image is worth, (B,) each.

        `log_likelihood` is the log density at the truth, `spread_deg` the mean angle between draws
        and the truth, `within_30deg` the probability of being within 30° of the best guess; with
        `point_` in front, of one component at the best guess. What needs a concentration is left
        out where there was no validation to fit it on.
        """
        scores: dict[str, Tensor] = {}
        if prediction.equal_volume or not torch.isnan(self.concentration):
            prediction.concentration = self.concentration
            scores |= self._scores_of(prediction, batch)
        if not torch.isnan(self.point_concentration):
            point = PosePrediction(prediction.rotation, concentration=self.point_concentration)
            scores |= {f"point_{k}": v for k, v in self._scores_of(point, batch).items()}
        return scores

    def _scores_of(self, prediction: PosePrediction, batch: Batch) -> dict[str, Tensor]:
        truth, rotation = batch["rotation"], prediction.rotation
        # The same draws in every process and every test.
        generator = torch.Generator(rotation.device).manual_seed(0)
        samples = prediction.sample(_SAMPLES, generator)
        spread = torch.zeros(len(truth), dtype=torch.float64, device=truth.device)
        within = torch.zeros_like(spread)
        for index, symmetry in enumerate(self.info.symmetry):
            mine = batch["class_id"] == index
            spread[mine] = spread_deg(samples[mine], truth[mine], symmetry=symmetry)
            within[mine] = probability_within(samples[mine], rotation[mine], symmetry=symmetry)
        return {
            "log_likelihood": prediction.log_density(truth[:, None])[:, 0],
            "spread_deg": spread,
            "within_30deg": within,
        }

    def compute_metrics(self, stage: str) -> dict[str, Tensor]:
        """Scores of a stage; resets them. At a validation the concentrations are fitted anew."""
        metric = self._errors(stage)
        values: dict[str, Tensor] = metric.compute()
        metric.reset()
        if stage == "val":
            fitted = self.fit.compute()
            self.fit.reset()
            self.concentration.fill_(fitted["mixture"])
            self.point_concentration.fill_(fitted["point"])
            values["concentration"] = self.concentration
        else:
            for name in _MEANS:
                if self._mean(name).update_called:
                    values[name] = self._mean(name).compute()
                    self._mean(name).reset()
        return {name: value.float() for name, value in values.items()}
