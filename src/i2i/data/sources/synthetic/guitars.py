"""Guitars: acoustic ones with a hollow body, electric ones with horns; the neck points up."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from i2i.data.sources.synthetic.assembly import Assembly
from i2i.data.sources.synthetic.draws import Draws
from i2i.data.sources.synthetic.palette import BLACK, CHROME, Color, shade, tone
from i2i.data.sources.synthetic.primitives import (
    Floats,
    Part,
    circle,
    loft,
    plate,
    rod,
    spline,
    superellipse,
)
from i2i.data.sources.synthetic.solids import ball, box, span

_LEVELS = 36


@dataclass(frozen=True)
class _Neck:
    """Where neck and head are: heights, half widths, and the depth of the strings' side."""

    joint: float
    nut: float
    half: float
    front: float  # y of the body's top, negative: towards the viewer
    head: float  # length of the head


def guitar(draws: Draws) -> Assembly:
    """One right-handed guitar, about a metre high, standing on z = 0, the strings at −y.

    The cutaway, the pickguard and the knobs are on the treble side, +x; the tuners of a head with
    six in line are on the bass side, −x.
    """
    assembly = Assembly()
    (_acoustic if draws.flag(0.55) else _electric)(assembly, draws)
    return assembly


# === bodies ===


def _bouts(
    draws: Draws, height: float, half: float, *, waist: float, upper: float
) -> tuple[Floats, Floats]:
    """Heights and half widths of a body with two bouts, shape (_LEVELS,) each, bottom to top."""
    angle = np.linspace(0.04, np.pi - 0.04, _LEVELS)
    low = draws.uniform(1.5, 2.0)
    knots = [
        (0, low),
        (26, 0.85 * low),
        (60, 1.155),
        (101, 1.02 * waist),
        (130, 1.3 * upper),
        (154, 1.62 * upper),
        (180, 1.8 * upper),
    ]
    factor = np.interp(angle, *_dense(np.asarray(knots) * (np.pi / 180, 1.0)))
    return 0.5 * height * (1 - np.cos(angle)), half * np.sin(angle) * factor


def _dense(knots: Floats) -> tuple[Floats, Floats]:
    line = spline(knots, 80)
    return line[:, 0], line[:, 1]


def _half_body(z: Floats, inner: Floats, outer: Floats, depth: float, edge: float) -> Part:
    """The half of a body at +x between two edges, with its rims rounded by `edge`."""
    y = 0.5 * depth
    a, b = inner, outer
    r = np.minimum(edge, 0.4 * (b - a))
    x = np.stack([a, b - r, b - 0.3 * r, b, b, b - 0.3 * r, b - r, a], axis=1)  # (levels, 8)
    across = np.array([-y, -y, -y + 0.3 * edge, -y + edge, y - edge, y - 0.3 * edge, y, y])
    return loft(
        np.stack(
            [x, np.broadcast_to(across, x.shape), np.broadcast_to(z[:, None], x.shape)], axis=2
        )
    )


