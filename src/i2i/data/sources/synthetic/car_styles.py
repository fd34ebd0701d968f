"""What kinds of cars there are, and the proportions of one."""

from __future__ import annotations

from dataclasses import dataclass

from i2i.data.sources.synthetic.draws import Draws

Range = tuple[float, float]


@dataclass(frozen=True)
class _Style:
    """Ranges of the proportions of one kind of car; lengths along y are parts of the length."""

    length: Range
    height: Range
    belt: Range  # height of the window sill, as a part of the car's height
    bonnet: Range  # where the windscreen begins
    roof_end: Range  # where the roof ends
    tail: Range  # where the rear window meets the body
    nose: Range  # height of the bonnet's front, as a part of the belt
    boot: Range  # height of the tail, as a part of the belt
    clearance: Range = (0.16, 0.2)


_STYLES = {
    "saloon": _Style(
        (4.3, 5.0), (1.40, 1.5), (0.62, 0.66), (0.27, 0.31), (0.62, 0.68),
        (0.79, 0.85), (0.68, 0.8), (0.95, 1.03),
    ),
    "hatchback": _Style(
        (3.6, 4.3), (1.42, 1.55), (0.60, 0.66), (0.22, 0.28), (0.80, 0.86),
        (0.93, 0.965), (0.7, 0.84), (0.94, 1.0),
    ),
    "estate": _Style(
        (4.4, 4.9), (1.42, 1.52), (0.62, 0.66), (0.26, 0.30), (0.88, 0.92),
        (0.955, 0.975), (0.7, 0.82), (0.96, 1.0),
    ),
    "coupe": _Style(
        (4.1, 4.6), (1.24, 1.36), (0.64, 0.7), (0.33, 0.4), (0.60, 0.66),
        (0.86, 0.95), (0.62, 0.74), (0.92, 1.02),
    ),
    "offroad": _Style(
        (4.0, 4.8), (1.65, 1.85), (0.58, 0.64), (0.24, 0.29), (0.90, 0.94),
        (0.955, 0.975), (0.84, 0.95), (0.96, 1.0), (0.22, 0.3),
    ),
    "pickup": _Style(
        (4.8, 5.5), (1.62, 1.85), (0.56, 0.62), (0.25, 0.3), (0.50, 0.58),
        (0.57, 0.64), (0.84, 0.94), (0.94, 1.0), (0.22, 0.3),
    ),
    "van": _Style(
        (4.3, 5.2), (1.75, 2.1), (0.50, 0.56), (0.12, 0.18), (0.93, 0.955),
        (0.965, 0.98), (0.72, 0.86), (0.98, 1.0), (0.17, 0.22),
    ),
}  # fmt: skip
_WEIGHTS = (0.24, 0.2, 0.14, 0.14, 0.13, 0.08, 0.07)


@dataclass(frozen=True)
class Car:
    """The proportions of one car, in metres; y = 0 is the middle of its length."""

    kind: str
    length: float
    half: float  # half width
    height: float
    sill: float
    belt: float
    wheel: float  # radius
    axles: tuple[float, float]
    screen: float  # y where the windscreen begins
    roof: tuple[float, float]  # y of the roof's front and rear
    tail: float  # y where the rear window ends
    nose: float  # height of the bonnet's front
    boot: float
    plan: float  # power of the outline seen from above


def draw_car(draws: Draws) -> Car:
    """Draw the kind and the proportions of a car."""
    kind = draws.choice(tuple(_STYLES), _WEIGHTS)
    style = _STYLES[kind]
    length, height = draws.uniform(*style.length), draws.uniform(*style.height)
    belt = height * draws.uniform(*style.belt)
    wheel = draws.uniform(0.3, 0.35) * (1.12 if kind in ("offroad", "pickup") else 1.0)
    screen, roof_end, tail = (
        draws.uniform(*part) for part in (style.bonnet, style.roof_end, style.tail)
    )
    rake = draws.uniform(0.35, 0.6) if kind in ("offroad", "pickup") else draws.uniform(0.55, 0.95)
    front = (screen - 0.5) * length
    room = 2 * wheel + 0.05  # bonnet and boot have the wheels under them
    return Car(
        kind=kind,
        length=length,
        half=0.5 * draws.uniform(1.66, 1.9),
        height=height,
        sill=draws.uniform(*style.clearance),
        belt=belt,
        wheel=wheel,
        axles=(
            (draws.uniform(0.17, 0.2) - 0.5) * length,
            (draws.uniform(0.77, 0.82) - 0.5) * length,
        ),
        screen=front,
        roof=(front + rake * (height - belt) * 1.25, (roof_end - 0.5) * length),
        tail=(tail - 0.5) * length,
        nose=max(belt * draws.uniform(*style.nose), room),
        boot=max(belt * draws.uniform(*style.boot), room),
        plan=draws.uniform(5.5, 11.0),
    )
