"""Toilets: bowl, seat, lid, and a tank or a flush pipe behind them."""

from __future__ import annotations

import numpy as np

from i2i.data.sources.synthetic.assembly import Assembly
from i2i.data.sources.synthetic.draws import Draws
from i2i.data.sources.synthetic.palette import CHROME, Color, shade, tone
from i2i.data.sources.synthetic.primitives import (
    Floats,
    Part,
    band_of_face,
    fillet,
    loft,
    plate,
    rod,
    spline,
    superellipse,
    tube,
    vec,
)
from i2i.data.sources.synthetic.solids import box, cushion, ring

_STEPS = 32


def toilet(draws: Draws) -> Assembly:
    """One toilet; lengths in metres, floor at z = 0, the bowl's tip at −y, the tank at +y.

    The flush lever is on the left of who looks at it (−x), as it mostly is. Bowls that
    hang from a wall are above the floor.
    """
    assembly = Assembly()
    china, height = tone(draws, "ceramic"), draws.uniform(0.37, 0.44)
    half, front = draws.uniform(0.17, 0.2), draws.uniform(0.25, 0.36)
    rear = draws.uniform(0.16, 0.2)
    power = draws.uniform(1.9, 2.6)
    _bowl(assembly, draws, china, height, (half, front, rear, power))
    seat = china if draws.flag(0.6) else tone(draws, draws.choice(("plastic", "wood")))
    _seat_and_lid(assembly, draws, seat, height, (half + 0.008, front + 0.012, rear, power))
    if draws.flag(0.86):
        _tank(assembly, draws, china, height, rear)
    else:
        _flush_pipe(assembly, draws, height, rear)
    return assembly


def _egg(half: float, front: float, rear: float, power: float, *, centre: float = 0.0) -> Floats:
    """An outline, longer to the front than to the rear, shape (_STEPS, 2), counter-clockwise."""
    points = superellipse(half, 1.0, power=power, segments=_STEPS)
    back = points[:, 1] > 0
    points[:, 1] *= np.where(back, rear, front)
    points[:, 0] *= np.where(back, 1.0 + 0.10 * np.abs(points[:, 1] / rear) ** 3, 1.0)
    points[:, 1] += centre
    return points


def _bowl(
    assembly: Assembly,
    draws: Draws,
    china: Color,
    height: float,
    egg: tuple[float, float, float, float],
) -> None:
    """Foot and bowl in one loft, over the rim and down to the water."""
    half, front, rear, power = egg
    kind = draws.choice(("pedestal", "skirted", "hung"), (0.55, 0.33, 0.12))
    foot = draws.uniform(0.5, 0.72) if kind == "pedestal" else draws.uniform(0.75, 0.92)
    waist = foot * draws.uniform(0.78, 0.92) if kind == "pedestal" else foot
    reach = draws.uniform(0.3, 0.6) if kind == "pedestal" else draws.uniform(0.7, 0.9)
    rim = draws.uniform(0.03, 0.05)
    low = 0.0 if kind != "hung" else 0.5 * height
    levels = spline(
        [
            (low, foot, reach),
            (low + 0.06 * (height - low), foot * 0.98, 0.96 * reach),
            (low + 0.42 * (height - low), waist, 0.9 * reach),
            (low + 0.72 * (height - low), 0.88, 0.86),
            (height - rim, 0.98, 0.985),
            (height - 0.01, 1.0, 1.0),
        ],
        13,
    )
    rings = [
        _ring_at(_egg(half * w, front * f, rear * (0.4 + 0.6 * w), power), z) for z, w, f in levels
    ]
    water = height - draws.uniform(0.14, 0.2)
    inner = [
        (height, 0.97),
        (height, 0.76),
        (height - 0.04, 0.72),
        (0.5 * (height + water), 0.6),
        (water, 0.36),
    ]
    rings += [_ring_at(_egg(half * f, front * f, rear * f, power), z) for z, f in inner]
    part = loft(np.stack(rings))
    blue = band_of_face(len(rings), _STEPS) == len(rings) - 1  # the last cap is the water
    assembly.add(part, np.where(blue[:, None], (120, 160, 180), china))
    if kind == "hung":
        assembly.add(
            box((1.9 * half, 0.06, 0.5 * height), (0, rear + 0.02, 0.72 * height), radius=0.02),
            china,
        )
    # The deck that carries seat and tank, and the trap behind the foot.
    assembly.add(
        box((1.7 * half, 0.2, 0.07), (0, rear + 0.02, height - 0.04), radius=0.03, steps=2), china
    )
    if kind != "hung":
        depth = rear + 0.08
        wide = 2 * half * foot * (0.82 if kind == "pedestal" else 0.98)
        assembly.add(
            box(
                (wide, depth, height - 0.05),
                (0, 0.5 * depth, 0.5 * height - 0.02),
                radius=0.05,
                steps=2,
            ),
            china,
        )


