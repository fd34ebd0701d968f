"""CNN: a plain ResNet with a linear classifier."""

from torch import Tensor

from i2i.models.pooled import FeatureClassifier, pool


class CNNClassifier(FeatureClassifier):
    """Classification baseline CNN of the paper (Table 3): spatial mean, linear layer.

    The arguments are those of `FeatureClassifier`; the encoder is ResNet-18 in the paper. The
    descriptor is the pooled feature.
    """

    def feature(self, image: Tensor) -> Tensor:
        """The spatial mean of the encoder's map: (B, channels, S, S) -> (B, F)."""
        return pool(self.encoder(image))
