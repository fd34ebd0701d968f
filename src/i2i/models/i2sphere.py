"""I2Sphere: the same encoder, but a continuous sphere and a distribution over all of SO(3)."""

import math
from collections.abc import Callable, Mapping

import torch
from torch import Tensor, nn

from i2i.geometry.rotation_grids import nearest_cell, rotation_grid
from i2i.models.prediction import PosePrediction
from i2i.nn.encoders import check_encoder
from i2i.nn.precision import full_precision
from i2i.nn.so3_signal import (
    HemisphereProjector,
    RotationGridValues,
    SO3Convolution,
    SphereCorrelation,
    climb,
)
from i2i.nn.spherical import num_wigner, wigner_basis

LOSSES = ("ce_grid", "wigner_mse", "joint")
FEATURES_PER_SPHERE = 6  # gives the head as many parameters as I2I's at the paper's sizes

Component = Callable[..., nn.Module]
Batch = Mapping[str, Tensor]


class I2SpherePose(nn.Module):
    """Distribution over SO(3) from one image (paper §5, "I2Sphere").

    Encoder, HEALPix points of the visible hemisphere, spherical harmonics, correlation with a
    learned filter in harmonics, values on a rotation grid, softmax. What is distributed is `view`
    (camera -> object), the rotation at which a correlation is largest; the prediction's candidates
    and its `rotation` are transposed to object -> camera.

    In training `rotation` is the most probable cell; in evaluation a maximum of the function itself
    near it, so the grid's spacing is no limit.

    Losses: `"ce_grid"` is the cross-entropy with the cell nearest to the target. `"wigner_mse"`
    regresses the coefficients onto the Wigner matrices of the target, with weight 2l+1 for degree l
    (the squared distance of functions on SO(3), divided by the number of coefficients, so that a
    network that gives zeros has loss 1); the distribution is then softmax(κ·ρ), where ρ(T), the
    correlation of the coefficients with those of T, is 1 at the target if they are right, and κ is
    fitted by the likelihood alone (term `calibration`, which moves nothing else). `"joint"` adds
    the cross-entropy of softmax(κ·ρ), κ learned with it.

    Args:
        encoder: See `i2i.models.i2i.I2ITrunk`.
        projector: Called as `projector(in_channels, out_channels, map_size=..., lmax=...)`.
        channels: Channels of the image.
        num_classes: Classes of the data; each has its own filter, chosen by `class_id`.
        image_size: Side of the image in pixels.
        sphere_features: Width n of I2I's sphere; the sphere here has 6 n features, which makes
            both networks equally large.
        lmax: Highest degree.
        grid_level: Trained on 72·8^level rotations.
        loss: `"ce_grid"`, `"wigner_mse"` or `"joint"`.
        mse_weight: Weight of the regression.
        kappa: κ to start from.
        refine_steps: Newton steps in evaluation; 0 predicts the cell.
        so3_features: Functions on SO(3) between the correlation and a further convolution, after a
            ReLU (8 in Image2Sphere, with as many times more parameters in the correlation). None
            leaves both out: the correlation gives the logits.

    Raises:
        ValueError: If a choice is unknown.
        TypeError: If the encoder lacks an attribute.

    Reference:
        Klee et al. 2023, "Image to Sphere"; Lee & Cho 2024, "3D Equivariant Pose Regression via
        Direct Wigner-D Harmonics Prediction" (the regression).
    """

    views: Tensor

    def __init__(
        self,
        encoder: Component | nn.Module,
        projector: Component = HemisphereProjector,
        *,
        channels: int,
        num_classes: int,
        image_size: int,
        sphere_features: int = 128,
        lmax: int = 6,
        grid_level: int = 3,
        loss: str = "ce_grid",
        mse_weight: float = 100.0,
        kappa: float = 50.0,
        refine_steps: int = 8,
        so3_features: int | None = None,
    ) -> None:
        super().__init__()
        if loss not in LOSSES:
            raise ValueError(f"loss={loss!r} is not known: choose one of {', '.join(LOSSES)}")
        self.loss_name, self.mse_weight, self.refine_steps = loss, mse_weight, refine_steps
        self.num_classes, self.lmax, self.grid_level = num_classes, lmax, grid_level
        if not isinstance(encoder, nn.Module):
            encoder = encoder(in_channels=channels, image_size=image_size)
        self.encoder = check_encoder(encoder)
        features = FEATURES_PER_SPHERE * sphere_features
        self.projector = projector(
            self.encoder.out_channels, features, map_size=self.encoder.map_size, lmax=lmax
        )
        self.correlation = SphereCorrelation(
            features, so3_features or 1, lmax=lmax, num_filters=num_classes
        )
        self.so3_conv = SO3Convolution(so3_features, lmax=lmax) if so3_features else None
        self.grid_values = RotationGridValues(lmax, grid_level)
        views = rotation_grid(grid_level).rotations.float()
        self.register_buffer("views", views, persistent=False)
        if loss != "ce_grid":
            self.log_kappa = nn.Parameter(torch.tensor(math.log(kappa)))

    def coefficients(self, batch: Batch) -> Tensor:
        """The function on SO(3), in the basis of `i2i.nn.spherical`: (B, Σ(2l+1)²)."""
        index = batch.get("class_id") if self.num_classes > 1 else None
        functions = self.correlation(self.projector(self.encoder(batch["image"])), index)
        if self.so3_conv is not None:
            functions = self.so3_conv(functions)
        single: Tensor = functions[:, 0]
        return single

    def grid_logits(self, coefficients: Tensor) -> Tensor:
        """Logits of the grid's views: (B, Σ(2l+1)²) -> (B, K)."""
        if self.loss_name == "ce_grid":
            return self.grid_values(coefficients)
        if self.loss_name == "wigner_mse":
            coefficients = coefficients.detach()
        scale = self.log_kappa.exp() / num_wigner(self.lmax)
        return self.grid_values(coefficients) * scale

    def forward(self, batch: Batch) -> PosePrediction:
        """Predict for `image` (B, C, S, S), and `class_id` (B,) where there are several classes."""
        coefficients = self.coefficients(batch)
        logits = self.grid_logits(coefficients)
        view = self.views[logits.argmax(dim=1)]
        if not self.training and self.refine_steps:
            view = climb(coefficients, view, self.lmax, steps=self.refine_steps)
        return PosePrediction(
            rotation=view.mT,
            logits=logits,
            log_prob=torch.log_softmax(logits, dim=1),
            candidates=self.views.mT,
            extras={"coefficients": coefficients},
            equal_volume=True,
        )

    def loss(self, prediction: PosePrediction, batch: Batch) -> dict[str, Tensor]:
        """The terms of the chosen loss, weighted, to be added up."""
        if prediction.log_prob is None:
            raise ValueError("the prediction has no distribution")
        view = batch["rotation"].mT
        with full_precision(view):
            cell = nearest_cell(view, self.views)
            terms = {}
            nll = nn.functional.nll_loss(prediction.log_prob, cell)
            terms["calibration" if self.loss_name == "wigner_mse" else "classification"] = nll
            if self.loss_name != "ce_grid":
                coefficients = prediction.extras["coefficients"]
                target = wigner_basis(view, self.lmax).to(coefficients)
                error = nn.functional.mse_loss(coefficients, target)
                terms["regression"] = self.mse_weight * error
        return terms

    def extra_repr(self) -> str:
        """The loss and the grid."""
        return f"loss={self.loss_name}, lmax={self.lmax}, rotations={len(self.views)}"
