"""Airplanes: airliners, light aircraft with a propeller, turboprops and fighters; nose at −y."""

from __future__ import annotations

import numpy as np

from i2i.data.sources.synthetic.airplane_parts import (
    cockpit,
    fin,
    fuselage,
    jet,
    propeller,
    tube_line,
    wheel,
    wing,
)
from i2i.data.sources.synthetic.assembly import Assembly
from i2i.data.sources.synthetic.draws import Draws
from i2i.data.sources.synthetic.palette import BLACK, WINDOW, shade, tone
from i2i.data.sources.synthetic.primitives import (
    circle,
    loft,
    rod,
    spline,
    vec,
)
from i2i.data.sources.synthetic.solids import ball, cushion


def airplane(draws: Draws) -> Assembly:
    """One airplane, 2 units long, the nose at −y, the wings along x, the fin up."""
    maker = draws.choice((_airliner, _light, _turboprop, _fighter), (0.4, 0.25, 0.15, 0.2))
    assembly = Assembly()
    maker(assembly, draws)
    return assembly


# === the four kinds ===


def _airliner(assembly: Assembly, draws: Draws) -> None:
    radius, skin, accent = (
        draws.uniform(0.085, 0.125),
        tone(draws, "fuselage"),
        tone(draws, "accent"),
    )
    tail = draws.uniform(0.5, 0.65)
    line = tube_line(
        draws, radius, nose=draws.uniform(0.2, 0.3), tail=tail, lift=draws.uniform(0.6, 0.9)
    )
    fuselage(assembly, line, skin, accent if draws.flag(0.7) else WINDOW)
    cockpit(assembly, -0.90, 0.28 * radius, radius)
    span, sweep, dihedral = (
        draws.uniform(0.8, 1.05),
        draws.uniform(0.42, 0.68),
        draws.uniform(0.06, 0.14),
    )
    chord, metal = draws.uniform(0.34, 0.46), shade(skin, 0.88)
    root = np.array([0.0, draws.uniform(-0.28, -0.14), -0.55 * radius])
    tip = root + vec(span, sweep * span, dihedral * span)
    tip_chord = chord * draws.uniform(0.22, 0.36)
    assembly.add_pair(wing(root, tip, chord=chord, tip_chord=tip_chord, thick=0.05), metal)
    if draws.flag(0.5):  # winglets
        end = tip + vec(0.03, 0.1, draws.uniform(0.06, 0.12))
        assembly.add_pair(
            wing(tip - (0.005, 0, 0), end, chord=tip_chord, tip_chord=0.5 * tip_chord, thick=0.012),
            accent,
        )
    place = draws.choice(("two", "four", "rear"), (0.55, 0.2, 0.25))
    size = radius * (draws.uniform(0.5, 0.7) if place != "four" else draws.uniform(0.4, 0.5))
    pod, dark = jet(draws.uniform(3.4, 4.4) * size, size)
    pod_color = np.where(dark[:, None], BLACK, tone(draws, draws.choice(("fuselage", "accent"))))
    spots = {"two": (0.34,), "four": (0.3, 0.58), "rear": ()}[place]
    for s in spots:
        at = root + s * (tip - root)
        assembly.add_pair(pod.moved(at[0], at[1] - 0.4 * size, at[2] - 1.15 * size), pod_color)
        pylon = wing(
            at + vec(0, -0.1 * size, -0.5 * size),
            at + vec(0.001, 0.6 * size, 0.15 * size),
            chord=2.2 * size,
            tip_chord=2.0 * size,
            thick=0.15 * size,
        )
        assembly.add_pair(pylon, metal)
    if place == "rear":
        x, y = radius + 0.8 * size, 1 - tail + 0.1
        assembly.add_pair(pod.moved(x, y, 0.35 * radius), pod_color)
        assembly.add_pair(
            wing(
                (0.5 * radius, y - size, 0.35 * radius),
                (x, y - 0.8 * size, 0.35 * radius),
                chord=2 * size,
                tip_chord=1.8 * size,
                thick=0.3 * size,
            ),
            metal,
        )
    height = draws.uniform(0.28, 0.38)
    fin_y = 1 - draws.uniform(0.36, 0.44)
    assembly.add(
        fin(draws, fin_y, 0.6 * radius, chord=0.34, height=height, sweep=draws.uniform(0.6, 0.9)),
        accent,
    )
    half = draws.uniform(0.3, 0.4)
    high = place == "rear" or draws.flag(0.08)
    start = (0.0, 0.78, 0.55 * radius + height) if high else (0.0, 0.7, 0.5 * radius)
    assembly.add_pair(
        wing(
            start,
            np.asarray(start) + vec(half, 0.5 * half, 0.08 * half),
            chord=0.22,
            tip_chord=0.1,
            thick=0.022,
        ),
        metal,
    )


