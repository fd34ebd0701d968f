"""Cars: saloons, hatchbacks, estates, coupés, off-roaders, pick-ups and vans; the nose is at −y."""

from __future__ import annotations

import numpy as np

from i2i.data.sources.synthetic.assembly import Assembly
from i2i.data.sources.synthetic.car_styles import Car, draw_car
from i2i.data.sources.synthetic.draws import Draws
from i2i.data.sources.synthetic.palette import (
    BLACK,
    CHROME,
    HEADLIGHT,
    TAILLIGHT,
    WINDOW,
    Color,
    shade,
    tone,
)
from i2i.data.sources.synthetic.primitives import Floats, lathe, loft, rod, spline, superellipse
from i2i.data.sources.synthetic.solids import box, cushion


def car(draws: Draws) -> Assembly:
    """One car; lengths in metres, floor at z = 0, the nose points to −y."""
    shape = draw_car(draws)
    assembly = Assembly()
    paint = tone(draws, "paint")
    trim = shade(paint, 0.9) if draws.flag(0.65) else tone(draws, "dark")
    _body(assembly, draws, shape, paint, trim)
    _cabin(assembly, draws, shape, paint if draws.flag(0.85) else tone(draws, "dark"))
    _wheels(assembly, draws, shape)
    _face(assembly, draws, shape, trim)
    _rear(assembly, draws, shape, trim)
    _extras(assembly, draws, shape, paint)
    return assembly


# === the lower body ===


def _stations(shape: Car) -> Floats:
    """Where along y the body is cut: dense at its ends and over the wheel arches."""
    end = 0.5 * shape.length
    arch = 1.16 * shape.wheel
    steps = arch * np.sin(np.linspace(-0.5, 0.5, 9) * np.pi)
    parts = [
        end * np.array([-0.994, -0.985, -0.965, -0.93, -0.88, 0.88, 0.93, 0.965, 0.985, 0.994]),
        np.linspace(-0.8, 0.8, 9) * end,
    ]
    parts += [axle + steps for axle in shape.axles]
    line = np.unique(np.round(np.concatenate(parts), 4))
    return line[np.concatenate([[True], np.diff(line) > 0.008])]


def _plan(shape: Car, y: Floats) -> Floats:
    """Half width of the body at y, from above."""
    t = np.abs(y) / (0.5 * shape.length)
    return shape.half * (1 - np.minimum(t, 0.999) ** shape.plan) ** (1 / shape.plan)


def _top_line(shape: Car, y: Floats) -> Floats:
    """Height of bonnet, window sill and boot at y."""
    end = 0.5 * shape.length
    knots = [
        (-end, 0.86 * shape.nose),
        (-0.96 * end, 0.97 * shape.nose),
        (-0.85 * end, 1.02 * shape.nose),
        (shape.screen, shape.belt),
        (0.5 * (shape.screen + shape.tail), shape.belt * 1.01),
        (shape.tail, 0.5 * (shape.belt + shape.boot)),
        (max(0.94 * end, shape.tail + 0.02), shape.boot),
        (max(end, shape.tail + 0.06), 0.95 * shape.boot),
    ]
    line = spline(knots, 120)
    return np.interp(y, line[:, 0], line[:, 1])


