"""Sofas of one to four seats, with chaises, rolled arms, wooden or metal feet."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from i2i.data.sources.synthetic.assembly import Assembly
from i2i.data.sources.synthetic.bases import leg, turning_of
from i2i.data.sources.synthetic.draws import Draws
from i2i.data.sources.synthetic.palette import Color, shade, tone
from i2i.data.sources.synthetic.primitives import Part, fillet, rod, slab, sweep, tube, vec
from i2i.data.sources.synthetic.solids import box, cushion, span


@dataclass(frozen=True)
class _Frame:
    """Lengths of a sofa in metres: between the arms, and from the front of the base to its rear."""

    inner: float  # half the width between the arms
    depth: float
    feet: float
    base: float  # top of the base
    seat: float  # top of the seat cushions
    back: float  # top of the back
    back_thick: float
    arm_thick: float
    arm: float  # top of the arms
    lean_deg: float


def sofa(draws: Draws) -> Assembly:
    """One sofa; lengths in metres, floor at z = 0, the sitter looks towards −y."""
    assembly = Assembly()
    seats = draws.choice((1, 2, 3, 4), (0.14, 0.36, 0.38, 0.12))
    feet, seat = draws.uniform(0.03, 0.16), draws.uniform(0.38, 0.46)
    frame = _Frame(
        inner=0.5 * seats * draws.uniform(0.56, 0.7),
        depth=draws.uniform(0.78, 0.98),
        feet=feet,
        base=max(seat - draws.uniform(0.12, 0.19), feet + 0.08),
        seat=seat,
        back=draws.uniform(0.72, 0.98),
        back_thick=draws.uniform(0.13, 0.24),
        arm_thick=draws.uniform(0.1, 0.24),
        arm=draws.uniform(0.54, 0.68),
        lean_deg=draws.uniform(2, 13),
    )
    cloth = tone(draws, draws.choice(("fabric", "leather"), (0.65, 0.35)))
    chaise = draws.uniform(0.45, 0.7) if seats >= 2 and draws.flag(0.2) else 0.0
    _body(assembly, frame, cloth)
    _arms(assembly, draws, frame, cloth)
    _seats(assembly, draws, frame, seats, cloth, chaise)
    _back(assembly, draws, frame, seats, cloth)
    _feet(assembly, draws, frame, chaise)
    return assembly


def _body(assembly: Assembly, frame: _Frame, cloth: Color) -> None:
    front, rear = -0.5 * frame.depth, 0.5 * frame.depth
    low, high = (-frame.inner, front + 0.02, frame.feet), (frame.inner, rear, frame.base)
    assembly.add(span(low, high, radius=0.02), shade(cloth, 0.92))


def _rolled_arm(frame: _Frame, roll: float) -> Part:
    """An arm whose top rolls outwards: one outline in x and z, carried from front to rear."""
    half = 0.5 * frame.arm_thick
    angle = np.radians(np.linspace(-60, 215, 12))
    top = np.column_stack(
        [roll * np.cos(angle) + 0.35 * roll, frame.arm - roll + roll * np.sin(angle)]
    )
    outline = np.concatenate(
        [
            [[-0.8 * half, frame.feet], [0.8 * half, frame.feet]],
            [[0.75 * half, frame.arm - 2.2 * roll]],
            top,
        ]
    )
    path = np.array([[0.0, -0.5 * frame.depth, 0.0], [0.0, 0.48 * frame.depth, 0.0]])
    # side = x and tangent = +y give (x, tangent × x) = (x, −z): the outline is flipped for it.
    return sweep(path, outline * np.array([1.0, -1.0]), side=(1, 0, 0))


def _arms(assembly: Assembly, draws: Draws, frame: _Frame, cloth: Color) -> None:
    kind = draws.choice(("box", "rolled", "pillow", "sloped"), (0.35, 0.3, 0.2, 0.15))
    x = frame.inner + 0.5 * frame.arm_thick
    size = (frame.arm_thick, frame.depth, frame.arm - frame.feet)
    centre = np.array([0.0, 0.0, 0.5 * (frame.arm + frame.feet)])
    if kind == "rolled":
        part = _rolled_arm(frame, draws.uniform(0.45, 0.6) * max(frame.arm_thick, 0.15))
    elif kind == "pillow":
        lower = span(
            (-0.45 * size[0], -0.5 * size[1] + 0.02, frame.feet),
            (0.45 * size[0], 0.5 * size[1], frame.seat),
            radius=0.02,
        )
        for sign in (-1.0, 1.0):
            assembly.add(lower.moved(x=sign * x), shade(cloth, 0.92))
        high = frame.arm - frame.seat + 0.06
        part = cushion(
            (1.15 * size[0], size[1] - 0.02, high),
            (0, 0, frame.seat + 0.5 * high - 0.04),
            power=4.0,
        )
    elif kind == "sloped":
        rise = draws.uniform(0.04, 0.12)
        part = box(size, centre, radius=0.03, steps=2)
        tilt = np.where(
            part.vertices[:, 2] > centre[2], rise * (part.vertices[:, 1] / size[1] + 0.2), 0.0
        )
        part = Part(part.vertices + np.column_stack([np.zeros((len(tilt), 2)), tilt]), part.faces)
    else:
        part = box(size, centre, radius=draws.uniform(0.015, 0.06), steps=3)
    assembly.add_pair(part.moved(x=x), cloth)


def _seats(
    assembly: Assembly, draws: Draws, frame: _Frame, seats: int, cloth: Color, chaise: float
) -> None:
    count = draws.choice((1, seats), (0.2, 0.8))
    puff, power = frame.seat - frame.base + 0.03, draws.uniform(4.5, 9.0)
    overhang = draws.uniform(0.0, 0.04)
    length = frame.depth - 0.75 * frame.back_thick + overhang
    wide = 2 * frame.inner / count
    for k in range(count):
        x = -frame.inner + wide * (k + 0.5)
        longer = chaise if k == count - 1 else 0.0
        if longer and count == 1:
            longer = 0.0
        middle = (
            x,
            -0.5 * frame.depth - overhang - longer + 0.5 * (length + longer),
            frame.seat - 0.5 * puff,
        )
        assembly.add(
            cushion((wide - 0.006, length + longer, puff), middle, power=power, steps=7), cloth
        )
    if chaise:
        wide = 2 * frame.inner / max(count, 2)
        low = (frame.inner - wide, -0.5 * frame.depth - chaise, frame.feet)
        assembly.add(
            span(low, (frame.inner, -0.4 * frame.depth, frame.base), radius=0.02),
            shade(cloth, 0.92),
        )
        if count == 1:
            pad = (wide - 0.006, chaise + 0.02, puff)
            centre = (
                frame.inner - 0.5 * wide,
                -0.5 * (frame.depth + chaise) - 0.01,
                frame.seat - 0.5 * puff,
            )
            assembly.add(cushion(pad, centre, power=power, steps=7), cloth)


def _back(assembly: Assembly, draws: Draws, frame: _Frame, seats: int, cloth: Color) -> None:
    half, rear = frame.inner + draws.choice((0.0, 0.9)) * frame.arm_thick, 0.5 * frame.depth
    thick, kind = (
        frame.back_thick,
        draws.choice(("plain", "cushions", "camel", "tufted"), (0.15, 0.5, 0.2, 0.15)),
    )
    shell = 0.5 * thick if kind == "cushions" else thick
    top = frame.back - (0.06 if kind == "cushions" else 0.0)
    across = np.linspace(-1, 1, 13)
    crown = (
        draws.uniform(0.06, 0.14) * np.cos(0.5 * np.pi * across) ** 2
        if kind == "camel"
        else 0.0 * across
    )
    up = np.array([0.0, 0.08, 0.5, 0.92, 1.0])
    lean = np.tan(np.radians(frame.lean_deg))
    grid = np.empty((5, 13, 3))
    grid[..., 0] = half * across
    grid[..., 2] = frame.feet + 0.02 + up[:, None] * (top - frame.feet - 0.02 + crown)
    grid[..., 1] = rear - 0.5 * shell + lean * np.maximum(grid[..., 2] - frame.seat, 0)
    rim = np.array([0.9, 1.0, 1.0, 0.95, 0.55])[:, None] * np.where(np.abs(across) > 0.99, 0.8, 1.0)
    assembly.add(slab(grid, shell * rim), cloth)
    front = rear - shell
    if kind == "tufted":
        for z in np.linspace(frame.seat + 0.1, top - 0.08, 2):
            for x in np.linspace(-0.85, 0.85, 3 * seats) * frame.inner:
                y = front + lean * (z - frame.seat)
                assembly.add(
                    rod((x, y - 0.008, z), (x, y + 0.02, z), 0.018, segments=8), shade(cloth, 0.6)
                )
    if kind == "cushions":
        high, deep = (
            frame.back - frame.seat + draws.uniform(-0.02, 0.05),
            thick * draws.uniform(0.7, 1.0),
        )
        wide, power = 2 * frame.inner / seats, draws.uniform(3.5, 6.0)
        for k in range(seats):
            pad = cushion((wide - 0.01, deep, high), (0, 0, 0.5 * high), power=power).rotated(
                "x", -frame.lean_deg - 3
            )
            assembly.add(
                pad.moved(-frame.inner + wide * (k + 0.5), front - 0.3 * deep, frame.seat - 0.02),
                cloth,
            )
    if draws.flag(0.3):
        pillow = (
            cushion((0.4, 0.13, 0.4), power=3.0)
            .rotated("y", draws.uniform(-12, 12))
            .rotated("x", -22)
        )
        x = draws.choice((-1.0, 1.0)) * (frame.inner - 0.24)
        assembly.add(pillow.moved(x, front - 0.55 * thick, frame.seat + 0.2), tone(draws, "fabric"))


def _feet(assembly: Assembly, draws: Draws, frame: _Frame, chaise: float) -> None:
    x, front, rear = (
        frame.inner + 0.4 * frame.arm_thick,
        -0.5 * frame.depth + 0.07,
        0.5 * frame.depth - 0.07,
    )
    color = tone(draws, draws.choice(("wood", "metal", "dark")))
    if frame.feet > 0.09 and draws.flag(0.35):
        path = [
            (x, front, frame.feet + 0.02),
            (x, front, 0.012),
            (x, rear, 0.012),
            (x, rear, frame.feet + 0.02),
        ]
        assembly.add_pair(tube(fillet(path, 0.03), 0.012, segments=8), color)
    else:
        style, splay = draws.choice(("tapered", "round", "turned")), draws.uniform(0.0, 0.03)
        turning = turning_of(draws)
        for y in (front, rear):
            foot, top = (x + splay, y + np.sign(y) * splay, 0), (x, y, frame.feet + 0.02)
            assembly.add_pair(leg(style, foot, top, 0.06, taper=0.6, turning=turning), color)
    if chaise:
        for inset in (0.06, 0.4):
            low = vec(frame.inner - inset, -0.5 * frame.depth - chaise + 0.07, 0.0)
            assembly.add(rod(low, low + vec(0, 0, frame.feet + 0.02), 0.02, 0.028), color)
