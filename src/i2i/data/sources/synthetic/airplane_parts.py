"""Parts of airplanes: bodies, wings, fins, engines, propellers, wheels."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from i2i.data.sources.synthetic.assembly import Assembly
from i2i.data.sources.synthetic.draws import Draws
from i2i.data.sources.synthetic.palette import BLACK, WINDOW, Color, tone
from i2i.data.sources.synthetic.primitives import (
    Floats,
    Part,
    circle,
    lathe,
    loft,
    rod,
)
from i2i.data.sources.synthetic.solids import cushion

_AROUND = 20


def fuselage(
    assembly: Assembly, line: Floats, color: Color, stripe: Color | None, *, squash: float = 1.0
) -> None:
    """A body of round sections.

    Args:
        assembly: The airplane.
        line: (y, radius, z of the centre) from nose to tail, shape (P, 3).
        color: Of the skin.
        stripe: Of the line along the windows, if any.
        squash: Width as a factor of the height.
    """
    around = circle(_AROUND)
    y, radius, z = line.T
    rings = np.empty((len(line), _AROUND, 3))
    rings[..., 0] = squash * radius[:, None] * around[:, 0]
    rings[..., 1] = y[:, None]
    rings[..., 2] = z[:, None] + radius[:, None] * around[:, 1]
    part = loft(rings)
    k = (np.arange(len(part.faces)) // 2) % _AROUND
    beside = np.isin(k, (0, _AROUND // 2 - 1))
    colors = np.where((beside & (stripe is not None))[:, None], stripe or color, color)
    colors[2 * _AROUND * (len(line) - 1) :] = color
    assembly.add(part, colors)


def wing(root: ArrayLike, tip: ArrayLike, *, chord: float, tip_chord: float, thick: float) -> Part:
    """A wing between the leading edges of root and tip, both shape (3,); the chords run along y."""
    # (part of the chord, height as a part of the thickness), once round the aerofoil
    foil = np.array(
        [
            (0, 0),
            (0.03, 0.45),
            (0.15, 0.9),
            (0.35, 1.0),
            (0.65, 0.6),
            (1, 0.04),
            (1, -0.04),
            (0.65, -0.25),
            (0.35, -0.45),
            (0.15, -0.45),
            (0.03, -0.3),
        ]
    )
    start, end = np.asarray(root, dtype=np.float64), np.asarray(tip, dtype=np.float64)
    across = (end - start) / np.linalg.norm((end - start)[[0, 2]])
    up = np.array([-across[2], 0.0, across[0]])  # normal to the wing, in the plane of x and z
    rings = []
    for at, width, high in (
        (start, chord, thick),
        (0.5 * (start + end), 0.5 * (chord + tip_chord), 0.5 * (thick + thick * tip_chord / chord)),
        (end, tip_chord, thick * tip_chord / chord),
    ):
        rings.append(at + foil[:, :1] * width * np.array([0.0, 1.0, 0.0]) + foil[:, 1:] * high * up)
    return loft(np.stack(rings))


def fin(
    draws: Draws,
    y: float,
    z: float,
    *,
    chord: float,
    height: float,
    sweep: float,
    x: float = 0.0,
    cant: float = 0.0,
) -> Part:
    """A fin with its leading edge beginning at (x, y, z)."""
    tip = (x + cant * height, y + sweep * height, z + height)
    return wing(
        (x, y, z), tip, chord=chord, tip_chord=chord * draws.uniform(0.4, 0.65), thick=0.08 * chord
    )


def jet(length: float, radius: float, *, segments: int = 18) -> tuple[Part, np.ndarray]:
    """An engine pod about the y axis, its intake at −y, and which of its faces are dark."""
    profile = [
        (0, -0.42 * length),
        (0.82 * radius, -0.44 * length),
        (0.88 * radius, -0.5 * length),
        (radius, -0.42 * length),
        (radius, 0.05 * length),
        (0.78 * radius, 0.32 * length),
        (0.5 * radius, 0.34 * length),
        (0.36 * radius, 0.5 * length),
        (0, 0.5 * length),
    ]
    part = lathe(profile, segments=segments)
    rings = len(profile) - 2
    caps = np.arange(len(part.faces)) >= 2 * segments * (rings - 1)
    # z of the lathe becomes y: its low end is the intake.
    return Part(part.vertices[:, [0, 2, 1]] * np.array([1.0, 1.0, -1.0]), part.faces), caps


def propeller(
    assembly: Assembly, draws: Draws, centre: ArrayLike, radius: float, blades: int
) -> None:
    """Blades and a spinner about the y axis, in front of `centre`."""
    at = np.asarray(centre, dtype=np.float64)
    spinner = lathe(
        [(0.12 * radius, 0), (0.1 * radius, 0.1 * radius), (0, 0.22 * radius)], segments=12
    )
    assembly.add(spinner.rotated("x", 90.0).moved(*at), tone(draws, "accent"))
    blade = cushion(
        (0.11 * radius, 0.02 * radius + 0.004, radius),
        (0, -0.05 * radius, 0.5 * radius),
        power=2.5,
        steps=4,
    )
    start = draws.uniform(0, 360 / blades)
    for k in range(blades):
        assembly.add(blade.rotated("y", start + 360.0 * k / blades).moved(*at), (60, 60, 64))


def wheel(assembly: Assembly, x: float, y: float, top: float, floor: float, radius: float) -> None:
    """A wheel on its strut; with its mirror image unless it is in the middle."""
    disc = lathe(
        [
            (0, -0.3 * radius),
            (0.8 * radius, -0.3 * radius),
            (radius, 0),
            (0.8 * radius, 0.3 * radius),
            (0, 0.3 * radius),
        ],
        segments=14,
    )
    parts = [(disc.rotated("y", 90.0).moved(x, y, floor + radius), BLACK)]
    parts += [
        (
            rod((0.85 * x, y, top), (x, y, floor + radius), 0.25 * radius, segments=6),
            (150, 152, 156),
        )
    ]
    for part, color in parts:
        if x > 0.0:
            assembly.add_pair(part, color)
        else:
            assembly.add(part, color)


def tube_line(draws: Draws, radius: float, *, nose: float, tail: float, lift: float) -> Floats:
    """(y, radius, z) of an airliner's body: a blunt nose, a tube, a tail that rises."""
    bow = np.array([0.01, 0.08, 0.25, 0.5, 0.75, 1.0])
    blunt = np.sqrt(bow * (2 - bow))
    front = np.column_stack([-1 + nose * bow, radius * blunt, -0.25 * radius * (1 - blunt)])
    s = np.linspace(0, 1, 9)
    taper = 1 - 0.9 * s ** draws.uniform(1.3, 1.8)
    rear = np.column_stack([1 - tail + tail * s, radius * taper, lift * radius * (1 - taper)])
    return np.concatenate([front, rear])


def cockpit(assembly: Assembly, y: float, z: float, radius: float) -> None:
    """The windscreen: a dark band that just stands out of the nose."""
    assembly.add(
        cushion((1.5 * radius, 0.5 * radius, 0.3 * radius), (0, y, z), power=3.0, steps=5), WINDOW
    )
