"""The built-in source of meshes: eleven classes of parametric objects, made on demand.

Nothing is downloaded and nothing is stored. An object is a function of (class, index, seed) only:
many continuous and discrete parameters (kinds of legs, backs, arms, wings, bodies, colours) are
drawn from a counter-based stream, so that no two instances are alike and the test instances are
variations that training has not seen.

Frame of every object: z up, the floor (or the lowest point) at about z = 0, and the **front faces
−y**. Who stands in front of an object and looks along +y sees +x on the right. So a chair's sitter
looks towards −y, cars and airplanes have their noses at −y, and a guitar shows its strings to −y,
its neck up. Chairs, stools, benches, sofas without a chaise and airplanes are mirror-symmetric
across x like real ones, which is no rotation symmetry.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import trimesh

from i2i.data.sources.base import MeshItem, MeshSource, resolve_symmetry
from i2i.data.sources.synthetic.airplanes import airplane
from i2i.data.sources.synthetic.assembly import Assembly
from i2i.data.sources.synthetic.benches import bench
from i2i.data.sources.synthetic.bottles import bottle
from i2i.data.sources.synthetic.cars import car
from i2i.data.sources.synthetic.chairs import chair
from i2i.data.sources.synthetic.draws import Draws
from i2i.data.sources.synthetic.guitars import guitar
from i2i.data.sources.synthetic.sofas import sofa
from i2i.data.sources.synthetic.stools import stool
from i2i.data.sources.synthetic.tables import desk, table
from i2i.data.sources.synthetic.toilets import toilet
from i2i.errors import MeshError

MAKERS: dict[str, Callable[[Draws], Assembly]] = {
    "airplane": airplane,
    "bench": bench,
    "bottle": bottle,
    "car": car,
    "chair": chair,
    "desk": desk,
    "guitar": guitar,
    "sofa": sofa,
    "stool": stool,
    "table": table,
    "toilet": toilet,
}


_SYMMETRY = {"table": "z2"}  # beside the published list of round classes


class SyntheticSource(MeshSource):
    """Procedural, parametric objects of eleven classes.

    Of each class the first `instances_per_class` objects are the training set and the next
    `test_instances_per_class` the test set, so a longer training set moves the test set: keep it
    fixed where results are compared.

    Bottles are surfaces of revolution and stools nearly so (symmetry "z"). A table is its own
    image under half a turn about z ("z2").

    Args:
        instances_per_class: Number of training instances of each class.
        test_instances_per_class: Number of test instances of each class.
        seed: Another seed gives other objects.
        classes: The classes on offer; all eleven by default.
        symmetry: "none", "z" or "z2" for all classes, or a mapping from some classes to one.

    Raises:
        ValueError: A count that is negative, no instances at all, or an unknown class.

    Example:
        >>> source = SyntheticSource(instances_per_class=2, test_instances_per_class=1)
        >>> [item.instance_id for item in source.items(["chair"])]
        ['chair_0000', 'chair_0001', 'chair_0002']
        >>> source.load(source.items(["chair"])[0]).vertices.shape[1]
        3
    """

    name = "synthetic"
    up_axis = "z"
    classes = tuple(MAKERS)
    licence = "procedural, MIT"

    def __init__(
        self,
        *,
        instances_per_class: int = 100,
        test_instances_per_class: int = 20,
        seed: int = 0,
        classes: Sequence[str] | None = None,
        symmetry: str | Mapping[str, str] | None = None,
    ) -> None:
        counts = (instances_per_class, test_instances_per_class)
        if min(counts) < 0 or sum(counts) == 0:
            raise ValueError(
                f"instances_per_class={counts[0]} and test_instances_per_class={counts[1]} are not "
                "possible: neither may be negative, and one at least must be positive. Set "
                "data.source.instances_per_class=100 data.source.test_instances_per_class=20."
            )
        self.instances_per_class = instances_per_class
        self.test_instances_per_class = test_instances_per_class
        self.seed = seed
        if classes is not None:
            self.classes = tuple(sorted(self.check_classes(classes)))
        told = dict.fromkeys(self.classes, symmetry) if isinstance(symmetry, str) else symmetry
        made = {name: word for name, word in _SYMMETRY.items() if name in self.classes}
        self.symmetry = resolve_symmetry(self.classes, made | dict(told or {}))

    def __repr__(self) -> str:
        return (
            f"SyntheticSource({len(self.classes)} classes × "
            f"({self.instances_per_class} train + {self.test_instances_per_class} test), "
            f"seed={self.seed})"
        )

    def items(self, classes: Sequence[str]) -> list[MeshItem]:
        """List the objects of some classes; see `MeshSource.items`.

        The `ref` of an item is "class:index:seed", all that its shape depends on.
        """
        total = self.instances_per_class + self.test_instances_per_class
        return [
            MeshItem(
                class_name=name,
                instance_id=f"{name}_{index:04d}",
                split="train" if index < self.instances_per_class else "test",
                group=f"{name}_{index:04d}",
                ref=f"{name}:{index}:{self.seed}",
                licence=self.licence,
                author="i2i",
            )
            for name in self.check_classes(classes)
            for index in range(total)
        ]

    def load(self, item: MeshItem) -> trimesh.Trimesh:
        """Make one object: about 1,000 to 5,000 triangles, with a colour for each.

        Raises:
            MeshError: The item's `ref` is not one that this source gives out.
        """
        parts = item.ref.split(":")
        try:
            name, index, seed = parts[0], int(parts[1]), int(parts[2])
            maker = MAKERS[name]
        except (IndexError, ValueError, KeyError) as error:
            raise MeshError(
                f"{item.ref!r} is not a synthetic object; it should be class:index:seed, such as "
                f"chair:7:0, with a class of: {', '.join(MAKERS)}."
            ) from error
        return maker(Draws(name, index, seed=seed)).to_trimesh()
