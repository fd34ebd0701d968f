"""Lightning callbacks: pictures, error histograms, final metrics, guards, per-image records."""

from i2i.callbacks.distributions import DistributionImages
from i2i.callbacks.equivariance import EquivarianceCurve
from i2i.callbacks.errors import ErrorHistogram
from i2i.callbacks.guard import NonFiniteLossGuard
from i2i.callbacks.hparams import HyperparameterMetrics
from i2i.callbacks.images import PredictionImages
from i2i.callbacks.record import PredictionRecord
from i2i.callbacks.steps import StopAfterSteps

__all__ = [
    "DistributionImages",
    "EquivarianceCurve",
    "ErrorHistogram",
    "HyperparameterMetrics",
    "NonFiniteLossGuard",
    "PredictionImages",
    "PredictionRecord",
    "StopAfterSteps",
]
