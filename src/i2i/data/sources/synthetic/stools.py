"""Stools: a round seat on legs, on a column or on castors; no back."""

from __future__ import annotations

import numpy as np

from i2i.data.sources.synthetic.assembly import Assembly
from i2i.data.sources.synthetic.bases import LEG_STYLES, castor_star, leg, pedestal, turning_of
from i2i.data.sources.synthetic.draws import Draws
from i2i.data.sources.synthetic.palette import shade, tone
from i2i.data.sources.synthetic.primitives import circle, lathe, rod, tube
from i2i.data.sources.synthetic.solids import ring


def stool(draws: Draws) -> Assembly:
    """One stool, in metres, floor at z = 0.

    Seat, rings and columns are surfaces of revolution; legs and castors repeat three, four or five
    times. So a stool maps to itself under turns by 360° over that number, and only its legs tell
    other turns about z apart.
    """
    assembly = Assembly()
    height, radius = draws.uniform(0.4, 0.82), draws.uniform(0.15, 0.21)
    base = draws.choice(("legs", "pedestal", "castors"), (0.66, 0.17, 0.17))
    if base == "pedestal":
        height = max(height, 3.2 * radius)  # lower ones are side tables
        color = tone(draws, draws.choice(("metal", "dark", "plastic")))
        pedestal(
            assembly,
            draws,
            height=height - 0.02,
            radius=draws.uniform(0.8, 1.1) * radius,
            color=color,
        )
        if draws.flag(0.5):
            _ring(
                assembly, draws.uniform(0.12, 0.17), 0.35 * height, 0.011, tone(draws, "metal"), 24
            )
    elif base == "castors":
        height = min(height, 0.66)
        castor_star(assembly, draws, height=height - 0.02, radius=draws.uniform(1.15, 1.5) * radius)
    legs = _legs(assembly, draws, height, radius) if base == "legs" else 5
    _seat(assembly, draws, height, radius, steps=8 * legs)
    return assembly


def _ring(
    assembly: Assembly,
    radius: float,
    level: float,
    thickness: float,
    color: tuple[int, int, int],
    steps: int,
) -> None:
    """A foot ring."""
    path = np.column_stack([circle(steps) * radius, np.full(steps, level)])
    assembly.add(ring(path, circle(8) * thickness), color)


def _legs(assembly: Assembly, draws: Draws, height: float, radius: float) -> int:
    count = draws.choice((3, 4), (0.4, 0.6))
    color = tone(draws, draws.choice(("wood", "metal", "dark"), (0.6, 0.25, 0.15)))
    thick, spread = draws.uniform(0.026, 0.04), draws.uniform(0.9, 1.4)
    inset = draws.uniform(0.55, 0.82)
    top = np.array([inset * radius, 0.0, height - 0.02])
    foot = np.array([spread * radius, 0.0, 0.0])
    if draws.flag(0.25):  # bent metal
        middle = np.array([inset * radius * 1.02, 0.0, 0.8 * height])
        t = np.linspace(0, 1, 8)[:, None]
        path = (1 - t) ** 2 * top + 2 * t * (1 - t) * middle + t**2 * foot
        assembly.add_around(tube(path, 0.35 * thick, segments=8), color, count)
    else:
        style = draws.choice(LEG_STYLES)
        part = leg(
            style, foot, top, thick, taper=draws.uniform(0.55, 0.85), turning=turning_of(draws)
        )
        assembly.add_around(part, color, count)
    brace = draws.choice(("ring", "rails", "none"), (0.4, 0.4, 0.2))
    for level in np.array([0.3, 0.55][: draws.integer(1, 2)]) * height * draws.uniform(0.85, 1.15):
        reach = foot + (top - foot) * level / top[2]
        turned = 2 * np.pi / count
        after = np.array([reach[0] * np.cos(turned), reach[0] * np.sin(turned), reach[2]])
        if brace == "rails":
            assembly.add_around(rod(reach, after, 0.28 * thick, segments=8), color, count)
        elif brace == "ring":
            _ring(assembly, float(reach[0]), float(level), 0.009, tone(draws, "metal"), 8 * count)
            break
    return count


def _seat(assembly: Assembly, draws: Draws, height: float, radius: float, *, steps: int) -> None:
    kind = draws.choice(("plank", "dished", "pad", "drum"), (0.25, 0.25, 0.35, 0.15))
    if kind in ("plank", "dished"):
        thick, dip = (
            draws.uniform(0.022, 0.045),
            draws.uniform(0.006, 0.02) if kind == "dished" else 0.0,
        )
        edge = draws.uniform(0.2, 0.5) * thick
        profile = [
            (0, height - thick),
            (radius - edge, height - thick),
            (radius, height - thick + edge),
            (radius, height - edge),
            (radius - edge, height),
            (0.6 * radius, height - 0.7 * dip),
            (0, height - dip),
        ]
        assembly.add(
            lathe(profile, segments=steps),
            tone(draws, draws.choice(("wood", "plastic"), (0.8, 0.2))),
        )
        return
    puff = draws.uniform(0.05, 0.08) if kind == "pad" else draws.uniform(0.09, 0.14)
    cloth, low = tone(draws, draws.choice(("leather", "fabric"))), height - 0.5 * puff
    trim = tone(draws, draws.choice(("metal", "wood", "dark")))
    band = [
        (0, low - 0.025),
        (radius * 0.97, low - 0.025),
        (radius * 0.99, low + 0.004),
        (0, low + 0.004),
    ]
    assembly.add(lathe(band, segments=steps), trim)
    angle = np.linspace(-0.4 * np.pi, 0.42 * np.pi, 7)
    side = np.column_stack(
        [radius - 0.4 * puff * (1 - np.cos(angle)), low + 0.5 * puff * (1 + np.sin(angle))]
    )
    bulge = draws.uniform(0.0, 0.02)
    top = [(0.55 * radius, low + puff + 0.6 * bulge), (0, low + puff + bulge)]
    assembly.add(lathe([(0, low), *side.tolist(), *top], segments=steps), cloth)
    if draws.flag(0.3):
        assembly.add(
            lathe(
                [
                    (0.02, low + puff),
                    (0.018, low + puff + bulge + 0.006),
                    (0, low + puff + bulge + 0.008),
                ],
                segments=steps,
            ),
            shade(cloth, 0.75),
        )
