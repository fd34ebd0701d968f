"""Chairs: dining chairs of wood, shells, office chairs, cantilevers of bent tube, lounge chairs."""

from __future__ import annotations

import numpy as np

from i2i.data.sources.synthetic.assembly import Assembly
from i2i.data.sources.synthetic.bases import castor_star, leg, pedestal
from i2i.data.sources.synthetic.chair_backs import Back
from i2i.data.sources.synthetic.dining_chairs import dining_chair
from i2i.data.sources.synthetic.draws import Draws
from i2i.data.sources.synthetic.palette import Color, shade, tone
from i2i.data.sources.synthetic.primitives import (
    Part,
    bar,
    fillet,
    rod,
    slab,
    spline,
    tube,
    vec,
)
from i2i.data.sources.synthetic.solids import box, cushion


def chair(draws: Draws) -> Assembly:
    """One chair; lengths in metres, floor at z = 0, the sitter looks towards −y."""
    makers = (dining_chair, _shell_chair, _office_chair, _cantilever_chair, _lounge_chair)
    maker = draws.choice(makers, (0.46, 0.18, 0.15, 0.1, 0.11))
    assembly = Assembly()
    maker(assembly, draws)
    return assembly


# === shell chair ===


def _shell(draws: Draws, seat: float) -> Part:
    """Seat and back as one bent and dished sheet."""
    depth, height = draws.uniform(0.40, 0.46), draws.uniform(0.32, 0.46)
    lean, lip = draws.uniform(0.08, 0.17), draws.uniform(0.0, 0.05)
    crease = draws.uniform(0.04, 0.1)
    side = spline(
        [
            (-0.5 * depth, seat - lip),
            (-0.42 * depth, seat + 0.006),
            (0.1 * depth, seat - 0.02),
            (0.5 * depth - crease, seat - 0.005),
            (0.5 * depth + 0.012, seat + crease),
            (0.5 * depth + 0.45 * lean, seat + 0.55 * height),
            (0.5 * depth + lean, seat + height),
        ],
        20,
    )  # (y, z), from the front lip to the top of the back
    t, u = np.linspace(0.0, 1.0, 20), np.linspace(-1.0, 1.0, 11)
    half = draws.uniform(0.21, 0.26) * (1 - 0.10 * t)
    waist = draws.uniform(0.0, 0.16) * np.exp(-(((t - 0.55) / 0.13) ** 2))
    rounding = np.minimum(t / 0.12, 1.0) * np.minimum((1 - t) / draws.uniform(0.10, 0.3), 1.0)
    half = half * (1 - waist) * (0.72 + 0.28 * np.sqrt(np.clip(rounding * (2 - rounding), 0, 1)))
    tangent = np.gradient(side, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    # The sides bend towards the sitter, most of all where the seat turns into the back.
    wrap = draws.uniform(0.02, 0.05) + draws.uniform(0.0, 0.10) * np.exp(
        -(((t - 0.58) / 0.16) ** 2)
    )
    bend = wrap[:, None] * np.abs(u) ** 2.2
    grid = np.empty((20, 11, 3))
    grid[..., 0] = half[:, None] * u
    grid[..., 1] = side[:, :1] - bend * tangent[:, 1:]
    grid[..., 2] = side[:, 1:] + bend * tangent[:, :1]
    return slab(grid, draws.uniform(0.01, 0.018))


def _shell_chair(assembly: Assembly, draws: Draws) -> None:
    seat = draws.uniform(0.41, 0.47)
    color = tone(draws, draws.choice(("plastic", "wood", "fabric"), (0.6, 0.2, 0.2)))
    assembly.add(_shell(draws, seat), color)
    if draws.flag(0.3):
        cloth = tone(draws, "fabric")
        assembly.add(cushion((0.36, 0.36, 0.05), (0, -0.01, seat + 0.012), power=5.0), cloth)
    base = draws.choice(("dowel", "sled", "pedestal", "star"), (0.45, 0.25, 0.15, 0.15))
    under = seat - 0.03
    metal = tone(draws, draws.choice(("metal", "dark")))
    if base == "pedestal":
        pedestal(assembly, draws, height=under, radius=draws.uniform(0.2, 0.27), color=metal)
    elif base == "star":
        castor_star(
            assembly,
            draws,
            height=under,
            radius=draws.uniform(0.24, 0.3),
            arms=draws.choice((4, 5)),
        )
    elif base == "sled":
        _sled(assembly, draws, under, metal)
    else:
        _dowels(assembly, draws, under, metal)
    if base != "sled":
        assembly.add(box((0.22, 0.22, 0.02), (0, 0, under), radius=0.006), metal)


def _dowels(assembly: Assembly, draws: Draws, under: float, metal: Color) -> None:
    wood = tone(draws, "wood")
    spread, thick = draws.uniform(0.19, 0.25), draws.uniform(0.011, 0.018)
    for sign in (-1.0, 1.0):
        foot, top = np.array([spread, sign * spread, 0.0]), np.array([0.13, sign * 0.13, under])
        assembly.add_pair(rod(foot, top, 0.65 * thick, thick), wood)
    if draws.flag(0.6):  # a brace of wire
        low = np.array([spread - 0.02, 0.0, 0.35 * under])
        for sign in (-1.0, 1.0):
            assembly.add_pair(
                rod(
                    low + vec(0, sign * (spread - 0.03), 0),
                    (-0.13, sign * 0.12, under),
                    0.005,
                    segments=6,
                ),
                metal,
            )


def _sled(assembly: Assembly, draws: Draws, under: float, metal: Color) -> None:
    half, reach, radius = (
        draws.uniform(0.2, 0.24),
        draws.uniform(0.18, 0.22),
        draws.uniform(0.007, 0.011),
    )
    inner = 0.62 * half
    path = [
        (inner, -0.12, under),
        (half, -reach, radius),
        (half, reach, radius),
        (inner, 0.12, under),
    ]
    assembly.add_pair(tube(fillet(path, 0.06), radius, segments=8), metal)
    for y in (-0.12, 0.12):
        assembly.add(rod((inner, y, under), (-inner, y, under), radius, segments=8), metal)


# === office chair ===


def _office_chair(assembly: Assembly, draws: Draws) -> None:
    seat, width, depth = (
        draws.uniform(0.42, 0.5),
        draws.uniform(0.46, 0.54),
        draws.uniform(0.44, 0.52),
    )
    cloth = tone(draws, draws.choice(("fabric", "dark", "leather")))
    dark = tone(draws, draws.choice(("dark", "metal")))
    castor_star(assembly, draws, height=seat - 0.02, radius=draws.uniform(0.28, 0.34))
    assembly.add(box((0.2, 0.24, 0.04), (0, 0, seat - 0.02), radius=0.01), dark)
    puff = draws.uniform(0.06, 0.1)
    assembly.add(
        cushion(
            (width, depth, puff), (0, 0, seat + 0.5 * puff), power=draws.uniform(3.5, 6.0), steps=8
        ),
        cloth,
    )
    height, rise = draws.uniform(0.42, 0.66), draws.uniform(0.06, 0.16)
    back = Back(
        half_width=0.5 * width * draws.uniform(0.82, 0.96),
        flare=draws.uniform(0.75, 1.02),
        y=0.5 * depth + 0.02,
        z=seat + rise,
        height=height,
        recline=np.tan(np.radians(draws.uniform(5, 14))),
        bow=draws.uniform(0.04, 0.09),
        lumbar=draws.uniform(0.02, 0.045),
    )
    thick = draws.choice((0.02, draws.uniform(0.05, 0.09)))
    assembly.add(back.sheet(thickness=thick, rounding=draws.uniform(0.12, 0.3)), cloth)
    spine = [
        (0, 0.05, seat - 0.02),
        (0, 0.5 * depth + 0.03, seat - 0.02),
        (0, 0.5 * depth + 0.075 + 0.5 * thick, seat + 0.1),
    ]
    spine += [tuple(back.at(0.0, 0.45) + vec(0, 0.5 * thick + 0.005, 0))]
    assembly.add(bar(fillet(spine, 0.08), draws.uniform(0.05, 0.09), 0.022), dark)
    if draws.flag(0.3):
        top = back.at(0.0, 1.0)
        assembly.add(box((0.04, 0.018, 0.12), top + vec(0, 0.01, 0.02)), dark)
        assembly.add(cushion((0.27, 0.07, 0.15), top + vec(0, -0.005, 0.12), power=4.0), cloth)
    arms = draws.choice(("none", "t", "loop"), (0.2, 0.5, 0.3))
    if arms != "none":
        _office_arms(assembly, draws, arms, 0.5 * width, depth, seat, dark)


def _office_arms(
    assembly: Assembly, draws: Draws, kind: str, half: float, depth: float, seat: float, dark: Color
) -> None:
    level, x = seat + draws.uniform(0.22, 0.29), half + 0.03
    if kind == "t":
        path = fillet([(0.1, 0.02, seat - 0.015), (x, 0.02, seat - 0.01), (x, 0.02, level)], 0.05)
        assembly.add_pair(bar(path, 0.055, 0.02, side=(0, 1, 0)), dark)
    else:
        front = -draws.uniform(0.2, 0.32) * depth
        knots = [
            (0.1, front, seat - 0.01),
            (x, front, seat),
            (x, front - 0.03, level),
            (x, 0.42 * depth, level),
            (x - 0.05, 0.52 * depth, seat + 0.12),
        ]
        assembly.add_pair(tube(fillet(knots, 0.07), 0.014), dark)
    pad = draws.uniform(0.22, 0.28)
    assembly.add_pair(
        cushion((0.075, pad, 0.035), (x, 0.0, level + 0.012), power=6.0), shade(dark, 0.8)
    )


# === cantilever ===


def _cantilever_chair(assembly: Assembly, draws: Draws) -> None:
    half, seat, depth = (
        draws.uniform(0.21, 0.26),
        draws.uniform(0.43, 0.48),
        draws.uniform(0.42, 0.5),
    )
    height, lean, radius = (
        draws.uniform(0.36, 0.46),
        draws.uniform(0.06, 0.13),
        draws.uniform(0.010, 0.014),
    )
    metal = tone(draws, draws.choice(("metal", "dark"), (0.75, 0.25)))
    cloth = tone(draws, draws.choice(("leather", "fabric", "wood")))
    front, rear = -0.5 * depth, 0.5 * depth
    path = [
        (half, rear + lean, seat + height),
        (half, rear, seat),
        (half, front, seat + 0.01),
        (half, front + draws.uniform(-0.01, 0.05), radius),
        (half, rear - draws.uniform(0.0, 0.06), radius),
    ]
    bend = draws.uniform(0.06, 0.1)
    assembly.add_pair(tube(fillet(path, bend, steps=5), radius), metal)
    assembly.add(rod((half, path[-1][1], radius), (-half, path[-1][1], radius), radius), metal)
    thick = draws.uniform(0.012, 0.05)
    assembly.add(
        cushion(
            (2 * half - 0.01, depth - 0.06, thick), (0, -0.01, seat + 0.01 + 0.3 * thick), power=8.0
        ),
        cloth,
    )
    low = draws.uniform(0.25, 0.5)
    back = Back(
        half,
        1.0,
        rear + lean * low,
        seat + height * low,
        height * (1.02 - low),
        lean / height,
        draws.uniform(0.0, 0.04),
    )
    assembly.add(back.sheet(thickness=max(0.7 * thick, 0.012), rounding=0.06), cloth)
    if draws.flag(0.4):
        level = seat + draws.uniform(0.18, 0.22)
        x = half + 0.02
        arm = [
            (x, rear + 0.5 * lean, level),
            (x, front + 0.02, level),
            (x, front + 0.05, 0.5 * seat),
        ]
        assembly.add_pair(tube(fillet(arm, bend), 0.8 * radius, segments=8), metal)
        assembly.add_pair(box((0.04, 0.26, 0.022), (x, 0.0, level + 0.01), radius=0.008), cloth)


# === lounge chair ===


def _lounge_chair(assembly: Assembly, draws: Draws) -> None:
    """A low padded chair in a wooden frame with open sides."""
    half, depth, seat = (
        draws.uniform(0.28, 0.34),
        draws.uniform(0.55, 0.66),
        draws.uniform(0.30, 0.38),
    )
    wood, cloth = tone(draws, "wood"), tone(draws, draws.choice(("fabric", "leather")))
    arm, thick = seat + draws.uniform(0.18, 0.26), draws.uniform(0.03, 0.045)
    rake = draws.uniform(0.02, 0.1)
    x = half + 0.5 * thick
    for foot, top in (
        (-0.5 * depth - 0.3 * rake, -0.45 * depth),
        (0.5 * depth + rake, 0.42 * depth),
    ):
        assembly.add_pair(leg("tapered", (x, foot, 0), (x, top, arm), thick, taper=0.6), wood)
    path = spline([(x, 0.5 * depth, arm - 0.02), (x, 0.0, arm + 0.012), (x, -0.5 * depth, arm)], 8)
    assembly.add_pair(bar(path, 1.5 * thick, 0.024, power=4.0), wood)
    for y in (-0.4 * depth, 0.4 * depth):
        z = seat - 0.02 - 0.08 * (y > 0)
        assembly.add(box((2 * half + thick, 0.03, 0.05), (0, y, z)), wood)
    puff = draws.uniform(0.10, 0.15)
    pad = cushion((2 * half - 0.01, depth - 0.02, puff), power=6.0, steps=8).rotated(
        "x", -draws.uniform(4, 9)
    )
    assembly.add(pad.moved(y=-0.02, z=seat + 0.3 * puff), cloth)
    height, lean = draws.uniform(0.5, 0.66), draws.uniform(16, 28)
    rest = cushion((2 * half - 0.02, 0.8 * puff, height), (0, 0, 0.5 * height), power=6.0, steps=8)
    assembly.add(rest.rotated("x", -lean).moved(y=0.36 * depth, z=seat), cloth)
    slope = np.array([0.0, np.sin(np.radians(lean)), np.cos(np.radians(lean))])
    base = np.array([0.0, 0.36 * depth + 0.5 * puff, seat - 0.05])
    for level in np.linspace(0.15, 0.95, draws.integer(2, 4)):
        assembly.add(box((2 * half, 0.02, 0.05), base + slope * level * height), wood)
    assembly.add_pair(
        bar(np.stack([base + vec(half, 0, 0), base + slope * height + (half, 0, 0)]), 0.03, 0.03),
        wood,
    )