def _ring_at(outline: Floats, z: float) -> Floats:
    return np.column_stack([outline, np.full(len(outline), z)])


def _seat_and_lid(
    assembly: Assembly,
    draws: Draws,
    color: Color,
    height: float,
    egg: tuple[float, float, float, float],
) -> None:
    half, front, rear, power = egg
    wide = draws.uniform(0.028, 0.036)
    path = _ring_at(_egg(half - wide, front - wide, rear - wide, power), height + 0.014)
    if draws.flag(0.85):
        assembly.add(
            ring(path, superellipse(wide, 0.011, power=3.0, segments=10)), shade(color, 0.97)
        )
    thick = draws.uniform(0.014, 0.026)
    lid = plate(
        _egg(half, front, rear - 0.02, power),
        0.0,
        thick,
        bevel=0.006,
        dome=draws.uniform(0.0, 0.012),
    )
    hinge, top = rear - 0.03, height + 0.028
    if draws.flag(0.6):
        assembly.add(lid.moved(z=top), color)
    else:  # open: turned up about the hinge, leaning on the tank
        angle = draws.uniform(92, 104)
        opened = Part(lid.vertices - np.array([0.0, hinge, 0.0]), lid.faces).rotated("x", -angle)
        assembly.add(opened.moved(y=hinge, z=top), color)
    assembly.add_pair(
        rod((0.05, hinge, top), (0.1, hinge, top), 0.014, segments=8),
        CHROME if draws.flag(0.5) else color,
    )


def _tank(assembly: Assembly, draws: Draws, china: Color, height: float, rear: float) -> None:
    wide, deep, high = draws.uniform(0.36, 0.48), draws.uniform(0.15, 0.2), draws.uniform(0.3, 0.4)
    base, y = height - draws.choice((0.0, draws.uniform(0.0, 0.03))), rear + 0.03 + 0.5 * deep
    shape = superellipse(0.5 * wide, 0.5 * deep, power=draws.uniform(5, 14), segments=28)
    taper = draws.uniform(0.82, 1.0)
    levels = [(base, 0.94 * taper), (base + 0.02, taper), (base + high, 1.0)]
    assembly.add(loft(np.stack([_ring_at(shape * f + (0, y), z) for z, f in levels])), china)
    lid = draws.uniform(0.025, 0.045)
    top = base + high
    assembly.add(
        plate(shape * 1.05 + (0, y), top, top + lid, bevel=0.01, dome=draws.uniform(0, 0.012)),
        china,
    )
    if draws.flag(0.55):
        pivot = np.array([-0.36 * wide, y - 0.5 * deep, top - 0.05])
        assembly.add(
            rod(pivot + vec(0, 0.02, 0), pivot - (0, 0.025, 0), 0.014, segments=10), CHROME
        )
        assembly.add(
            rod(pivot - (0, 0.02, 0), pivot + vec(0.08, -0.03, -0.012), 0.007, 0.011, segments=8),
            CHROME,
        )
    else:
        for x in (-0.02, 0.025) if draws.flag(0.5) else (0.0,):
            assembly.add(
                rod((x, y, top + lid), (x, y, top + lid + 0.018), 0.018, segments=14), CHROME
            )


def _flush_pipe(assembly: Assembly, draws: Draws, height: float, rear: float) -> None:
    """A valve on a bare pipe, as public toilets have it, in front of a wall plate."""
    y, high = rear + 0.06, draws.uniform(0.3, 0.5)
    path = [(0, y, height - 0.02), (0, y, height + high), (-0.16, y, height + high)]
    assembly.add(tube(fillet(path, 0.06), 0.018), CHROME)
    assembly.add(
        rod((0, y, height + high - 0.06), (0, y, height + high + 0.06), 0.036, segments=14), CHROME
    )
    assembly.add(
        cushion((0.09, 0.09, 0.05), (0, y, height + high + 0.06), power=3.0, steps=4), CHROME
    )
    assembly.add(
        rod(
            (0, y, height + high - 0.02),
            (0.06, y - 0.09, height + high - 0.03),
            0.008,
            0.012,
            segments=8,
        ),
        CHROME,
    )
    assembly.add(
        box((0.36, 0.02, high + 0.2), (0, y + 0.05, height + 0.5 * high), radius=0.005),
        tone(draws, "ceramic"),
    )
