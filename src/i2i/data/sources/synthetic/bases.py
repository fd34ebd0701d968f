"""What seats and tops stand on: legs, pedestals and castor stars."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from i2i.data.sources.synthetic.assembly import Assembly
from i2i.data.sources.synthetic.draws import Draws
from i2i.data.sources.synthetic.palette import Color, shade, tone
from i2i.data.sources.synthetic.primitives import Part, bar, lathe, rod, spline, tube

LEG_STYLES = ("square", "round", "turned", "tapered")

# Radius of a turned leg along its length, as a factor, from floor to top.
_TURNINGS = (
    (0.55, 0.75, 0.6, 0.95, 0.8, 0.7, 0.9, 1.15, 0.85, 1.25, 0.9, 1.3, 1.3),
    (0.6, 0.5, 0.8, 0.9, 1.0, 1.1, 1.2, 0.8, 1.25, 0.8, 1.2, 1.2, 1.2),
    (0.7, 1.0, 0.7, 0.75, 0.95, 1.15, 1.25, 1.2, 0.95, 0.7, 1.1, 0.75, 1.15),
)


def leg(
    draws_style: str,
    foot: ArrayLike,
    top: ArrayLike,
    thickness: float,
    *,
    taper: float,
    turning: int = 0,
) -> Part:
    """A leg from the floor to its top.

    Args:
        draws_style: One of `LEG_STYLES`.
        foot: Point on the floor, shape (3,).
        top: Upper end, shape (3,).
        thickness: Width at the top.
        taper: Width at the floor as a factor of that at the top.
        turning: Which turned profile, for "turned".
    """
    low, high = np.asarray(foot, dtype=np.float64), np.asarray(top, dtype=np.float64)
    if draws_style == "turned":
        factors = np.asarray(_TURNINGS[turning % len(_TURNINGS)])
        t = np.linspace(0.0, 1.0, len(factors))[:, None]
        return tube(low + t * (high - low), 0.42 * thickness * factors, segments=10)
    if draws_style == "round":
        return rod(low, high, 0.5 * thickness * taper, 0.5 * thickness)
    shrink = np.array([taper if draws_style == "tapered" else 1.0, 1.0]) * thickness
    return bar(np.stack([low, high]), shrink, shrink, power=8.0)


def turning_of(draws: Draws) -> int:
    """Which of the turned profiles an instance has."""
    return draws.integer(0, len(_TURNINGS) - 1)


def pedestal(
    assembly: Assembly, draws: Draws, *, height: float, radius: float, color: Color
) -> None:
    """A round foot with a column, from the floor to `height`; a surface of revolution."""
    column = draws.uniform(0.02, 0.035)
    if draws.flag(0.5):  # a trumpet: foot and column in one sweep
        t = np.linspace(0.0, 1.0, 12)
        flare = radius * (1 - t) ** draws.uniform(3.0, 6.0) + column
        top = column + draws.uniform(0.02, 0.07) * t**6
        profile = np.column_stack([np.maximum(flare, top), 0.012 + t * (height - 0.012)])
        assembly.add(lathe([(0, 0), (radius + column, 0), *profile.tolist(), (0, height)]), color)
        return
    rim, rise = draws.uniform(0.012, 0.025), draws.uniform(0.0, 0.03)
    foot = [
        (0, 0),
        (radius, 0),
        (radius, rim),
        (radius * 0.6, rim + rise * 0.5),
        (column * 1.6, rim + rise),
    ]
    assembly.add(lathe([*foot, (0, rim + rise)]), color)
    assembly.add(rod((0, 0, rim), (0, 0, height), column, segments=16), color)
    assembly.add(
        lathe(
            [(0, height - 0.05), (column * 1.8, height - 0.04), (column * 2.6, height), (0, height)]
        ),
        color,
    )


def castor_star(
    assembly: Assembly, draws: Draws, *, height: float, radius: float, arms: int = 5
) -> None:
    """The star foot of an office chair with a gas column up to `height`.

    It maps to itself under turns of 360°/arms about z.
    """
    color = tone(draws, draws.choice(("dark", "metal")))
    castors = draws.flag(0.85)
    wheel = draws.uniform(0.024, 0.032) if castors else 0.006
    hub, arm = 2 * wheel + draws.uniform(0.05, 0.08), draws.uniform(0.018, 0.025)
    path = spline(
        [(0.02, 0, hub), (0.5 * radius, 0, hub - 0.012), (radius, 0, 2 * wheel + 0.02)], 6
    )
    assembly.add_around(
        bar(path, 2 * arm, np.linspace(2 * arm, 1.1 * arm, 6), side=(0, 1, 0)), color, arms
    )
    dark = tone(draws, "dark")
    if castors:
        # Wheels roll along the tangent: their axles are radial, one on either side of the stem.
        disc = lathe([(0, -0.01), (wheel, -0.008), (wheel, 0.008), (0, 0.01)], segments=12).rotated(
            "y", 90.0
        )
        for offset in (-0.014, 0.014):
            assembly.add_around(disc.moved(radius + offset, 0, wheel), dark, arms)
        assembly.add_around(
            rod((radius, 0, wheel), (radius, 0, 2 * wheel + 0.025), 0.008, segments=6), dark, arms
        )
    else:
        assembly.add_around(
            rod((radius, 0, 0), (radius, 0, 0.03), 0.018, 0.012, segments=8), dark, arms
        )
    chrome = tone(draws, "metal")
    # The number of steps is a multiple of the arms, so that the whole foot has the star's symmetry.
    steps = 4 * arms
    assembly.add(rod((0, 0, hub - 0.03), (0, 0, hub + 0.03), 0.042, 0.036, segments=steps), color)
    sleeve = hub + 0.5 * (height - hub)
    assembly.add(rod((0, 0, hub), (0, 0, sleeve), 0.028, segments=steps), shade(color, 0.8))
    assembly.add(rod((0, 0, sleeve), (0, 0, height), 0.018, segments=steps), chrome)
