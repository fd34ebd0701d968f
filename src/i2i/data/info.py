"""What a network and a run folder need to know about the data they were made for."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

IMAGES = ("gray", "depth", "rgb")
"""Modalities of one image, in a batch as ``image`` (B, C, S, S)."""

CLOUDS = ("partial_points", "full_points")
"""Modalities of a point cloud, in a batch as ``points`` (B, P, 3)."""

VIEWS = "views"
"""The modality of several gray views of one object, in a batch as ``views`` (B, V, C, S, S)."""

CHANNELS = {"gray": 1, "depth": 1, "rgb": 3, "partial_points": 3, "full_points": 3, VIEWS: 1}
"""Image channels, or coordinates of a point, of each modality."""

SYMMETRIES = ("none", "z", "z2")
"""Symmetries that a class can have: none, any turn about its z axis, or the half turn about it."""


@dataclass(frozen=True)
class DataInfo:
    """Plain description of a dataset: enough to build a network and to read its predictions.

    Attributes:
        class_names: Names of the classes; ``class_id`` in a batch is the index into it.
        symmetry: ``"none"``, ``"z"`` (any turn about the object's z axis) or ``"z2"`` (half turns)
            for each class, in the same order; a property of the class, whether or not its labels
            were stripped.
        channels: Image channels (1 for gray and depth, 3 for rgb); 3 for the coordinates of points.
        image_size: Height and width of the images, in pixels; of the depth images behind clouds.
        modality: A key of `CHANNELS`.
        background: Value of a background pixel, in [0, 1].
        camera_distance: Distance from the camera to the object's centre, in object radii.
        camera_fov_deg: Full field of view in both directions, in degrees.
        source: Name of the mesh source.
        symmetry_stripped: Whether rotations that look the same have one label.
        num_points: Points of a cloud; None where there are none.
        num_views: Views of an object in one sample; None where it has one image.
        camera_set: Name of their cameras.

    Example:
        >>> info = DataInfo(("desk",), ("none",), channels=1, image_size=64, modality="gray")
        >>> info.num_classes
        1
        >>> DataInfo.from_dict(info.to_dict()) == info
        True
    """

    class_names: tuple[str, ...]
    symmetry: tuple[str, ...]
    channels: int
    image_size: int
    modality: str
    background: float = 1.0
    camera_distance: float = 3.2
    camera_fov_deg: float = 45.0
    source: str = ""
    symmetry_stripped: bool = True
    num_points: int | None = None
    num_views: int | None = None
    camera_set: str | None = None

    def __post_init__(self) -> None:
        if not self.class_names:
            raise ValueError("DataInfo needs at least one class name.")
        if len(self.symmetry) != len(self.class_names):
            raise ValueError(
                f"{len(self.class_names)} class names but {len(self.symmetry)} symmetries: "
                "give one of 'none', 'z' or 'z2' for each class."
            )
        for name in self.symmetry:
            if name not in SYMMETRIES:
                raise ValueError(f"Unknown symmetry {name!r}. Allowed: {', '.join(SYMMETRIES)}.")

    @property
    def num_classes(self) -> int:
        """Number of classes."""
        return len(self.class_names)

    def network_arguments(self) -> dict[str, int | None]:
        """What the constructor of a network for these data is told, by the name of its argument."""
        if self.modality in CLOUDS:
            return {"num_points": self.num_points, "num_classes": self.num_classes}
        told: dict[str, int | None] = {
            "channels": self.channels,
            "num_classes": self.num_classes,
            "image_size": self.image_size,
        }
        return {**told, "num_views": self.num_views} if self.modality == VIEWS else told

    def to_dict(self) -> dict[str, Any]:
        """Plain lists, strings and numbers only: safe in a checkpoint and in JSON."""
        values = dataclasses.asdict(self)
        values["class_names"] = list(self.class_names)
        values["symmetry"] = list(self.symmetry)
        return values

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> DataInfo:
        """Invert `to_dict`; fields that this version does not know are ignored."""
        known = {field.name for field in dataclasses.fields(cls)}
        chosen = {key: value for key, value in values.items() if key in known}
        chosen["class_names"] = tuple(chosen["class_names"])
        chosen["symmetry"] = tuple(chosen["symmetry"])
        return cls(**chosen)