def _body(assembly: Assembly, draws: Draws, shape: Car, paint: Color, trim: Color) -> None:
    """One loft along y, with wheel arches cut into its lower edge."""
    y = _stations(shape)
    w, top = _plan(shape, y), _top_line(shape, y)
    end = 0.5 * shape.length
    lift = np.clip((np.abs(y) / end - 0.86) / 0.14, 0, 1) ** 2 * 0.12  # the bumpers' undercut
    sill = shape.sill + lift
    arch = np.zeros_like(y)
    for axle in shape.axles:
        inside = 1 - ((y - axle) / (1.16 * shape.wheel)) ** 2
        arch = np.maximum(
            arch, shape.wheel + 1.16 * shape.wheel * np.sqrt(np.clip(inside, 0, 1)) * (inside > 0)
        )
    arch = np.minimum(arch, top - 0.14)  # a low bonnet does not let the wheels through
    low = np.maximum(sill, arch)
    waist = np.maximum(sill + draws.uniform(0.42, 0.6) * (top - sill), low + 0.05)
    crown = 0.03 + 0.02 * (y < shape.screen)
    side = [
        (0.55 * w, top + 0.75 * crown),
        (0.86 * w, top + 0.1 * crown),
        (0.965 * w, top - 0.22 * (top - waist)),
        (w, waist),
        (0.985 * w, np.maximum(low + 0.03, sill + 0.12)),
        (0.95 * w, low),
        (0.68 * w, low),
        (0.68 * w, sill - 0.004),
    ]
    right = np.stack(
        [np.stack([x, y, np.broadcast_to(z, y.shape)], axis=-1) for x, z in side], axis=1
    )
    left = right[:, ::-1] * np.array([-1.0, 1.0, 1.0])
    ridge, keel = (np.stack([0 * y, y, z], axis=-1)[:, None] for z in (top + crown, sill - 0.004))
    rings = np.concatenate([ridge, right, keel, left], axis=1)
    part = loft(rings)
    around = rings.shape[1]
    # Of a band's faces, which of the points around they follow: 4 is above the sill, 5 to 7 and
    # their mirror images are the wells and the floor.
    k = (np.arange(len(part.faces)) // 2) % around
    k = np.minimum(k, around - 1 - k)
    colors = np.where((k >= 6)[:, None], BLACK, np.where((k >= 5)[:, None], trim, paint))
    caps = 2 * around * (len(y) - 1)
    colors[caps:] = trim
    assembly.add(part, colors)


# === the cabin ===


def _cabin(assembly: Assembly, draws: Draws, shape: Car, paint: Color) -> None:
    """Windows, pillars and roof: rings from the belt up, each a rounded rectangle."""
    base, rise = shape.belt - 0.06, shape.height - shape.belt + 0.06
    tumble = draws.uniform(0.74, 0.84)
    # (height as a part of the rise, inset of the outline at the roof's edge)
    levels = [(0.0, 0.0), (0.16, 0.0), (0.80, 0.0), (0.90, 0.02), (0.97, 0.09), (1.0, 0.25)]
    segments, power = 40, draws.uniform(5.0, 8.0)
    rings = []
    for t, inset in levels:
        slope = min(t / 0.9, 1.0)
        front = shape.screen - 0.08 + (shape.roof[0] - shape.screen + 0.08) * slope
        rear = shape.tail + (shape.roof[1] - shape.tail) * slope
        half = shape.half * (0.93 + (tumble - 0.93) * slope) * (1 - inset)
        outline = superellipse(
            half, 0.5 * (rear - front) * (1 - inset), power=power, segments=segments
        )
        bow = 0.05 * (outline[:, 0] / half) ** 2  # windscreen and rear window are bowed
        outline[:, 1] += np.where(outline[:, 1] < 0, bow, -bow) + 0.5 * (front + rear)
        rings.append(np.column_stack([outline, np.full(segments, base + t * rise)]))
    part = loft(np.stack(rings), tip_end=(0.0, float(rings[-1][:, 1].mean()), shape.height + 0.02))
    angle = 360.0 * (np.arange(segments) + 1.0) / segments  # middle of each step around
    corner = np.abs((angle + 45.0) % 90.0 - 45.0) > 45.0 - 6.0
    middle = np.abs((angle + 90.0) % 180.0 - 90.0) < 4.0
    if shape.kind in ("van", "estate", "offroad"):
        middle |= np.abs(np.abs((angle + 180.0) % 360.0 - 180.0 - 90.0) - 55.0) < 4.0
    closed = corner | middle
    if shape.kind == "van" and draws.flag(0.6):  # a delivery van: no windows behind the doors
        closed |= (angle > 2.0) & (angle < 178.0) & (np.abs(angle - 90.0) > 35.0)
    glazed = np.zeros((len(levels) - 1, segments), dtype=bool)
    glazed[1] = ~closed
    flat = np.concatenate([np.repeat(glazed.reshape(-1), 2), np.zeros(2 * segments, dtype=bool)])
    assembly.add(part, np.where(flat[:, None], WINDOW, paint))


# === wheels, lights and the rest ===


def _wheels(assembly: Assembly, draws: Draws, shape: Car) -> None:
    radius, half = shape.wheel, draws.uniform(0.09, 0.12)
    rim = radius * draws.uniform(0.6, 0.72)
    tyre = lathe(
        [
            (0, -half),
            (rim, -half),
            (0.94 * radius, -0.9 * half),
            (radius, -0.5 * half),
            (radius, 0.5 * half),
            (0.94 * radius, 0.9 * half),
            (rim, half),
            (0, half),
        ],
        segments=20,
    )
    hub = lathe(
        [
            (0, 0),
            (rim, 0),
            (rim, 1.04 * half),
            (0.9 * rim, 1.1 * half),
            (0.25 * rim, 0.9 * half),
            (0.2 * rim, 1.12 * half),
            (0, 1.12 * half),
        ],
        segments=20,
    )
    spokes = draws.choice((4, 5, 10))
    k = (np.arange(len(hub.faces)) // 2) % 20
    face = np.arange(len(hub.faces)) // 40 == 2  # the band between rim and nave
    gap = face & (k % (20 // spokes) >= (20 // spokes) // 2)
    colors = np.where(
        gap[:, None], BLACK, tone(draws, draws.choice(("metal", "dark"), (0.85, 0.15)))
    )
    x = shape.half - half - draws.uniform(0.0, 0.03)
    for axle in shape.axles:
        for part, color in (
            (tyre, np.broadcast_to(np.array(BLACK), (len(tyre.faces), 3))),
            (hub, colors),
        ):
            assembly.add_pair(part.rotated("y", 90.0).moved(x, axle, radius), color)


def _at_nose(shape: Car, x: float) -> float:
    """How far before the middle the body's front is, at a distance x from its axis."""
    return 0.5 * shape.length * (1 - (abs(x) / shape.half) ** shape.plan) ** (1 / shape.plan)


def _face(assembly: Assembly, draws: Draws, shape: Car, trim: Color) -> None:
    """Grille, headlights, bumper and number plate."""
    end = 0.5 * shape.length
    wide, high = shape.half * draws.uniform(0.45, 0.95), draws.uniform(0.08, 0.2)
    level = 0.78 * shape.nose
    assembly.add(
        box((wide, 0.05, high), (0, -end + 0.012, level), radius=0.02),
        BLACK if draws.flag(0.6) else CHROME,
    )
    round_lamps, x = draws.flag(0.4), shape.half * draws.uniform(0.66, 0.74)
    lamp = (
        (0.2, 0.14, 0.2)
        if round_lamps
        else (draws.uniform(0.26, 0.4), 0.16, draws.uniform(0.1, 0.16))
    )
    middle = (x, -_at_nose(shape, x) + 0.03, level + 0.03)
    assembly.add_pair(cushion(lamp, middle, power=2.0 if round_lamps else 4.0, steps=4), HEADLIGHT)
    bumper = shape.sill + 0.17
    assembly.add(
        cushion((1.72 * shape.half, 0.22, 0.16), (0, -end + 0.08, bumper), power=6.0, steps=4), trim
    )
    assembly.add(box((0.48, 0.02, 0.11), (0, -end - 0.03, bumper), radius=0.004), (235, 235, 225))


def _rear(assembly: Assembly, draws: Draws, shape: Car, trim: Color) -> None:
    """Rear lights, bumper and number plate."""
    end = 0.5 * shape.length
    upright = shape.kind in ("estate", "van", "offroad", "hatchback", "pickup") and draws.flag(0.7)
    size = (
        (0.14, 0.12, 0.34)
        if upright
        else (draws.uniform(0.26, 0.44), 0.12, draws.uniform(0.1, 0.16))
    )
    x = shape.half * (0.84 if upright else 0.7)
    assembly.add_pair(
        cushion(size, (x, _at_nose(shape, x) - 0.02, 0.84 * shape.boot), power=6.0, steps=3),
        TAILLIGHT,
    )
    bumper = shape.sill + 0.18
    assembly.add(
        cushion((1.74 * shape.half, 0.2, 0.17), (0, end - 0.06, bumper), power=6.0, steps=4), trim
    )
    assembly.add(
        box((0.48, 0.04, 0.11), (0, end - 0.005, 0.66 * shape.boot), radius=0.004), (235, 225, 150)
    )


def _extras(assembly: Assembly, draws: Draws, shape: Car, paint: Color) -> None:
    """Mirrors, and what only some cars have: roof rails, a spoiler, a spare wheel, a load bed."""
    y = shape.screen + 0.3 * (shape.roof[0] - shape.screen) + 0.1
    assembly.add_pair(
        cushion((0.2, 0.1, 0.14), (shape.half + 0.04, y, shape.belt + 0.06), power=3.5, steps=3),
        paint,
    )
    end, kind = 0.5 * shape.length, shape.kind
    if kind in ("estate", "offroad", "van") and draws.flag(0.6):
        rail = np.array(
            [
                [0.62 * shape.half, shape.roof[0] + 0.15, shape.height + 0.02],
                [0.62 * shape.half, shape.roof[1] - 0.1, shape.height + 0.02],
            ]
        )
        assembly.add_pair(rod(rail[0], rail[1], 0.02, segments=6), CHROME)
    if kind in ("coupe", "saloon") and draws.flag(0.3):
        high = shape.boot + draws.uniform(0.1, 0.2)
        assembly.add(box((1.5 * shape.half, 0.2, 0.03), (0, end - 0.16, high), radius=0.01), paint)
        assembly.add_pair(
            box(
                (0.03, 0.12, high - shape.boot + 0.1),
                (0.55 * shape.half, end - 0.16, 0.5 * (high + shape.boot) - 0.05),
            ),
            paint,
        )
    if kind == "offroad" and draws.flag(0.5):
        radius = 0.9 * shape.wheel
        tyre = lathe(
            [
                (0, -0.1),
                (0.9 * radius, -0.1),
                (radius, -0.05),
                (radius, 0.05),
                (0.9 * radius, 0.1),
                (0, 0.1),
            ],
            segments=24,
        )
        assembly.add(
            tyre.rotated("x", 90.0).moved(0.1 * shape.half, end + 0.08, 0.78 * shape.belt), BLACK
        )
    if kind == "pickup":
        front, rear, x = shape.tail + 0.05, end - 0.1, 0.9 * shape.half
        top = shape.boot + 0.1
        assembly.add(
            box(
                (1.7 * x, rear - front, 0.08),
                (0, 0.5 * (front + rear), shape.boot + 0.02),
                radius=0.01,
            ),
            BLACK,
        )
        assembly.add_pair(
            box(
                (0.08, rear - front + 0.1, 0.24), (x, 0.5 * (front + rear), top - 0.06), radius=0.02
            ),
            paint,
        )
        assembly.add(box((2 * x, 0.08, 0.24), (0, rear, top - 0.06), radius=0.02), paint)
