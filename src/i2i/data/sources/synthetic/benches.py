"""Benches with a back: park benches of slats, garden benches, pews of solid boards."""

from __future__ import annotations

import numpy as np

from i2i.data.sources.synthetic.assembly import Assembly
from i2i.data.sources.synthetic.bases import LEG_STYLES, leg, turning_of
from i2i.data.sources.synthetic.chair_backs import Back, add_back
from i2i.data.sources.synthetic.draws import Draws
from i2i.data.sources.synthetic.palette import Color, shade, tone
from i2i.data.sources.synthetic.primitives import Floats, bar, fillet, loft, rod, spline, tube, vec
from i2i.data.sources.synthetic.solids import box


def bench(draws: Draws) -> Assembly:
    """One bench; lengths in metres, floor at z = 0, the sitter looks towards −y."""
    assembly = Assembly()
    maker = draws.choice((_park_bench, _garden_bench, _pew), (0.5, 0.3, 0.2))
    maker(assembly, draws)
    return assembly


# === park bench: long slats on side frames ===


def _side_profile(draws: Draws) -> tuple[Floats, float]:
    """(y, z) along seat and back, front to top, and the height of the seat."""
    depth, seat = draws.uniform(0.38, 0.48), draws.uniform(0.41, 0.47)
    height, lean = draws.uniform(0.34, 0.5), draws.uniform(0.08, 0.2)
    dip = draws.uniform(0.0, 0.04)
    knots = [
        (-0.5 * depth, seat),
        (0.0, seat - dip),
        (0.42 * depth, seat - 0.5 * dip),
        (0.5 * depth + 0.04, seat + 0.14),
        (0.5 * depth + 0.04 + lean, seat + height),
    ]
    return spline(knots, 40), seat


def _park_bench(assembly: Assembly, draws: Draws) -> None:
    half = 0.5 * draws.uniform(1.25, 2.0)
    profile, seat = _side_profile(draws)
    wood, iron = tone(draws, "wood"), tone(draws, draws.choice(("dark", "metal", "wood")))
    at = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(profile, axis=0), axis=1))])
    slats = draws.integer(6, 14)
    pitch = at[-1] / slats
    fill, thick = draws.uniform(0.6, 0.88), draws.uniform(0.02, 0.035)
    tangent = np.gradient(profile, axis=0)
    for k in range(slats):
        where = (k + 0.5) * pitch
        if abs(where - 0.52 * at[-1]) < 0.5 * pitch:
            continue  # the gap between seat and back
        i = int(np.searchsorted(at, where))
        tilt = np.degrees(np.arctan2(tangent[i, 1], tangent[i, 0]))
        plank = box((2 * half, fill * pitch, thick), radius=0.006).rotated("x", float(tilt))
        assembly.add(plank.moved(0, *profile[i].tolist()), wood)
    frames = draws.choice((2, 3), (0.7, 0.3))
    inset = draws.uniform(0.03, 0.2)
    kind, arms = draws.choice(("bent", "legs")), draws.flag(0.65)
    for x in np.linspace(-half + inset, half - inset, frames):
        _frame(assembly, profile, float(x), seat, thick, kind=kind, iron=iron)
        if arms:
            _iron_arm(assembly, profile, float(x), seat, iron)


def _frame(
    assembly: Assembly,
    profile: Floats,
    x: float,
    seat: float,
    thick: float,
    *,
    kind: str,
    iron: Color,
) -> None:
    below = profile.copy()
    below[:, 1] -= 0.6 * thick
    below[:, 0] += 0.4 * thick * np.linspace(0, 1, len(below))
    rail = np.column_stack([np.full(len(below), x), below])[::3]
    assembly.add(bar(rail, 0.045, 0.03), iron)
    front, rear = profile[0, 0] + 0.05, profile[24, 0]
    if kind == "bent":
        for y, out in ((front, -0.05), (rear, 0.09)):
            path = spline(
                [(x, y, seat - 0.03), (x, y - 0.4 * out, 0.5 * seat), (x, y + out, 0.0)], 8
            )
            assembly.add(bar(path, 0.045, 0.04), iron)
        assembly.add(rod((x, front, 0.35 * seat), (x, rear, 0.35 * seat), 0.014, segments=8), iron)
    else:
        for y in (front, rear):
            assembly.add(box((0.06, 0.06, seat - 0.02), (x, y, 0.5 * seat - 0.01)), iron)
        assembly.add(box((0.05, rear - front + 0.12, 0.05), (x, 0.5 * (rear + front), 0.03)), iron)


def _iron_arm(assembly: Assembly, profile: Floats, x: float, seat: float, iron: Color) -> None:
    front, level = profile[0, 0], seat + 0.21
    rear = float(np.interp(level, profile[20:, 1], profile[20:, 0]))
    path = fillet(
        [
            (x, rear, level),
            (x, front + 0.02, level),
            (x, front - 0.01, level - 0.07),
            (x, front + 0.06, seat - 0.02),
        ],
        0.06,
    )
    assembly.add(bar(path, 0.05, 0.026, power=4.0), iron)


# === garden bench: a wide chair ===


