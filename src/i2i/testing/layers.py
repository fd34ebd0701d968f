"""What the layers of a network claim to commute with, and how to turn what goes in and comes out.

A claim is a triple ``(path, input, output)``: the module at ``path`` (dotted, ``""`` the module
itself) turns its output as ``output`` says when its input is turned as ``input`` says. The kinds
that name how something turns also name the group:

=========================  ============================  ==================================
kinds                      group                         what the element does
=========================  ============================  ==================================
``map``                    quarter turns, mesh axis      turns the raster
``regular``                quarter turns                 turns it and shifts the four channels
``invariant``              quarter turns                 nothing
``rotation``               quarter turns, mesh axis      multiplies from the left by Rz
``signal``                 mesh axis                     permutes the vertices
``group``                  mesh axis, icosahedral        permutes the 60 elements
``sphere``                 icosahedral                   permutes the places (vertices, or the
                                                         60 elements) of the parameter
                                                         ``sphere`` (K, places, ...), not an
                                                         input
=========================  ============================  ==================================

The layers of this package are known here. A module of your own says it itself, with plain data and
without importing anything::

    class MyEncoder(nn.Module):
        def claims(self):
            return [("stem", "map", "regular"), ("", "map", "map")]
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache, lru_cache, singledispatch

import torch
from torch import Tensor, nn

from i2i.geometry.icosahedron import Icosahedron, MeshAxis, icosahedron
from i2i.geometry.rotations import axis_rotation
from i2i.nn.c4_resnet import C4ResNet18
from i2i.nn.group_conv_variants import VectorFilterConv
from i2i.nn.group_convs import DynamicFilterConv, GroupCorrelation
from i2i.nn.projectors import IcosahedralProjector
from i2i.testing.equivariance import Action, turn_map, turn_regular_map

QUARTER_KINDS = ("map", "regular", "invariant", "rotation")
AXIS_KINDS = ("map", "signal", "group", "rotation")
ICOSAHEDRAL_KINDS = ("sphere", "group")

Triple = tuple[str, str, str]


@dataclass(frozen=True, eq=False)
class Symmetry:
    """A group, or the part of one that is tried, with its actions.

    Attributes:
        name: What tables call it.
        elements: Numbers of the elements that are tried.
        labels: What tables call them, one for each.
        wrong: For each of them another element, for the negative control.
        actions: How each kind is turned: ``(element, x) -> x turned``.
    """

    name: str
    elements: tuple[int, ...]
    labels: tuple[str, ...]
    wrong: tuple[int, ...]
    actions: Mapping[str, Action]


@dataclass(frozen=True)
class Claim:
    """One module and one group.

    Attributes:
        path: Dotted name of the module in the network.
        module: The module.
        input: Kind of what goes in.
        output: Kind of what comes out.
        symmetry: The group, with the numbering of the module's mesh.
    """

    path: str
    module: nn.Module
    input: str
    output: str
    symmetry: Symmetry


def find_claims(network: nn.Module) -> list[Claim]:
    """Every claim of every module of a network, in the order of the modules.

    A module with a method ``claims()`` speaks for itself; else what is known of its class counts.

    Raises:
        ValueError: If a claim names a kind or a module that is not there.
    """
    found: dict[Triple, Claim] = {}
    for prefix, module in network.named_modules():
        own = getattr(module, "claims", None)
        triples = own() if callable(own) else known_claims(module)
        for relative, source, target in triples:
            path = ".".join(part for part in (prefix, relative) if part)
            claimed = _submodule(network, path)
            symmetry = symmetry_of(claimed, source, target)
            found.setdefault((path, source, target), Claim(path, claimed, source, target, symmetry))
    return list(found.values())


@singledispatch
def known_claims(module: nn.Module) -> list[Triple]:
    """Claims of a module that has no method ``claims()``: none, but for the classes known here."""
    return []


@known_claims.register
def _(module: C4ResNet18) -> list[Triple]:
    claims = [("stem", "map", "regular")]
    if not isinstance(module.max_pool, nn.Identity):
        claims.append(("max_pool", "regular", "regular"))
    claims += [(f"blocks.{i}", "regular", "regular") for i in range(len(module.blocks))]
    return [*claims, ("", "map", "map")]


@known_claims.register
def _(module: IcosahedralProjector) -> list[Triple]:
    return [("", "map", "signal")]


@known_claims.register
def _(module: GroupCorrelation) -> list[Triple]:
    claims = [("", "sphere", "group")]
    if isinstance(module, DynamicFilterConv | VectorFilterConv):
        # The half mesh is closed under turns about its axis; supports in the group are not.
        claims.append(("", "signal", "group"))
    return claims


def symmetry_of(module: nn.Module, source: str, target: str) -> Symmetry:
    """The group that a pair of kinds speaks of.

    Raises:
        ValueError: If no group has both kinds, or the module's mesh is not known.
    """
    pair = {source, target}
    if pair <= set(QUARTER_KINDS):
        return quarter_turns()
    if pair <= set(AXIS_KINDS):
        return axis_turns(mesh_of(module))
    if pair <= set(ICOSAHEDRAL_KINDS):
        return icosahedral_turns(mesh_of(module))
    raise ValueError(
        f"{type(module).__name__} claims {source!r} -> {target!r}; both must be of one group: "
        f"{', '.join(QUARTER_KINDS)} for quarter turns, {', '.join(AXIS_KINDS)} for turns about "
        f"the mesh's axis, {', '.join(ICOSAHEDRAL_KINDS)} for all 60 rotations"
    )


def mesh_of(module: nn.Module) -> Icosahedron:
    """The icosahedron whose numbering a module uses.

    Its attribute ``mesh`` if there is one; else the mesh with ``num_vertices`` vertices, of all or
    of the visible half, or with ``sphere_size`` vertices (60: features on the group itself), and
    its ``mesh_axis`` towards the viewer where it has one.

    Raises:
        ValueError: If the module has none of them.
    """
    mesh = getattr(module, "mesh", None)
    if isinstance(mesh, Icosahedron):
        return mesh
    sizes = {getattr(module, "num_vertices", None), getattr(module, "sphere_size", None)}
    mesh_axis: MeshAxis = getattr(module, "mesh_axis", "vertex")
    for level in (1, 0, 2):
        mesh = icosahedron(level, mesh_axis=mesh_axis)
        if sizes & {len(mesh.visible), len(mesh.vertices), len(mesh.rotations)}:
            return mesh
    raise ValueError(
        f"{type(module).__name__} has num_vertices={getattr(module, 'num_vertices', None)}, which "
        "is no icosahedron of ours: give it an attribute `mesh`, made by "
        "i2i.geometry.icosahedron.icosahedron"
    )


@lru_cache(maxsize=1)
def quarter_turns() -> Symmetry:
    """Turns of the image by 90°, 180° and 270°, counter-clockwise."""
    return Symmetry(
        name="C4",
        elements=(1, 2, 3),
        labels=("90°", "180°", "270°"),
        wrong=(3, 1, 1),
        actions={
            "map": turn_map,
            "regular": turn_regular_map,
            "invariant": lambda _, x: x,
            "rotation": lambda k, x: axis_rotation("z", 90 * k).to(x) @ x,
        },
    )


@cache
def axis_turns(mesh: Icosahedron) -> Symmetry:
    """The rotations of the group about the viewing axis; they permute the visible half mesh.

    Turns that are not multiples of 90° resample a raster (bicubic), which is not exact: the error
    of the resampling is part of what is measured.
    """
    degrees = _axis_degrees(mesh)
    elements = tuple(g for g in sorted(degrees, key=degrees.__getitem__) if g != mesh.identity)
    inverse = [int(mesh.inverse[g]) for g in elements]
    # A half turn is its own inverse; its control leaves the output as it was.
    wrong = tuple(h if h != g else mesh.identity for g, h in zip(elements, inverse, strict=True))
    return Symmetry(
        name=f"C{len(elements) + 1}",
        elements=elements,
        labels=tuple(f"{degrees[g]:.0f}°" for g in elements),
        wrong=wrong,
        actions={
            "map": lambda g, x: turn_raster(x, degrees[g]),
            "signal": lambda g, x: x.index_select(1, _vertices(mesh, g, x.shape[1]).to(x.device)),
            "group": lambda g, x: x.index_select(1, mesh.multiplication[:, g].to(x.device)),
            "rotation": lambda g, x: axis_rotation("z", degrees[g]).to(x) @ x,
        },
    )


@cache
def icosahedral_turns(mesh: Icosahedron) -> Symmetry:
    """All 60 rotations of the feature sphere: ``f'(v) = f(h v)`` gives ``out'(g) = out(h g)``."""
    inverse = mesh.inverse.tolist()
    wrong = [h if h != g else (g + 1) % len(inverse) for g, h in enumerate(inverse)]
    return Symmetry(
        name="I60",
        elements=tuple(range(len(inverse))),
        labels=tuple(str(g) for g in range(len(inverse))),
        wrong=tuple(wrong),
        actions={
            "sphere": lambda h, x: x.index_select(1, _places(mesh, h, x.shape[1]).to(x.device)),
            "group": lambda h, x: x.index_select(1, mesh.multiplication[h].to(x.device)),
        },
    )


def turn_raster(x: Tensor, degrees: float) -> Tensor:
    """Turn rasters (B, C, S, S) counter-clockwise about their centre.

    Quarter turns are exact; other angles interpolate (bicubic) and repeat the border outwards.
    """
    quarters = degrees / 90
    if abs(quarters - round(quarters)) < 1e-6:
        return turn_map(round(quarters), x)
    angle = math.radians(degrees)
    cos, sin = math.cos(angle), math.sin(angle)
    # Where each output cell comes from, in (x right, y down): the turn backwards.
    backwards = torch.tensor([[cos, -sin, 0.0], [sin, cos, 0.0]], dtype=x.dtype, device=x.device)
    grid = nn.functional.affine_grid(
        backwards.expand(len(x), 2, 3), list(x.shape), align_corners=False
    )
    return nn.functional.grid_sample(
        x, grid, mode="bicubic", padding_mode="border", align_corners=False
    )


def image_action(symmetry: Symmetry) -> Callable[[int, Tensor], Tensor] | None:
    """How an element turns the picture (B, C, S, S); None for a group that no picture shows."""
    return symmetry.actions.get("map")


def _axis_degrees(mesh: Icosahedron) -> dict[int, float]:
    """Angle in [0, 360) of each element that leaves the viewing axis where it is."""
    # In the frame of the vertices: the standard one is conjugated back.
    matrices = mesh.rotations
    if mesh.frame == "standard":
        matrices = mesh.tilt @ matrices @ mesh.tilt.T
    kept = torch.nonzero(matrices[:, 2, 2] > 1 - 1e-6).flatten().tolist()
    angles = torch.rad2deg(torch.atan2(matrices[:, 1, 0], matrices[:, 0, 0]))
    return {g: round(angles[g].item(), 6) % 360 for g in kept}


def _vertices(mesh: Icosahedron, element: int, count: int) -> Tensor:
    """Numbers n with ``turned[i] = signal[n[i]]``: ``ψ'(v) = ψ(h⁻¹ v)``, over all or half."""
    moved = mesh.action[mesh.inverse[element]]
    if count == len(mesh.vertices):
        return moved
    position = torch.full((len(mesh.vertices),), -1)
    position[mesh.visible] = torch.arange(len(mesh.visible))
    return position[moved[mesh.visible]]


def _places(mesh: Icosahedron, element: int, count: int) -> Tensor:
    """Where an element takes each vertex, or each element where features are on the group."""
    table = mesh.multiplication if count == len(mesh.rotations) else mesh.action
    return table[element]


def _submodule(network: nn.Module, path: str) -> nn.Module:
    try:
        return network.get_submodule(path)
    except AttributeError as error:
        raise ValueError(f"claims() names {path!r}, and the network has no such module") from error