def _light(assembly: Assembly, draws: Draws) -> None:
    radius, skin, accent = draws.uniform(0.12, 0.16), tone(draws, "fuselage"), tone(draws, "accent")
    knots = [
        (-0.9, 0.055, -0.02),
        (-0.84, 0.6 * radius, -0.02),
        (-0.55, 0.82 * radius, -0.01),
        (-0.2, radius, 0.015),
        (0.15, 0.85 * radius, 0.01),
        (0.6, 0.4 * radius, 0.03),
        (1.0, 0.12 * radius, 0.05),
    ]
    fuselage(assembly, spline(knots, 18), skin, accent, squash=draws.uniform(0.8, 0.95))
    high = draws.flag(0.5)
    span, chord = draws.uniform(0.9, 1.1), draws.uniform(0.26, 0.34)
    z = 1.02 * radius if high else -0.55 * radius
    root = np.array([0.0, -0.42, z])
    tip = root + vec(
        span,
        draws.uniform(0.0, 0.08),
        draws.uniform(0.0, 0.03) if high else draws.uniform(0.06, 0.12),
    )
    skin_of_wing = accent if draws.flag(0.3) else skin
    assembly.add_pair(
        wing(root, tip, chord=chord, tip_chord=chord * draws.uniform(0.55, 1.0), thick=0.05),
        skin_of_wing,
    )
    if high:
        cabin = cushion(
            (1.5 * radius, 0.5, 0.9 * radius), (0, -0.22, 0.62 * radius), power=4.0, steps=6
        )
        assembly.add(cabin, WINDOW)
        strut = root + 0.5 * (tip - root) + vec(0, 0.12, 0)
        assembly.add_pair(rod((0.6 * radius, -0.28, -0.6 * radius), strut, 0.011, segments=6), skin)
    else:
        assembly.add(
            ball((0.62 * radius, 0.3, 0.62 * radius), (0, -0.15, 0.85 * radius), steps=6), WINDOW
        )
    biplane = high and draws.flag(0.2)
    if biplane:
        low = root + vec(0.0, 0.08, -1.7 * radius)
        assembly.add_pair(
            wing(
                low,
                low + vec(0.92 * span, 0, 0.04),
                chord=0.9 * chord,
                tip_chord=0.8 * chord,
                thick=0.04,
            ),
            skin_of_wing,
        )
    propeller(assembly, draws, (0, -0.9, -0.02), draws.uniform(0.22, 0.3), draws.choice((2, 3)))
    assembly.add(
        fin(
            draws,
            0.68,
            0.05,
            chord=0.28,
            height=draws.uniform(0.24, 0.34),
            sweep=draws.uniform(0.3, 0.8),
        ),
        accent,
    )
    half = draws.uniform(0.32, 0.42)
    assembly.add_pair(
        wing((0, 0.74, 0.05), (half, 0.8, 0.06), chord=0.22, tip_chord=0.14, thick=0.025),
        skin_of_wing,
    )
    if draws.flag(0.75):
        floor = -radius - draws.uniform(0.12, 0.18)
        wheel(assembly, 0.24, -0.28, -0.7 * radius, floor, 0.055)
        front = draws.flag(0.6)
        wheel(assembly, 0.0, -0.72 if front else 0.9, -0.05, floor if front else -0.12, 0.045)


def _turboprop(assembly: Assembly, draws: Draws) -> None:
    radius, skin, accent = draws.uniform(0.1, 0.13), tone(draws, "fuselage"), tone(draws, "accent")
    line = tube_line(draws, radius, nose=draws.uniform(0.28, 0.4), tail=0.7, lift=1.0)
    fuselage(assembly, line, skin, accent if draws.flag(0.7) else WINDOW)
    cockpit(assembly, -0.86, 0.3 * radius, radius)
    high = draws.flag(0.6)
    root = np.array([0.0, -0.2, (0.85 if high else -0.6) * radius])
    span, chord = draws.uniform(0.9, 1.1), draws.uniform(0.26, 0.34)
    tip = root + vec(span, 0.06, 0.0 if high else 0.08)
    assembly.add_pair(
        wing(root, tip, chord=chord, tip_chord=0.5 * chord, thick=0.045), shade(skin, 0.9)
    )
    size = draws.uniform(0.045, 0.06)
    s, reach = draws.uniform(0.28, 0.36), draws.uniform(0.14, 0.2)
    blades, disc = draws.choice((3, 4, 6)), draws.uniform(0.15, 0.2)
    at = root + s * (tip - root)
    front = at[1] - reach
    line = spline(
        [
            (front, 0.7 * size, 0),
            (front + 0.08, size, 0),
            (at[1] + 0.2, 0.9 * size, 0),
            (at[1] + 0.42, 0.15 * size, 0),
        ],
        8,
    )
    around = circle(12)
    rings = np.stack(
        [
            np.column_stack([at[0] + r * around[:, 0], np.full(12, y), at[2] + r * around[:, 1]])
            for y, r, _ in line
        ]
    )
    assembly.add_pair(loft(rings), accent)
    for sign in (-1.0, 1.0):
        propeller(assembly, draws, (sign * at[0], front, at[2]), disc, blades)
    height = draws.uniform(0.32, 0.4)
    assembly.add(
        fin(draws, 0.6, 0.8 * radius, chord=0.32, height=height, sweep=draws.uniform(0.4, 0.7)),
        accent,
    )
    start = (
        np.array([0.0, 0.76, 0.7 * radius + height])
        if draws.flag(0.6)
        else np.array([0.0, 0.72, 0.7 * radius])
    )
    assembly.add_pair(
        wing(start, start + vec(0.36, 0.07, 0.0), chord=0.2, tip_chord=0.12, thick=0.022),
        shade(skin, 0.9),
    )


