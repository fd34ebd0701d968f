"""Colours of materials: a few real tones each, varied from instance to instance."""

from __future__ import annotations

import colorsys

from i2i.data.sources.synthetic.draws import Draws

Color = tuple[int, int, int]

_TONES: dict[str, tuple[Color, ...]] = {
    "wood": (
        (222, 184, 135), (193, 145, 92), (160, 106, 60), (120, 74, 42), (86, 52, 32),
        (205, 170, 125), (148, 84, 50), (232, 208, 168),
    ),
    "fabric": (
        (70, 92, 122), (142, 58, 56), (94, 112, 86), (176, 164, 148), (104, 96, 100),
        (196, 142, 64), (52, 110, 118), (150, 126, 150), (206, 196, 180), (60, 64, 76),
        (120, 40, 60), (168, 110, 86),
    ),
    "leather": (
        (92, 52, 34), (78, 54, 44), (148, 92, 54), (58, 56, 60), (120, 34, 34),
        (214, 200, 176),
    ),
    "metal": (
        (176, 180, 186), (128, 132, 138), (84, 86, 92), (208, 210, 214), (146, 134, 116),
    ),
    "dark": (
        (50, 50, 56), (64, 60, 62), (76, 80, 88), (44, 48, 58),
    ),
    "plastic": (
        (236, 236, 232), (206, 62, 52), (242, 176, 40), (44, 122, 170), (64, 152, 110),
        (46, 48, 54), (156, 196, 190), (226, 118, 60), (130, 134, 140),
    ),
    "ceramic": (
        (246, 246, 244), (238, 234, 222), (226, 232, 236), (216, 202, 186), (232, 208, 204),
        (168, 190, 186),
    ),
    "paint": (
        (178, 32, 36), (28, 62, 128), (226, 226, 226), (42, 44, 48), (134, 140, 148),
        (30, 104, 74), (232, 168, 30), (92, 140, 180), (118, 26, 52), (212, 96, 34),
        (160, 150, 124), (76, 84, 60),
    ),
    "glass": (
        (44, 92, 58), (98, 62, 28), (176, 206, 206), (60, 104, 150), (30, 60, 44),
        (196, 190, 150),
    ),
    "fuselage": (
        (240, 240, 242), (214, 218, 224), (196, 200, 206), (228, 222, 206), (120, 128, 134),
    ),
    "accent": (
        (188, 38, 42), (30, 74, 150), (238, 166, 32), (40, 130, 96), (90, 52, 130),
        (60, 64, 72),
    ),
}  # fmt: skip

BLACK: Color = (28, 28, 30)
WINDOW: Color = (46, 58, 70)
CHROME: Color = (200, 204, 208)
HEADLIGHT: Color = (244, 244, 228)
TAILLIGHT: Color = (176, 22, 26)


def tone(draws: Draws, material: str) -> Color:
    """A colour of a material, one of its real tones with a small variation.

    Args:
        draws: Stream of the instance.
        material: A key of the palette, such as "wood" or "fabric".

    Returns:
        Red, green and blue, 0 to 255.
    """
    red, green, blue = draws.choice(_TONES[material])
    hue, lightness, saturation = colorsys.rgb_to_hls(red / 255, green / 255, blue / 255)
    hue = (hue + draws.uniform(-0.02, 0.02)) % 1.0
    lightness = min(max(lightness * draws.uniform(0.88, 1.12), 0.06), 0.97)
    saturation = min(max(saturation * draws.uniform(0.8, 1.2), 0.0), 1.0)
    varied = colorsys.hls_to_rgb(hue, lightness, saturation)
    return (round(varied[0] * 255), round(varied[1] * 255), round(varied[2] * 255))


def shade(color: Color, factor: float) -> Color:
    """The colour made lighter (factor above 1) or darker (below 1), clipped to 0 to 255."""
    red, green, blue = (min(max(round(channel * factor), 0), 255) for channel in color)
    return (red, green, blue)
