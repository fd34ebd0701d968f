"""What an encoder is: a module from images to a square map of features that says its own sizes."""

from typing import Protocol, runtime_checkable

from torch import Tensor, nn

from i2i.nn.c4_resnet import C4ResNet18
from i2i.nn.resnet import ResNet18

__all__ = ["C4ResNet18", "Encoder", "ResNet18", "check_encoder"]


@runtime_checkable
class Encoder(Protocol):
    """The interface that I2I asks of an encoder, its own or one from another package.

    It is made as `factory(in_channels=..., image_size=...)`, maps (B, C, H, W) to
    (B, out_channels, map_size, map_size), and has these two attributes.
    """

    out_channels: int
    map_size: int

    def __call__(self, image: Tensor) -> Tensor:
        """Map images to features."""
        ...


def check_encoder(encoder: nn.Module) -> nn.Module:
    """Return `encoder` if it has what I2I needs of one.

    Raises:
        TypeError: If it is not a module or lacks an attribute; the message says which.
    """
    missing = [name for name in ("out_channels", "map_size") if not hasattr(encoder, name)]
    if not isinstance(encoder, nn.Module) or missing:
        raise TypeError(
            f"{type(encoder).__name__} does not fit as an encoder: it must be a torch.nn.Module "
            "with the integers `out_channels` and `map_size`, mapping (B, C, H, W) to "
            "(B, out_channels, map_size, map_size)"
            + (f"; missing: {', '.join(missing)}" if missing else "")
        )
    return encoder
