"""Bottles: surfaces of revolution, from wine and beer to water, medicine and sauce."""

from __future__ import annotations

import numpy as np

from i2i.data.sources.synthetic.assembly import Assembly
from i2i.data.sources.synthetic.draws import Draws
from i2i.data.sources.synthetic.palette import shade, tone
from i2i.data.sources.synthetic.primitives import Floats, band_of_face, lathe, spline

SEGMENTS = 36
"""Steps around: a bottle maps to itself, exactly, under turns of 360°/36 about z."""


def bottle(draws: Draws) -> Assembly:
    """One bottle, 1 unit being its widest diameter, standing on z = 0."""
    assembly = Assembly()
    body, neck = draws.uniform(1.0, 2.6), draws.uniform(0.2, 1.3)
    shoulder, mouth = draws.uniform(0.15, 0.9), draws.uniform(0.12, 0.22)
    waist = draws.choice((0.0, draws.uniform(0.03, 0.1)), (0.65, 0.35))
    outline = _outline(draws, body, shoulder, neck, mouth, waist)
    ribs = draws.choice((0, draws.integer(4, 9)), (0.75, 0.25))
    if ribs:
        on_body = np.clip((outline[:, 1] - 0.1) / (body - 0.2), 0, 1)
        outline[:, 0] -= 0.012 * np.sin(np.pi * ribs * on_body) ** 2 * (on_body > 0) * (on_body < 1)
    top = body + shoulder + neck
    glass = tone(draws, draws.choice(("glass", "plastic"), (0.65, 0.35)))
    foot = [(0.0, 0.04), (0.3, 0.02), (0.42, 0.0)]  # the punt, and the rim that it stands on
    profile = np.concatenate([foot, outline, [(0.8 * mouth, top), (0.0, top)]])
    assembly.add(lathe(profile, segments=SEGMENTS), glass)
    _label(assembly, draws, outline, body)
    _closure(assembly, draws, mouth, top, neck)
    return assembly


def _outline(
    draws: Draws, body: float, shoulder: float, neck: float, mouth: float, waist: float
) -> Floats:
    """(radius, z) from the heel to the mouth, shape (P, 2)."""
    heel, bulge = draws.uniform(0.03, 0.12), draws.uniform(0.0, 0.06)
    t = np.linspace(0, 1, 5)
    lower = np.column_stack(
        [0.5 - heel * (1 - np.sin(0.5 * np.pi * t)), heel * (1 - np.cos(0.5 * np.pi * t))]
    )
    z = np.linspace(heel, body, 16)[1:]
    s = (z - heel) / (body - heel)
    side = np.column_stack([0.5 - waist * np.sin(np.pi * s) ** 2 + bulge * (s - s**2), z])
    # The shoulder goes from upright through its slope to upright again: steep for a Bordeaux
    # bottle, long for a Burgundy one, by the power of its ease.
    s, ease = np.linspace(0, 1, 12)[1:], draws.uniform(0.55, 1.6)
    base = mouth + draws.uniform(0.0, 0.04)
    blend = 0.5 - 0.5 * np.cos(np.pi * s**ease)
    slope = np.column_stack([0.5 + (base - 0.5) * blend, body + shoulder * s])
    up = np.linspace(0, 1, 5)[1:]
    upper = np.column_stack([base + (mouth - base) * up, body + shoulder + neck * up])
    lip = draws.uniform(0.0, 0.03)
    upper[-1, 0] += lip
    upper = np.insert(upper, 3, [upper[2, 0] + lip, body + shoulder + 0.88 * neck], axis=0)
    return np.concatenate([lower, side, slope, upper])


def _label(assembly: Assembly, draws: Draws, outline: Floats, body: float) -> None:
    """A band of paper just outside the body, sometimes with a stripe."""
    if draws.flag(0.2):
        return
    low, high = body * draws.uniform(0.12, 0.35), body * draws.uniform(0.6, 0.9)
    z = np.linspace(low, high, 9)
    radius = np.interp(z, outline[:, 1], outline[:, 0]) + 0.006
    profile = [
        (radius[0] - 0.02, low - 0.002),
        *np.column_stack([radius, z]).tolist(),
        (radius[-1] - 0.02, high + 0.002),
    ]
    paper, stripe = tone(draws, "ceramic"), tone(draws, "accent")
    if draws.flag(0.3):
        paper, stripe = stripe, paper
    band = band_of_face(len(profile), SEGMENTS)
    first = draws.integer(1, 5)
    marked = (band >= first) & (band < first + draws.integer(1, 3))
    assembly.add(lathe(profile, segments=SEGMENTS), np.where(marked[:, None], stripe, paper))


def _closure(assembly: Assembly, draws: Draws, mouth: float, top: float, neck: float) -> None:
    kind = draws.choice(("screw", "cork", "crown", "foil", "nozzle"), (0.35, 0.15, 0.15, 0.2, 0.15))
    color = tone(draws, draws.choice(("accent", "plastic", "metal")))
    wide = mouth + 0.035
    if kind == "screw":
        high = draws.uniform(0.12, 0.3)
        profile = [
            (0, top - 0.4 * high),
            (wide, top - 0.4 * high),
            (wide, top + 0.5 * high),
            (wide - 0.03, top + 0.6 * high),
            (0, top + 0.6 * high),
        ]
    elif kind == "cork":
        color = tone(draws, "wood")
        profile = [
            (0, top - 0.02),
            (0.8 * mouth, top - 0.02),
            (0.92 * mouth, top + draws.uniform(0.06, 0.16)),
        ]
        profile += [(0, profile[-1][1])]
    elif kind == "crown":
        profile = [
            (0, top - 0.05),
            (wide + 0.015, top - 0.05),
            (wide, top),
            (0.8 * mouth, top + 0.035),
            (0, top + 0.035),
        ]
    elif kind == "foil":
        low = top - neck * draws.uniform(0.4, 0.8)
        profile = [
            (0, low),
            (wide, low),
            (wide, top + 0.01),
            (wide - 0.02, top + 0.03),
            (0, top + 0.03),
        ]
    else:
        knots = [
            (wide, top - 0.06),
            (wide, top + 0.06),
            (0.45 * mouth, top + 0.2),
            (0.25 * mouth, top + draws.uniform(0.4, 0.6)),
        ]
        line = spline(knots, 10)
        profile = [(0, line[0, 1]), *line.tolist(), (0, line[-1, 1])]
    assembly.add(lathe(profile, segments=SEGMENTS), color)
    if kind == "screw" and draws.flag(0.4):
        low = profile[0][1] - 0.06
        assembly.add(
            lathe(
                [(0, low), (wide + 0.02, low), (wide + 0.02, low + 0.04), (0, low + 0.04)],
                segments=SEGMENTS,
            ),
            shade(color, 0.85),
        )
