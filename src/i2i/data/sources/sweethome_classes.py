"""Which Sweet Home 3D item belongs to which class, by the words of its English name.

All items were looked at once from a fixed view. The libraries keep Sweet Home 3D's convention (the
back of a piece is against the wall, so that its front looks along +z of the y-up frame) with the
exceptions listed in ``YAW_DEG``. A wrong front is label noise that no training can undo: an
item whose front is open to doubt, or whose shape is another class's, is left out.
"""

from __future__ import annotations

import re

CLASSES: tuple[str, ...] = ("bed", "cabinet", "chair", "desk", "sofa", "table")

# The first rule whose words are in the name decides; None leaves the item out.
_RULES: tuple[tuple[str, str | None], ...] = (
    (r"wheelchair|high chair|ottoman", None),  # other shapes than a chair's, or two pieces
    (r"\b(lamp|fan|bat|brush|tablet)\b", None),  # "desk lamp", "table fan", "table tennis bat"
    (r"(bedside|changing|dressing) table", None),  # a cabinet and two dressers
    (r"(pool|football) table|table tennis", None),  # games
    (r"table and|table with .*chair|\bset\b", None),  # several pieces at once
    (r"opened|futon$|mezzanine|day bed", None),  # a sofa that is a bed; beds of another build
    (r"corner cabinet|shelves|television|bedside", None),  # no single front, or no doors
    (r"chair\b", "chair"),  # also "armchair"
    (r"\b(sofa|couch)\b", "sofa"),
    (r"\bbed\b", "bed"),
    (r"\b(cabinet|cupboard|wardrobe|dresser)\b", "cabinet"),
    (r"\bdesk\b", "desk"),
    (r"\btable\b", "table"),
)

# Items that their name puts in the wrong class: `<library>/<stem of the OBJ>`.
_LEFT_OUT: frozenset[str] = frozenset(
    {
        "BlendSwap-CC-0/foldingChair",  # a folding stool without a back: it has no front
        "Scopia/ext_chair",  # one element of a modular sofa
    }
)

# Turn about the vertical axis, in degrees, that brings an item's front to +z of the y-up frame.
# These two tables lie along the depth, all other long ones along the width.
YAW_DEG: dict[str, float] = {
    "Scopia/black_table": 90.0,
    "Scopia/table4": 90.0,
}


def class_of(key: str, name: str) -> str | None:
    """Return the class of a catalogue item, or ``None`` when it belongs to none.

    Args:
        key: ``<library>/<stem of the OBJ>``.
        name: English name in the catalogue.

    >>> class_of("Any/x", "Folding chair"), class_of("Any/x", "Desk lamp")
    ('chair', None)
    """
    if key in _LEFT_OUT:
        return None
    for words, class_name in _RULES:
        if re.search(words, name.lower()):
            return class_name
    return None
