"""Backs of wooden chairs: ladders, slats, spindles, panels, crosses, splats and pads."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from i2i.data.sources.synthetic.assembly import Assembly
from i2i.data.sources.synthetic.draws import Draws
from i2i.data.sources.synthetic.palette import Color, shade, tone
from i2i.data.sources.synthetic.primitives import Floats, Part, rod, slab, spline, tube

BACKS = ("ladder", "slats", "spindles", "panel", "pad", "cross", "splat")


@dataclass(frozen=True)
class Back:
    """The bent and leaning surface that a back lies in.

    Attributes:
        half_width: Half the distance of the posts at the seat.
        flare: Half width at the top as a factor of that.
        y: Depth of the posts at the seat.
        z: Height of its lower end.
        height: Height above that.
        recline: Slope dy/dz.
        bow: How far the middle lies behind the posts.
        lumbar: How far the lower part bulges towards the sitter.
    """

    half_width: float
    flare: float
    y: float
    z: float
    height: float
    recline: float
    bow: float
    lumbar: float = 0.0

    def at(self, across: float | Floats, up: float | Floats) -> Floats:
        """Points of the surface.

        Args:
            across: −1 at one post, 1 at the other.
            up: 0 at the lower end, 1 at the top.

        Returns:
            Shape (..., 3).
        """
        u, v = np.broadcast_arrays(np.asarray(across, float), np.asarray(up, float))
        x = u * self.half_width * (1 + (self.flare - 1) * v)
        lean = self.recline * self.height * v * (0.75 + 0.25 * v)
        y = (
            self.y
            + lean
            + self.bow * (1 - u**2) * np.clip(v + 0.2, 0, 1)
            - self.lumbar * np.sin(np.pi * np.clip(v, 0, 1) ** 0.7)
        )
        return np.stack([x, y, self.z + self.height * v], axis=-1)

    def strip(
        self,
        u: tuple[float, float],
        v: tuple[float, float],
        *,
        thickness: float,
        arch: float = 0.0,
        steps: tuple[int, int] = (3, 9),
    ) -> Part:
        """A piece of the surface as a sheet.

        Args:
            u: From where to where across.
            v: From where to where up.
            thickness: Of the sheet.
            arch: How much higher its upper edge is in the middle, as a part of the height.
            steps: Points up and across.
        """
        up, across = np.meshgrid(
            np.linspace(0, 1, steps[0]), np.linspace(u[0], u[1], steps[1]), indexing="ij"
        )
        level = v[0] + (v[1] - v[0] + arch * (1 - across**2)) * up
        return slab(self.at(across, level), thickness)

    def sheet(self, *, thickness: float, rounding: float) -> Part:
        """The whole surface as an upholstered sheet with rounded corners and thin rims."""
        up, across = np.meshgrid(np.linspace(0, 1, 11), np.linspace(-1, 1, 11), indexing="ij")
        edge = np.clip(np.minimum(up, 1 - up) / rounding, 0, 1)
        narrow = 1 - 0.22 * (1 - np.sqrt(edge * (2 - edge)))
        rim = np.minimum(
            np.clip((1 - np.abs(across)) / 0.2, 0, 1), np.clip(np.minimum(up, 1 - up) / 0.1, 0, 1)
        )
        return slab(self.at(across * narrow, up), thickness * (0.35 + 0.65 * np.sqrt(rim)))


def add_back(assembly: Assembly, draws: Draws, kind: str, back: Back, wood: Color) -> None:
    """Fill the space between the posts.

    Args:
        assembly: The chair.
        draws: Its stream.
        kind: One of `BACKS`.
        back: The surface.
        wood: Colour of the frame.
    """
    arch, thick = draws.choice((0.0, draws.uniform(0.02, 0.12))), draws.uniform(0.014, 0.022)
    crest = draws.uniform(0.10, 0.2)
    inner = wood if draws.flag(0.7) else tone(draws, "wood")
    if kind == "ladder":
        _ladder(assembly, draws, back, inner, arch, thick)
    elif kind == "panel":
        low = draws.uniform(0.12, 0.4)
        assembly.add(
            back.strip((-1, 1), (low, 0.98), thickness=thick, arch=arch, steps=(5, 9)), inner
        )
    elif kind == "pad":
        _pad(assembly, draws, back, wood, arch, thick)
    else:
        assembly.add(
            back.strip((-1.04, 1.04), (1 - crest, 1.0), thickness=1.2 * thick, arch=arch), wood
        )
        low = draws.uniform(0.08, 0.3)
        if kind in ("slats", "cross", "splat") and draws.flag(0.8):
            assembly.add(
                back.strip((-1, 1), (low, low + 0.07), thickness=thick, steps=(2, 9)), wood
            )
        else:
            low = 0.0
        fill = {"slats": _slats, "spindles": _spindles, "cross": _cross, "splat": _splat}[kind]
        fill(assembly, draws, back, inner, (low, 1 - 0.8 * crest))


def _ladder(
    assembly: Assembly, draws: Draws, back: Back, wood: Color, arch: float, thick: float
) -> None:
    count = draws.integer(2, 5)
    high = draws.uniform(0.35, 0.7) * 0.8 / count
    for v in np.linspace(draws.uniform(0.2, 0.4), 0.99 - high, count):
        assembly.add(back.strip((-1, 1), (v, v + high), thickness=thick, arch=0.5 * arch), wood)


def _pad(
    assembly: Assembly, draws: Draws, back: Back, wood: Color, arch: float, thick: float
) -> None:
    low, cloth = draws.uniform(0.12, 0.4), tone(draws, draws.choice(("fabric", "leather")))
    assembly.add(back.strip((-1, 1), (low, 0.98), thickness=thick, arch=arch, steps=(4, 9)), wood)
    inset = draws.uniform(0.78, 0.94)
    part = back.strip(
        (-inset, inset), (low + 0.05, 0.93), thickness=0.03, arch=arch * 0.9, steps=(4, 7)
    )
    assembly.add(part.moved(y=-0.014), cloth)
    if draws.flag(0.25):
        for v in (0.55, 0.75):
            for u in (-0.5, 0.0, 0.5):
                at = back.at(u, v)
                assembly.add(rod(at - (0, 0.035, 0), at, 0.009, segments=6), shade(cloth, 0.7))


def _slats(
    assembly: Assembly, draws: Draws, back: Back, wood: Color, v: tuple[float, float]
) -> None:
    count = draws.integer(3, 7)
    half = draws.uniform(0.35, 0.7) / (count + 1)
    for u in np.linspace(-1, 1, count + 2)[1:-1]:
        assembly.add(back.strip((u - half, u + half), v, thickness=0.011, steps=(4, 2)), wood)


def _spindles(
    assembly: Assembly, draws: Draws, back: Back, wood: Color, v: tuple[float, float]
) -> None:
    count = draws.integer(4, 9)
    fan, radius = draws.uniform(0.75, 1.0), draws.uniform(0.005, 0.009)
    swell = draws.uniform(1.0, 1.7)
    t = np.linspace(0, 1, 5)
    widths = radius * (1 + (swell - 1) * np.sin(np.pi * t))
    for u in np.linspace(-1, 1, count + 2)[1:-1]:
        assembly.add(
            tube(back.at(u * (fan + (1 - fan) * t), v[0] + (v[1] - v[0]) * t), widths, segments=7),
            wood,
        )


def _cross(
    assembly: Assembly, draws: Draws, back: Back, wood: Color, v: tuple[float, float]
) -> None:
    curve, radius = draws.uniform(-0.25, 0.25), draws.uniform(0.008, 0.012)
    t = np.linspace(0, 1, 9)
    u = 0.92 * (2 * t - 1) + curve * np.sin(2 * np.pi * t)
    path = back.at(u, v[0] + (v[1] - v[0]) * t)
    assembly.add_pair(tube(path, radius, segments=8), wood)
    if draws.flag(0.3):
        assembly.add(
            tube(back.at(np.zeros(5), np.linspace(v[0], v[1], 5)), radius, segments=8), wood
        )


def _splat(
    assembly: Assembly, draws: Draws, back: Back, wood: Color, v: tuple[float, float]
) -> None:
    """A fiddle-shaped board in the middle."""
    t = np.linspace(0, 1, 15)
    wide = draws.uniform(0.22, 0.42)
    knots = [
        wide,
        draws.uniform(0.4, 1.0) * wide,
        draws.uniform(0.3, 1.0) * wide,
        draws.uniform(0.6, 1.3) * wide,
        wide,
    ]
    half = spline(np.column_stack([np.linspace(0, 1, 5), knots]), 15)[:, 1]
    grid = back.at(half[:, None] * np.linspace(-1, 1, 4), (v[0] + (v[1] - v[0]) * t)[:, None])
    assembly.add(slab(grid, 0.012), wood)