def _garden_bench(assembly: Assembly, draws: Draws) -> None:
    half, depth, seat = (
        0.5 * draws.uniform(1.15, 1.7),
        draws.uniform(0.42, 0.5),
        draws.uniform(0.41, 0.47),
    )
    wood, thick = (
        tone(draws, draws.choice(("wood", "plastic", "dark"), (0.75, 0.15, 0.1))),
        draws.uniform(0.045, 0.065),
    )
    back = Back(
        half,
        1.0,
        0.5 * depth - 0.5 * thick,
        seat,
        draws.uniform(0.38, 0.52),
        draws.uniform(0.1, 0.26),
        0.0,
    )
    post = spline(
        [
            (half, back.y + 0.05, 0),
            (half, back.y, 0.6 * seat),
            *[tuple(back.at(1, v)) for v in (0.0, 0.5, 1.0)],
        ],
        10,
    )
    assembly.add_pair(bar(post, thick, thick), wood)
    style, turning, arm = (
        draws.choice(LEG_STYLES),
        turning_of(draws),
        seat + draws.uniform(0.18, 0.24),
    )
    front = -0.5 * depth + 0.5 * thick
    assembly.add_pair(
        leg(style, (half, front, 0), (half, front, arm), thick, taper=0.7, turning=turning), wood
    )
    rear = back.at(1.0, min((arm - seat) / back.height, 0.95))
    path = spline([rear, vec(half, 0.0, arm + 0.012), vec(half, front - 0.05, arm)], 8)
    assembly.add_pair(bar(path, 1.3 * thick, 0.03, power=4.0), wood)
    slats = draws.integer(4, 7)
    pitch = depth / slats
    for k in range(slats):
        y = -0.5 * depth + pitch * (k + 0.5)
        assembly.add(box((2 * half + 0.3 * thick, 0.8 * pitch, 0.024), (0, y, seat)), wood)
    assembly.add(box((2 * half, 0.026, 0.08), (0, front, seat - 0.055)), shade(wood, 0.9))
    assembly.add_pair(box((0.026, depth, 0.07), (half, 0, seat - 0.05)), shade(wood, 0.9))
    assembly.add(
        box((2 * half, 0.03, 0.06), (0, float(back.at(0, 0.1)[1]), seat + 0.1 * back.height)), wood
    )
    kind = draws.choice(
        ("ladder", "slats", "spindles", "cross", "panel"), (0.2, 0.35, 0.2, 0.15, 0.1)
    )
    if kind == "slats":  # many more than a chair has
        crest = back.strip((-1.0, 1.0), (0.86, 1.0), thickness=0.03, arch=draws.choice((0.0, 0.12)))
        assembly.add(crest, wood)
        count = draws.integer(9, 17)
        for u in np.linspace(-1, 1, count + 2)[1:-1]:
            assembly.add(
                back.strip(
                    (u - 0.45 / count, u + 0.45 / count), (0.1, 0.9), thickness=0.016, steps=(3, 2)
                ),
                wood,
            )
    else:
        add_back(assembly, draws, kind, back, wood)


# === pew: solid boards ===


def _pew(assembly: Assembly, draws: Draws) -> None:
    half, depth, seat = (
        0.5 * draws.uniform(1.1, 1.9),
        draws.uniform(0.38, 0.48),
        draws.uniform(0.42, 0.47),
    )
    wood = tone(draws, "wood")
    side = wood if draws.flag(0.5) else tone(draws, draws.choice(("wood", "dark", "plastic")))
    thick, height, lean = draws.uniform(0.03, 0.05), draws.uniform(0.32, 0.55), draws.uniform(4, 14)
    assembly.add(box((2 * half, depth, thick), (0, 0, seat)), wood)
    gap = draws.uniform(0.0, 0.12)
    board = box((2 * half, thick, height - gap), (0, 0, 0.5 * (height + gap)), radius=0.01).rotated(
        "x", -lean
    )
    assembly.add(board.moved(y=0.5 * depth - 0.02, z=seat), wood)
    if draws.flag(0.5):  # board ends that rise to the back
        rise = seat + height + draws.uniform(-0.12, 0.04)
        outline = [
            (-0.5 * depth, 0),
            (-0.5 * depth - 0.02, 0.5 * seat),
            (-0.5 * depth, seat + 0.03),
        ]
        outline += [(-0.3 * depth, seat + 0.2), (0.25 * depth, seat + 0.26), (0.5 * depth, rise)]
        y, z = spline(outline, 14).T
        mid = 0.5 * (y + 0.5 * depth + 0.05 + 0.1 * z)
        path = np.column_stack([np.full(14, half), mid, z])
        width = 2 * (mid - y)
        rings = np.stack(
            [
                path
                + np.outer(np.ones(14), (sx * 0.5 * thick, 0, 0))
                + np.column_stack([0 * z, sy * 0.5 * width, 0 * z])
                for sx, sy in ((-1, -1), (1, -1), (1, 1), (-1, 1))
            ],
            axis=1,
        )
        assembly.add_pair(loft(rings), side)
    else:
        style, turning = draws.choice(LEG_STYLES), turning_of(draws)
        for y in (-0.38 * depth, 0.38 * depth):
            assembly.add_pair(
                leg(
                    style,
                    (half - 0.1, 1.15 * y, 0),
                    (half - 0.14, y, seat),
                    0.05,
                    taper=0.6,
                    turning=turning,
                ),
                side,
            )
        if draws.flag(0.5):
            assembly.add_pair(
                tube([(half - 0.12, -0.4 * depth, 0.2), (half - 0.12, 0.4 * depth, 0.2)], 0.012),
                side,
            )
        top = seat + 0.6 * height
        slope = np.tan(np.radians(lean))
        for x in np.linspace(-half + 0.15, half - 0.15, draws.integer(2, 4)):
            low = (x, 0.5 * depth + thick - 0.02, seat - 0.05)
            assembly.add(
                bar(
                    np.array([low, (x, 0.5 * depth + thick - 0.02 + slope * (top - seat), top)]),
                    0.05,
                    0.025,
                ),
                side,
            )
