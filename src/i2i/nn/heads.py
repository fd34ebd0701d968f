"""Heads: from a network's numbers to rotations."""

from torch import Tensor

from i2i.geometry.rotations import gram_schmidt
from i2i.nn.precision import at_least_float32, full_precision

POSE_FEATURES = 7  # a logit and the six numbers of a rotation
TARGETS = ("view", "rotation")


def split_group_output(output: Tensor) -> tuple[Tensor, Tensor]:
    """Logits (B, K) and residual rotations (B, K, 3, 3) of a function on the group (B, K, 7).

    The six numbers of an element are the first two columns of its residual before Gram-Schmidt.
    """
    output = at_least_float32(output)
    with full_precision(output):
        return output[..., 0], gram_schmidt(output[..., 1:])


def pose_target(rotation: Tensor, target: str) -> Tensor:
    """What is classified and regressed: `view` (camera -> object) or `rotation` itself."""
    return rotation.mT if target == "view" else rotation


def candidate_rotations(residual: Tensor, elements: Tensor, target: str) -> Tensor:
    """The object-to-camera rotation that each element proposes: (B, K, 3, 3).

    Args:
        residual: (B, K, 3, 3), on the left of its element: target = residual @ element.
        elements: (K, 3, 3), the group.
        target: `"view"` or `"rotation"`: what residual @ element stands for.
    """
    with full_precision(residual):
        return pose_target(residual @ elements, target)