def _add_half(assembly: Assembly, part: Part, top: Color, side: Color, *, mirrored: bool) -> None:
    """Add a half body: the strings' side in one colour, the rest in another."""
    corners = part.vertices[part.faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    facing = -normal[:, 1] > 0.7 * np.linalg.norm(normal, axis=1)
    colors = np.where(facing[:, None], top, side)
    assembly.add(part.mirrored() if mirrored else part, colors)


def _acoustic(assembly: Assembly, draws: Draws) -> None:
    height, half = draws.uniform(0.46, 0.54), draws.uniform(0.18, 0.215)
    waist, upper = draws.uniform(0.58, 0.82), draws.uniform(0.66, 0.8)
    depth, back = draws.uniform(0.085, 0.125), tone(draws, "wood")
    top = tone(draws, "wood") if draws.flag(0.8) else tone(draws, draws.choice(("accent", "dark")))
    z, width = _bouts(draws, height, half, waist=waist, upper=upper)
    right = width.copy()
    if draws.flag(0.45):  # the cutaway
        start = draws.uniform(0.74, 0.82)
        s = np.clip((z / height - start) / (1 - start), 0, 1)
        right = 0.03 + np.maximum(width - 0.03, 0.0) * (1 - s ** draws.uniform(0.4, 0.9))
        right = np.maximum(right, np.minimum(width, 0.012))
    edge = draws.uniform(0.006, 0.014)
    for mirrored, outer in ((False, right), (True, width)):
        _add_half(
            assembly,
            _half_body(z, np.zeros_like(z), outer, depth, edge),
            top,
            back,
            mirrored=mirrored,
        )
    front = -0.5 * depth
    hole, centre = draws.uniform(0.045, 0.055), draws.uniform(0.64, 0.68) * height
    _disc(assembly, hole + 0.012, centre, front, tone(draws, "accent"))
    _disc(assembly, hole, centre, front - 0.0015, BLACK)
    bridge = draws.uniform(0.24, 0.32) * height
    dark = tone(draws, "dark")
    assembly.add(
        box((draws.uniform(0.13, 0.2), 0.012, 0.032), (0, front - 0.004, bridge), radius=0.005),
        dark,
    )
    assembly.add(
        box((0.085, 0.006, 0.005), (0, front - 0.012, bridge + 0.004), radius=0.001),
        (236, 232, 216),
    )
    if draws.flag(0.6):
        guard = superellipse(0.05, 0.07, power=2.5, taper=draws.uniform(-0.4, 0.4), segments=18)
        part = plate(guard, 0.0, 0.0035).rotated("x", 90.0).rotated("y", draws.uniform(10, 40))
        assembly.add(part.moved(0.065, front, centre - 0.06), dark)
    neck = _Neck(
        height - 0.01,
        height + draws.uniform(0.32, 0.38),
        draws.uniform(0.023, 0.029),
        front,
        draws.uniform(0.15, 0.19),
    )
    _neck(assembly, draws, neck, tone(draws, "wood"), board=centre + hole)
    heel = span(
        (-0.026, front + 0.002, height - 0.012), (0.026, 0.35 * depth, height + 0.03), radius=0.008
    )
    assembly.add(heel, shade(back, 0.9))
    _head(assembly, draws, neck, in_line=False)


def _electric(assembly: Assembly, draws: Draws) -> None:
    height, half = draws.uniform(0.36, 0.42), draws.uniform(0.155, 0.175)
    waist, upper = draws.uniform(0.68, 0.82), draws.uniform(0.72, 0.86)
    depth = draws.uniform(0.04, 0.055)
    paint = tone(draws, draws.choice(("paint", "accent", "wood"), (0.5, 0.25, 0.25)))
    back = paint if draws.flag(0.6) else tone(draws, "wood")
    joint, edge = 0.8 * height, draws.uniform(0.008, 0.02)
    neck_half = draws.uniform(0.022, 0.026)
    kind = draws.choice(("double", "single"), (0.6, 0.4))
    treble = height * draws.uniform(0.96, 1.06)
    bass = treble + draws.uniform(0.0, 0.06) if kind == "double" else height
    z, width = _bouts(draws, height, half, waist=waist, upper=upper)
    horn = draws.uniform(0.5, 0.68) * half
    for mirrored, tip in ((False, treble), (True, bass)):
        if mirrored and kind == "single":
            part = _half_body(z, np.zeros_like(z), width, depth, edge)
        else:
            part = _half_body(*_horned(z, width, joint, tip, horn, neck_half), depth, edge)
        _add_half(assembly, part, paint, back, mirrored=mirrored)
    front = -0.5 * depth
    neck = _Neck(
        joint, height + draws.uniform(0.38, 0.46), neck_half, front, draws.uniform(0.15, 0.19)
    )
    _neck(assembly, draws, neck, tone(draws, "wood"), board=joint - 0.06)
    _hardware(assembly, draws, height, half, front)
    _head(assembly, draws, neck, in_line=draws.flag(0.6))


def _horned(
    z: Floats, width: Floats, joint: float, tip: float, horn: float, neck_half: float
) -> tuple[Floats, Floats, Floats]:
    """Heights, inner and outer edges of a half body that ends in a horn beside the neck.

    Args:
        z: Heights of the body without a horn.
        width: Its half widths.
        joint: Where the neck leaves the body.
        tip: Height of the horn's tip.
        horn: Distance of the tip from the middle.
        neck_half: Half the width of the neck.
    """
    below = z < joint - 0.004
    s = np.linspace(0.0, 1.0, 14)
    edge = float(np.interp(joint, z, width))
    inner = neck_half + (horn - neck_half) * s**0.4
    outer = horn + (edge - horn) * np.sqrt(np.clip(1 - s**2.2, 0, 1)) + 0.004
    heights = np.concatenate([z[below], [joint - 0.002], joint + (tip - joint) * s])
    edges = np.concatenate([width[below], [edge], np.maximum(outer, inner + 0.004)])
    return heights, np.concatenate([np.zeros(below.sum() + 1), inner]), edges


def _hardware(assembly: Assembly, draws: Draws, height: float, half: float, front: float) -> None:
    """Pickguard, pickups, bridge, knobs and jack of an electric guitar."""
    if draws.flag(0.65):
        shape = superellipse(
            0.55 * half, 0.3 * height, power=3.0, taper=-draws.uniform(0.0, 0.35), segments=22
        )
        guard = plate(shape, 0.0, 0.004).rotated("x", 90.0).rotated("y", -8.0)
        assembly.add(
            guard.moved(0.2 * half, front, 0.46 * height),
            tone(draws, draws.choice(("ceramic", "dark"))),
        )
    pickup = tone(draws, draws.choice(("dark", "ceramic", "metal")))
    size = (0.082, 0.012, draws.choice((0.018, 0.036)))
    for z in np.linspace(0.36, 0.66, draws.integer(2, 3)):
        assembly.add(box(size, (0, front - 0.006, z * height), radius=0.004), pickup)
    assembly.add(
        box(
            (0.085, 0.014, draws.uniform(0.02, 0.045)),
            (0, front - 0.006, 0.24 * height),
            radius=0.003,
        ),
        CHROME,
    )
    knob = tone(draws, draws.choice(("dark", "metal", "ceramic")))
    for k in range(draws.integer(2, 4)):
        x, z = half * (0.5 + 0.1 * (k % 2)), height * (0.14 + 0.09 * k)
        assembly.add(rod((x, front, z), (x, front - 0.018, z), 0.013, 0.011, segments=12), knob)


# === neck and head ===


def _disc(assembly: Assembly, radius: float, z: float, y: float, color: Color) -> None:
    part = plate(circle(28) * radius, 0.0, 0.002).rotated("x", 90.0)
    assembly.add(part.moved(0, y, z), color)


def _neck(assembly: Assembly, draws: Draws, neck: _Neck, wood: Color, *, board: float) -> None:
    """The neck, round behind, with a fingerboard from `board` up to the nut."""
    angle = np.linspace(0, np.pi, 9)
    section = np.column_stack([np.cos(angle), np.sin(angle)])  # the round side, towards +y
    rings = []
    for z in (neck.joint - 0.02, neck.nut + 0.005):
        half = neck.half * (1.08 if z < neck.nut else 0.92)
        rings.append([(half * x, neck.front + 0.021 * y, z) for x, y in section])
    assembly.add(loft(np.asarray(rings)), wood)
    dark = tone(draws, draws.choice(("dark", "wood"), (0.8, 0.2)))
    low, high = neck.half * 1.12, neck.half * 0.92
    rings = [
        [
            (x * f, y, z)
            for x, y in (
                (-1, neck.front - 0.007),
                (1, neck.front - 0.007),
                (1, neck.front + 0.003),
                (-1, neck.front + 0.003),
            )
        ]
        for z, f in ((board, low), (neck.nut, high))
    ]
    assembly.add(loft(np.asarray(rings)), dark)
    assembly.add(
        box((2 * high, 0.012, 0.005), (0, neck.front - 0.004, neck.nut), radius=0.001),
        (236, 232, 216),
    )
    for fret in (3, 5, 7, 9, 12):
        z = neck.nut - (neck.nut - 0.25 * neck.joint) * (1 - 2.0 ** (-(fret - 0.5) / 12))
        assembly.add(
            box((0.012, 0.002, 0.006), (0, neck.front - 0.0075, z), radius=0.0005), (232, 228, 214)
        )


def _head(assembly: Assembly, draws: Draws, neck: _Neck, *, in_line: bool) -> None:
    """The head, leaning back, with its six tuners: three a side, or all on the bass side."""
    wood, metal = (
        tone(draws, draws.choice(("wood", "dark", "wood"))),
        tone(draws, draws.choice(("metal", "ceramic"))),
    )
    tilt, length = draws.uniform(4, 15), neck.head
    wide = neck.half * draws.uniform(1.25, 1.6)
    t = np.linspace(0, 1, 10)
    flare = np.clip(t / 0.18, 0, 1)
    right = neck.half * 0.95 + (wide - neck.half * 0.95) * flare
    left = right.copy()
    if in_line:
        right = neck.half * (
            0.95 - 0.35 * flare + draws.uniform(0.2, 0.6) * np.exp(-(((t - 0.85) / 0.12) ** 2))
        )
        left = neck.half * (0.95 + 0.75 * flare - 0.45 * t)
    elif draws.flag(0.5):
        crown = 1 - draws.uniform(0.0, 0.3) * np.clip((t - 0.85) / 0.15, 0, 1)
        right, left = right * crown, left * crown
    rings = [
        [(-a, -0.007, s), (b, -0.007, s), (b, 0.007, s), (-a, 0.007, s)]
        for a, b, s in zip(left, right, t * length, strict=True)
    ]
    head = Assembly()
    head.add(loft(np.asarray(rings)), wood)
    places = np.linspace(0.2, 0.9, 6 if in_line else 3)
    for s in places:
        edge = float(np.interp(s, t, left))
        sides = [(-1.0, edge)] if in_line else [(-1.0, edge), (1.0, float(np.interp(s, t, right)))]
        for sign, reach in sides:
            z = s * length
            head.add(
                rod(
                    (sign * (reach - 0.004), 0, z),
                    (sign * (reach + 0.014), 0, z),
                    0.0035,
                    segments=6,
                ),
                CHROME,
            )
            head.add(ball((0.008, 0.005, 0.009), (sign * (reach + 0.019), 0.0, z), steps=2), metal)
            head.add(
                rod(
                    (sign * (reach - 0.014), 0, z),
                    (sign * (reach - 0.014), -0.02, z),
                    0.004,
                    segments=6,
                ),
                CHROME,
            )
    for part, color in head.parts():
        assembly.add(part.rotated("x", -tilt).moved(0, neck.front + 0.008, neck.nut), color)