def _fighter(assembly: Assembly, draws: Draws) -> None:
    radius = draws.uniform(0.09, 0.12)
    skin = tone(draws, draws.choice(("metal", "dark", "fuselage", "paint"), (0.45, 0.15, 0.2, 0.2)))
    knots = [
        (-1.0, 0.012, -0.01),
        (-0.8, 0.4 * radius, 0.0),
        (-0.5, 0.75 * radius, 0.015),
        (-0.1, radius, 0.0),
        (0.5, radius, 0.0),
        (0.8, 0.85 * radius, 0.0),
        (0.96, 0.6 * radius, 0.0),
    ]
    fuselage(assembly, spline(knots, 18), skin, None, squash=draws.uniform(1.0, 1.4))
    canopy = ball(
        (0.5 * radius, draws.uniform(0.16, 0.24), 0.55 * radius),
        (0, draws.uniform(-0.48, -0.36), 0.75 * radius),
        steps=6,
    )
    assembly.add(canopy, (96, 84, 50) if draws.flag(0.3) else WINDOW)
    delta = draws.flag(0.5)
    span, chord = (
        draws.uniform(0.55, 0.72),
        draws.uniform(0.8, 0.95) if delta else draws.uniform(0.5, 0.65),
    )
    y, sweep = (
        (0.85 - chord, draws.uniform(0.95, 1.2))
        if delta
        else (draws.uniform(-0.15, 0.0), draws.uniform(0.5, 0.85))
    )
    under = shade(skin, 0.92)
    root = np.array([0.3 * radius, y, draws.uniform(-0.3, 0.3) * radius])
    tip = root + vec(span, sweep * span, 0.0)
    tip_chord = max(0.08, chord - sweep * span) if delta else chord * draws.uniform(0.25, 0.45)
    assembly.add_pair(wing(root, tip, chord=chord, tip_chord=tip_chord, thick=0.035), under)
    if draws.flag(0.5):  # missiles at the wing tips
        assembly.add_pair(
            rod(tip + vec(0, -0.1, 0), tip + vec(0, 0.22, 0), 0.014, segments=8), (225, 225, 225)
        )
    intake = cushion(
        (0.8 * radius, 0.55, 1.1 * radius),
        (1.05 * radius, -0.02, -0.1 * radius),
        power=5.0,
        steps=5,
    )
    assembly.add_pair(intake, under)
    assembly.add_pair(
        cushion(
            (0.6 * radius, 0.02, 0.85 * radius),
            (1.05 * radius, -0.295, -0.1 * radius),
            power=5.0,
            steps=3,
        ),
        BLACK,
    )
    twin = draws.flag(0.45)
    height, place = draws.uniform(0.26, 0.36), draws.uniform(0.42, 0.55)
    x = 0.75 * radius if twin else 0.0
    tail_fin = fin(
        draws,
        place,
        0.6 * radius,
        chord=draws.uniform(0.3, 0.4),
        height=height,
        sweep=draws.uniform(0.6, 1.0),
        x=x,
        cant=draws.uniform(0.0, 0.4) if twin else 0.0,
    )
    (assembly.add_pair if twin else assembly.add)(
        tail_fin, tone(draws, "accent") if draws.flag(0.4) else skin
    )
    if not delta or draws.flag(0.2):
        assembly.add_pair(
            wing((0.5 * radius, 0.68, 0), (0.42, 0.9, 0), chord=0.28, tip_chord=0.1, thick=0.02),
            under,
        )
    elif draws.flag(0.6):  # canards
        assembly.add_pair(
            wing(
                (0.4 * radius, -0.36, 0.3 * radius),
                (0.3, -0.2, 0.35 * radius),
                chord=0.18,
                tip_chord=0.06,
                thick=0.015,
            ),
            under,
        )
    for offset in (-0.5, 0.5) if twin else (0.0,):
        nozzle = rod(
            (offset * radius, 0.85, 0),
            (offset * radius, 1.03, 0),
            0.62 * radius,
            0.5 * radius,
            segments=16,
        )
        assembly.add(nozzle, (70, 68, 66))
