"""Tables (exactly two-fold symmetric) and desks (drawers on one side)."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from i2i.data.sources.synthetic.assembly import Assembly
from i2i.data.sources.synthetic.bases import LEG_STYLES, leg, turning_of
from i2i.data.sources.synthetic.draws import Draws
from i2i.data.sources.synthetic.palette import CHROME, Color, shade, tone
from i2i.data.sources.synthetic.primitives import (
    Part,
    bar,
    circle,
    fillet,
    plate,
    rod,
    superellipse,
    tube,
    vec,
)
from i2i.data.sources.synthetic.solids import box, span

# === table ===


def table(draws: Draws) -> Assembly:
    """One plain rectangular table; lengths in metres, floor at z = 0, longer along x.

    Every part comes with its copy turned by 180° about z, or is its own: the table maps to itself
    under that turn exactly, and under no other (it is 1.4 to 2.4 times longer than wide).
    """
    assembly = Assembly()
    wide = draws.uniform(0.36, 0.5)
    half, height = wide * draws.uniform(1.4, 2.4), draws.uniform(0.68, 0.8)
    wood = tone(draws, draws.choice(("wood", "dark", "plastic"), (0.8, 0.1, 0.1)))
    top = wood if draws.flag(0.6) else tone(draws, "wood")
    thick, overhang = draws.uniform(0.022, 0.05), draws.uniform(0.03, 0.14)
    if draws.flag(0.6):
        assembly.add(
            box(
                (2 * half, 2 * wide, thick),
                (0, 0, height - 0.5 * thick),
                radius=0.4 * thick,
                steps=2,
            ),
            top,
        )
    else:
        outline = superellipse(half, wide, power=draws.uniform(8, 30), segments=40)
        assembly.add(plate(outline, height - thick, height, bevel=0.4 * thick), top)
    kind = draws.choice(("legs", "trestle", "panels", "sled"), (0.6, 0.18, 0.1, 0.12))
    corner = np.array([half - overhang - 0.03, wide - 0.6 * overhang - 0.03, height - thick])
    makers = {"legs": _table_legs, "trestle": _trestle, "panels": _panels, "sled": _sled}
    makers[kind](assembly, draws, corner, wood)
    return assembly


def _corners(assembly: Assembly, part: Part, color: Color) -> None:
    """A part at the corner (+x, +y), and at the other three."""
    assembly.add_half_turn(part, color)
    assembly.add_half_turn(part.mirrored("y"), color)


def _apron(assembly: Assembly, corner: np.ndarray, deep: float, wood: Color) -> None:
    x, y, top = corner
    assembly.add_half_turn(box((2 * x, 0.022, deep), (0, y, top - 0.5 * deep)), wood)
    assembly.add_half_turn(box((0.022, 2 * y, deep), (x, 0, top - 0.5 * deep)), wood)


def _table_legs(assembly: Assembly, draws: Draws, corner: np.ndarray, wood: Color) -> None:
    x, y, top = corner
    splay, thick = draws.choice((0.0, draws.uniform(0.02, 0.08))), draws.uniform(0.05, 0.09)
    style = draws.choice(LEG_STYLES)
    part = leg(
        style,
        (x + splay, y + 0.7 * splay, 0),
        (x, y, top),
        thick,
        taper=draws.uniform(0.45, 0.8),
        turning=turning_of(draws),
    )
    _corners(assembly, part, wood)
    if draws.flag(0.75):
        _apron(assembly, corner, draws.uniform(0.06, 0.12), shade(wood, 0.93))
    if draws.flag(0.25):
        level = draws.uniform(0.1, 0.2)
        fx, fy = x + splay * (1 - level / top), y + 0.7 * splay * (1 - level / top)
        assembly.add_half_turn(rod((fx, -fy, level), (fx, fy, level), 0.018, segments=8), wood)
        assembly.add(box((2 * fx, 0.03, 0.04), (0, 0, level)), wood)


def _trestle(assembly: Assembly, draws: Draws, corner: np.ndarray, wood: Color) -> None:
    x, y, top = corner * (0.85, 1.0, 1.0)
    thick, post = draws.uniform(0.05, 0.08), draws.uniform(0.3, 0.8) * y
    assembly.add_half_turn(box((thick, 1.9 * y, 0.07), (x, 0, 0.035)), wood)
    assembly.add_half_turn(box((thick, 1.8 * y, 0.05), (x, 0, top - 0.025)), wood)
    if draws.flag(0.5):
        assembly.add_half_turn(box((0.8 * thick, post, top), (x, 0, 0.5 * top)), wood)
    else:
        for sign in (-1.0, 1.0):
            path = np.array([[x, -sign * 0.8 * y, 0.05], [x, sign * 0.8 * y, top - 0.03]])
            assembly.add_half_turn(bar(path, 0.7 * thick, thick), wood)
    assembly.add(
        box((2 * x, 0.035, draws.uniform(0.06, 0.12)), (0, 0, draws.uniform(0.2, 0.5) * top)), wood
    )


def _panels(assembly: Assembly, draws: Draws, corner: np.ndarray, wood: Color) -> None:
    x, y, top = corner
    thick = draws.uniform(0.03, 0.06)
    assembly.add_half_turn(box((thick, 2 * y, top), (x, 0, 0.5 * top)), wood)
    high = draws.uniform(0.1, 0.3)
    assembly.add(box((2 * x, 0.03, high), (0, 0, top - 0.5 * high)), shade(wood, 0.93))


def _sled(assembly: Assembly, draws: Draws, corner: np.ndarray, wood: Color) -> None:
    x, y, top = corner
    del wood  # always of metal
    metal, width = tone(draws, draws.choice(("metal", "dark"))), draws.uniform(0.03, 0.07)
    path = [(x, -y, top), (x, -y * draws.uniform(0.8, 1.0), 0.02), (x, 0, 0.02)]
    assembly.add_half_turn(bar(fillet(path, 0.05), width, 0.03), metal)
    assembly.add_half_turn(bar(fillet(path, 0.05), width, 0.03).mirrored("y"), metal)
    _apron(assembly, corner, 0.05, metal)


# === desk ===


def desk(draws: Draws) -> Assembly:
    """One desk; lengths in metres, floor at z = 0; who works at it sits at −y.

    The drawers are on the right as seen from there (+x), with their handles towards −y; a modesty
    panel closes the rear.
    """
    assembly = Assembly()
    half, deep, height = (
        0.5 * draws.uniform(1.1, 1.8),
        0.5 * draws.uniform(0.55, 0.82),
        draws.uniform(0.7, 0.78),
    )
    wood = tone(draws, draws.choice(("wood", "dark", "ceramic"), (0.75, 0.1, 0.15)))
    body = (
        wood
        if draws.flag(0.55)
        else tone(draws, draws.choice(("wood", "dark", "metal", "ceramic")))
    )
    thick = draws.uniform(0.022, 0.04)
    assembly.add(
        box((2 * half, 2 * deep, thick), (0, 0, height - 0.5 * thick), radius=0.008, steps=2), wood
    )
    under = height - thick
    unit = draws.uniform(0.36, 0.5)
    right, inset = half - draws.uniform(0.0, 0.06), draws.uniform(0.01, 0.05)
    floor = draws.choice((0.0, 0.05, draws.uniform(0.08, 0.3)), (0.4, 0.3, 0.3))
    _drawers(
        assembly, draws, (right - unit, -deep + inset, floor), (right, deep - inset, under), body
    )
    _left_side(assembly, draws, half, deep, under, body)
    if floor > 0.06:
        metal = tone(draws, draws.choice(("metal", "wood", "dark")))
        for x in (right - unit + 0.04, right - 0.04):
            for y in (-deep + inset + 0.04, deep - inset - 0.04):
                assembly.add(rod((x, y, 0), (x, y, floor + 0.01), 0.014, 0.02, segments=8), metal)
    elif floor > 0:
        assembly.add(
            span((right - unit + 0.03, -deep + 0.08, 0), (right - 0.03, deep - 0.06, floor)),
            shade(body, 0.5),
        )
    panel = draws.uniform(0.3, 0.9) * under
    y = deep - draws.uniform(0.02, 0.06)
    assembly.add(
        span((-half + 0.04, y - 0.018, under - panel), (right - 0.01, y, under)), shade(body, 0.92)
    )
    if draws.flag(0.35):
        low, high = (
            (-half + 0.05, -deep + inset, under - 0.11),
            (right - unit, deep - inset - 0.1, under),
        )
        _drawer_fronts(assembly, draws, low, high, body, 1)
        assembly.add(span((low[0], low[1] + 0.005, low[2]), high), shade(body, 0.95))
    _on_top(assembly, draws, half, deep, height, wood)
    return assembly


def _drawers(
    assembly: Assembly,
    draws: Draws,
    low: tuple[float, float, float],
    high: tuple[float, float, float],
    body: Color,
) -> None:
    assembly.add(span(low, high), body)
    margin = 0.015
    fronts_low = (low[0] + margin, low[1], low[2] + margin)
    _drawer_fronts(
        assembly,
        draws,
        fronts_low,
        (high[0] - margin, high[1], high[2] - margin),
        body,
        draws.integer(2, 4),
    )


def _drawer_fronts(
    assembly: Assembly,
    draws: Draws,
    low: tuple[float, float, float],
    high: tuple[float, float, float],
    body: Color,
    count: int,
) -> None:
    """Fronts that stand out towards −y by 2 cm, each with a handle."""
    front = shade(body, draws.choice((0.82, 1.12)))
    last = draws.uniform(1.0, 2.2) if count > 1 else 1.0  # the lowest drawer may be a deep one
    share = np.array([last] + [1.0] * (count - 1))
    edges = low[2] + (high[2] - low[2]) * np.concatenate([[0.0], np.cumsum(share) / share.sum()])
    handle, metal = (
        draws.choice(("knob", "bar", "cup")),
        tone(draws, draws.choice(("metal", "dark"))),
    )
    middle = 0.5 * (low[0] + high[0])
    for z0, z1 in pairwise(edges):
        assembly.add(
            span((low[0], low[1] - 0.02, z0 + 0.006), (high[0], low[1] + 0.01, z1 - 0.006)), front
        )
        z, y = 0.5 * (z0 + z1), low[1] - 0.02
        if handle == "knob":
            assembly.add(
                rod((middle, y, z), (middle, y - 0.03, z), 0.012, 0.018, segments=10), metal
            )
        elif handle == "bar":
            path = [
                (middle - 0.07, y, z),
                (middle - 0.07, y - 0.03, z),
                (middle + 0.07, y - 0.03, z),
                (middle + 0.07, y, z),
            ]
            assembly.add(tube(fillet(path, 0.012, steps=2), 0.006, segments=6), metal)
        else:
            assembly.add(
                box((0.1, 0.025, 0.03), (middle, y - 0.01, z + 0.01), radius=0.01, steps=2), metal
            )


def _left_side(
    assembly: Assembly, draws: Draws, half: float, deep: float, under: float, body: Color
) -> None:
    kind = draws.choice(("panel", "legs", "sled"), (0.4, 0.4, 0.2))
    x = -half + draws.uniform(0.03, 0.07)
    if kind == "panel":
        assembly.add(span((x - 0.02, -deep + 0.03, 0), (x + 0.01, deep - 0.03, under)), body)
        return
    metal = tone(draws, draws.choice(("metal", "dark", "wood")))
    if kind == "sled":
        path = [
            (x, -deep + 0.06, under),
            (x, -deep + 0.06, 0.02),
            (x, deep - 0.06, 0.02),
            (x, deep - 0.06, under),
        ]
        assembly.add(bar(fillet(path, 0.04), 0.04, 0.03), metal)
        return
    style, turning, splay = draws.choice(LEG_STYLES), turning_of(draws), draws.uniform(0.0, 0.04)
    for y in (-deep + 0.06, deep - 0.06):
        assembly.add(
            leg(style, (x - splay, y, 0), (x, y, under), 0.05, taper=0.6, turning=turning), metal
        )


def _on_top(
    assembly: Assembly, draws: Draws, half: float, deep: float, height: float, wood: Color
) -> None:
    """A shelf at the rear, a screen, a lamp, or nothing."""
    kind = draws.choice(("none", "hutch", "screen", "lamp"), (0.4, 0.25, 0.2, 0.15))
    if kind == "hutch":
        high, back = draws.uniform(0.15, 0.45), deep - 0.24
        low = -half + draws.choice((0.02, draws.uniform(0.1, 0.7) * half))
        assembly.add(
            span((low, back, height + high), (half - 0.02, deep - 0.01, height + high + 0.02)), wood
        )
        for x in np.linspace(low + 0.01, half - 0.03, draws.integer(2, 4)):
            assembly.add(
                span((x - 0.01, back, height), (x + 0.01, deep - 0.01, height + high)), wood
            )
        assembly.add(
            span((low, deep - 0.02, height), (half - 0.02, deep - 0.01, height + high)),
            shade(wood, 0.9),
        )
    elif kind == "screen":
        wide, x, dark = (
            draws.uniform(0.4, 0.65),
            draws.uniform(-0.35, 0.0) * half,
            tone(draws, "dark"),
        )
        assembly.add(
            plate(circle(16) * (0.11, 0.08) + (x, 0.35 * deep), height, height + 0.012), dark
        )
        assembly.add(box((0.04, 0.02, 0.2), (x, 0.4 * deep, height + 0.1)), dark)
        panel = box(
            (wide, 0.02, 0.6 * wide),
            (x, 0.4 * deep - 0.02, height + 0.12 + 0.3 * wide),
            radius=0.006,
        )
        assembly.add(panel, dark)
        inner = box(
            (wide - 0.03, 0.004, 0.6 * wide - 0.03),
            (x, 0.4 * deep - 0.031, height + 0.12 + 0.3 * wide),
            radius=0.001,
        )
        assembly.add(inner, (96, 130, 160))
    elif kind == "lamp":
        x, y, color = -half + 0.16, deep - 0.16, tone(draws, "plastic")
        assembly.add(plate(circle(16) * 0.08 + (x, y), height, height + 0.02), color)
        path = [
            (x, y, height + 0.01),
            (x - 0.03, y + 0.02, height + 0.25),
            (x + 0.18, y - 0.12, height + 0.42),
        ]
        assembly.add(tube(path, 0.008, segments=6), CHROME)
        end = np.array(path[-1])
        assembly.add(
            rod(end + vec(0, 0, 0.02), end + vec(0.05, -0.03, -0.08), 0.02, 0.07, segments=14),
            color,
        )
