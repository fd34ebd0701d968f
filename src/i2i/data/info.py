"""What a network and a run folder need to know about the data they were made for."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

CHANNELS = {"gray": 1, "depth": 1, "rgb": 3}
"""Image channels of each modality."""

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
        channels: Image channels (1 for gray and depth, 3 for rgb).
        image_size: Height and width of the images, in pixels.
        modality: ``"gray"``, ``"depth"`` or ``"rgb"``.
        background: Value of a background pixel, in [0, 1].
        camera_distance: Distance from the camera to the object's centre, in object radii.
        camera_fov_deg: Full field of view in both directions, in degrees.
        source: Name of the mesh source.
        symmetry_stripped: Whether rotations that look the same have one label.

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
