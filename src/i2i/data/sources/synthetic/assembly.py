"""An object in the making: coloured parts, put together at the end into one mesh."""

from __future__ import annotations

import numpy as np
import trimesh
from numpy.typing import ArrayLike

from i2i.data.sources.synthetic.palette import Color
from i2i.data.sources.synthetic.primitives import Part


class Assembly:
    """A list of coloured parts.

    Example:
        >>> from i2i.data.sources.synthetic.solids import box
        >>> shelf = Assembly()
        >>> shelf.add(box((1.0, 0.3, 0.02)), (190, 140, 90))
        >>> len(shelf.to_trimesh().faces)
        44
    """

    def __init__(self) -> None:
        """Start with no parts."""
        self._parts: list[Part] = []
        self._colors: list[np.ndarray] = []

    def add(self, part: Part, color: Color | ArrayLike) -> None:
        """Add a part.

        Args:
            part: The part.
            color: One colour, or one for each face, shape (F, 3), 0 to 255.
        """
        self._parts.append(part)
        self._colors.append(
            np.broadcast_to(np.asarray(color, dtype=np.uint8), (len(part.faces), 3))
        )

    def add_pair(self, part: Part, color: Color | ArrayLike, *, axis: str = "x") -> None:
        """Add a part and its mirror image across an axis (left and right by default)."""
        self.add(part, color)
        self.add(part.mirrored(axis), color)

    def add_around(self, part: Part, color: Color, count: int) -> None:
        """Add `count` copies of a part, turned evenly about z."""
        for k in range(count):
            self.add(part.rotated("z", 360.0 * k / count), color)

    def add_half_turn(self, part: Part, color: Color) -> None:
        """Add a part and its copy turned by 180° about z, exactly."""
        self.add(part, color)
        self.add(part.half_turned(), color)

    def parts(self) -> list[tuple[Part, np.ndarray]]:
        """The parts with the colours of their faces, shape (F, 3), uint8, in order."""
        return list(zip(self._parts, self._colors, strict=True))

    def to_trimesh(self) -> trimesh.Trimesh:
        """One mesh of all the parts, with a colour for each face; nothing is merged."""
        offsets = np.cumsum([0] + [len(part.vertices) for part in self._parts[:-1]])
        faces = [part.faces + offset for part, offset in zip(self._parts, offsets, strict=True)]
        colors = np.concatenate(self._colors)
        opaque = np.column_stack([colors, np.full(len(colors), 255, dtype=np.uint8)])
        return trimesh.Trimesh(
            vertices=np.concatenate([part.vertices for part in self._parts]),
            faces=np.concatenate(faces),
            face_colors=opaque,
            process=False,
        )
