"""What the multi-view networks share: the pictures of an object, and one feature for each."""

import inspect
from pathlib import Path

import torch
from torch import Tensor, nn

from i2i.models.pooled import Component, pool
from i2i.nn.log_polar import LogPolar
from i2i.nn.precision import at_least_float32
from i2i.nn.pretrained import IMAGENET_MEAN, IMAGENET_STD, load_pretrained

CAMERA_SET_OF = {12: "icosahedron_12", 20: "dodecahedron_20", 60: "group_60"}
"""The camera set that has so many views."""

_COLOURS = 3


def camera_set_of(num_views: int) -> str:
    """The camera set with so many views.

    Raises:
        ValueError: If there is none.
    """
    if num_views not in CAMERA_SET_OF:
        sets = ", ".join(f"{n} ({name})" for n, name in CAMERA_SET_OF.items())
        raise ValueError(f"num_views={num_views} fits no camera set: {sets}")
    return CAMERA_SET_OF[num_views]


class ViewFeatures(nn.Module):
    """One trunk on every view: a feature vector for each.

    The trunk is made for colour pictures, as the weights that exist are; gray ones are repeated
    three times. With pretrained weights the pictures get ImageNet's mean and standard deviation,
    else they stay in [0, 1]. Both numbers are part of the checkpoint, so that a network rebuilt
    without the weight file normalises as the one that was trained.

    Args:
        trunk: Called as `trunk(3, image_size=...)`, or a module that is ready; gives maps
            (N, F, S, S), which are averaged, or vectors (N, F), and has `out_channels`. With
            `log_polar` it is called with `circular_rows=True` too.
        channels: Channels of a view, 1 or 3.
        image_size: Side of a view in pixels.
        num_views: Views V of an object.
        log_polar: Whether views are resampled by `LogPolar`, which averages away camera rolls.
        pretrained: A weight file, see `load_pretrained`; None starts from scratch.

    Attributes:
        out_channels: F.

    Shape:
        (B, V, channels, image_size, image_size) -> (B, V, F).

    Raises:
        TypeError: If the trunk has no `out_channels`.
        ValueError: If the number of channels is another, the weights do not fit, or views have
            another shape.
    """

    mean: Tensor
    std: Tensor

    def __init__(
        self,
        trunk: Component | nn.Module,
        *,
        channels: int,
        image_size: int,
        num_views: int,
        log_polar: bool = False,
        pretrained: str | Path | None = None,
    ) -> None:
        super().__init__()
        if channels not in (1, _COLOURS):
            raise ValueError(f"channels={channels}: views are gray (1) or in colour (3)")
        self.expected = (num_views, channels, image_size, image_size)
        if not isinstance(trunk, nn.Module):
            if log_polar and not _takes(trunk, "circular_rows"):
                raise ValueError(
                    "the trunk has no circular rows, which log-polar views need: set "
                    "model.log_polar=false or model/trunk=resnet18"
                )
            options = {"circular_rows": True} if log_polar else {}
            trunk = trunk(_COLOURS, image_size=image_size, **options)
        if not hasattr(trunk, "out_channels"):
            raise TypeError(f"{type(trunk).__name__} has no `out_channels`: a trunk says its width")
        self.trunk, self.out_channels = trunk, int(trunk.out_channels)  # type: ignore[arg-type]
        self.resample = LogPolar(image_size) if log_polar else nn.Identity()
        mean, std = (0.0,) * _COLOURS, (1.0,) * _COLOURS
        if pretrained is not None:
            load_pretrained(self.trunk, pretrained)
            mean, std = IMAGENET_MEAN, IMAGENET_STD
        self.register_buffer("mean", torch.tensor(mean).view(-1, 1, 1))
        self.register_buffer("std", torch.tensor(std).view(-1, 1, 1))

    def forward(self, views: Tensor) -> Tensor:
        """(B, V, channels, S, S) -> (B, V, F), float32 or wider."""
        if views.ndim != 5 or views.shape[1:] != self.expected:
            raise ValueError(
                f"expected views of shape (B, {self.expected}), got {tuple(views.shape)}"
            )
        pictures = self.resample(views.flatten(0, 1))
        out = self.trunk((pictures - self.mean) / self.std)  # gray becomes three channels
        feature = pool(out) if out.ndim == 4 else at_least_float32(out)
        return feature.unflatten(0, (len(views), -1))


def _takes(component: Component, option: str) -> bool:
    """Whether a component can be made with an option."""
    parameters = inspect.signature(component).parameters.values()
    return any(p.name == option or p.kind is p.VAR_KEYWORD for p in parameters)
