"""Dining chairs: a wooden frame of posts and legs, a seat, one of many backs, perhaps arms."""

from __future__ import annotations

import numpy as np

from i2i.data.sources.synthetic.assembly import Assembly
from i2i.data.sources.synthetic.bases import LEG_STYLES, leg, turning_of
from i2i.data.sources.synthetic.chair_backs import BACKS, Back, add_back
from i2i.data.sources.synthetic.draws import Draws
from i2i.data.sources.synthetic.palette import Color, shade, tone
from i2i.data.sources.synthetic.primitives import (
    bar,
    plate,
    rod,
    spline,
    superellipse,
    tube,
)


def dining_chair(assembly: Assembly, draws: Draws) -> None:
    """Add one dining chair."""
    width, depth = draws.uniform(0.40, 0.54), draws.uniform(0.39, 0.50)
    seat, thick = draws.uniform(0.42, 0.49), draws.uniform(0.026, 0.042)
    taper = draws.uniform(-0.14, 0.0)  # the seat is wider in front
    wood = tone(draws, draws.choice(("wood", "dark", "plastic"), (0.8, 0.12, 0.08)))
    back = Back(
        half_width=0.5 * width * (1 + taper),
        flare=draws.uniform(0.9, 1.1),
        y=0.5 * depth - 0.5 * thick,
        z=seat,
        height=draws.uniform(0.36, 0.62),
        recline=np.tan(np.radians(draws.uniform(4, 16))),
        bow=draws.uniform(0.0, 0.05),
    )
    _rear_posts(assembly, draws, back, seat, thick, wood)
    style = draws.choice(LEG_STYLES)
    splay, slim = draws.uniform(0.0, 0.05), draws.uniform(0.45, 0.8)
    front = np.array([0.5 * width * (1 - taper) - thick, -0.5 * depth + thick, seat - 0.01])
    foot = np.array([front[0] + splay, front[1] - 0.6 * splay, 0.0])
    assembly.add_pair(
        leg(style, foot, front, 1.15 * thick, taper=slim, turning=turning_of(draws)), wood
    )
    _seat(assembly, draws, width, depth, seat, taper, wood)
    _stretchers(
        assembly,
        draws,
        front=foot,
        rear=np.array([back.half_width, back.y + 0.03, 0.0]),
        top=front,
        wood=wood,
    )
    kind = draws.choice(BACKS)
    add_back(assembly, draws, kind, back, wood)
    if draws.flag(0.33):
        _wooden_arms(assembly, draws, back, front, wood)


def _rear_posts(
    assembly: Assembly, draws: Draws, back: Back, seat: float, thick: float, wood: Color
) -> None:
    """The rear legs, which go on as the posts of the back."""
    kick = draws.uniform(0.0, 0.08)
    path = [
        (back.half_width, back.y + kick, 0.0),
        (back.half_width, back.y + 0.25 * kick, 0.55 * seat),
    ]
    path += [tuple(back.at(1.0, v)) for v in (0.0, 0.33, 0.66, 1.0)]
    line = spline(path, 14)
    widths = (
        np.concatenate([np.linspace(0.75, 1.0, 6), np.linspace(1.0, draws.uniform(0.55, 0.85), 8)])
        * thick
    )
    if draws.flag(0.35):
        assembly.add_pair(tube(line, 0.52 * widths), wood)
    else:
        assembly.add_pair(bar(line, widths, widths * 1.25), wood)


def _seat(
    assembly: Assembly,
    draws: Draws,
    width: float,
    depth: float,
    seat: float,
    taper: float,
    wood: Color,
) -> None:
    outline = superellipse(
        0.5 * width + 0.012,
        0.5 * depth + 0.008,
        power=draws.uniform(4, 14),
        taper=taper,
        segments=28,
    )
    kind = draws.choice(("plank", "saddle", "pad", "woven"), (0.3, 0.2, 0.35, 0.15))
    apron = draws.uniform(0.04, 0.075)
    if kind != "saddle":
        assembly.add(plate(outline * 0.93, seat - apron, seat - 0.005), shade(wood, 0.94))
    if kind == "pad":
        puff = draws.uniform(0.03, 0.06)
        cloth = tone(draws, draws.choice(("fabric", "leather")))
        assembly.add(plate(outline, seat, seat + puff, bevel=0.02, dome=0.25 * puff), cloth)
    elif kind == "woven":
        straw = tone(draws, "wood")
        assembly.add(plate(outline, seat - 0.012, seat + 0.014, bevel=0.012, dome=-0.008), straw)
    else:
        dip = -draws.uniform(0.004, 0.014) if kind == "saddle" else 0.0
        assembly.add(plate(outline, seat - 0.012, seat + 0.016, bevel=0.008, dome=dip), wood)


def _stretchers(
    assembly: Assembly,
    draws: Draws,
    *,
    front: np.ndarray,
    rear: np.ndarray,
    top: np.ndarray,
    wood: Color,
) -> None:
    """Rails between the legs: an H, a frame, or none."""
    kind = draws.choice(("none", "h", "frame"), (0.4, 0.3, 0.3))
    if kind == "none":
        return
    level, radius = draws.uniform(0.12, 0.24), draws.uniform(0.008, 0.014)
    f = front + (top - front) * level / top[2]
    r = np.array([rear[0], rear[1], f[2]])
    assembly.add_pair(rod(f, r, radius, segments=8), wood)
    if kind == "h":
        middle = 0.5 * (f + r)
        assembly.add(rod(middle, middle * (-1, 1, 1), radius, segments=8), wood)
        return
    lift = np.array([0.0, 0.0, draws.uniform(-0.03, 0.08)])
    for point in (f + lift, r + lift):
        assembly.add(rod(point, point * (-1, 1, 1), radius, segments=8), wood)


def _wooden_arms(
    assembly: Assembly, draws: Draws, back: Back, front: np.ndarray, wood: Color
) -> None:
    level = draws.uniform(0.19, 0.26)
    rear = back.at(1.0, min(level / back.height, 0.9))
    reach = front + np.array([draws.uniform(0.0, 0.05), draws.uniform(0.0, 0.08), 0.0])
    hand = np.array([reach[0] + 0.01, reach[1] - 0.03, back.z + level - draws.uniform(-0.01, 0.03)])
    middle = 0.5 * (rear + hand) + np.array(
        [draws.uniform(0.0, 0.05), 0.0, draws.uniform(-0.005, 0.02)]
    )
    path = spline([rear, middle, hand], 9)
    assembly.add_pair(bar(path, np.linspace(0.028, 0.05, 9), 0.024, power=4.0), wood)
    post = spline(
        [reach, reach + np.array([0.012, -0.02, 0.5 * level]), hand + np.array([0, 0.03, 0])], 6
    )
    assembly.add_pair(tube(post, 0.013, segments=8), wood)
