"""Writing any source's objects in the layouts of ModelNet40 and ShapeNetCore v2.

Objects that were written this way and are read back by those sources give the same pictures: the
readers and the frames of the public data sets can be shown to be right without the data.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import trimesh
from PIL import Image

from i2i.data.sources.base import MeshItem, MeshSource, check_up_axis
from i2i.data.sources.shapenet_synsets import SYNSETS
from i2i.rendering.visuals import Material, Surface, surface_from_trimesh


def export_modelnet_layout(
    source: MeshSource, items: Iterable[MeshItem], folder: str | Path
) -> list[Path]:
    """Write ``<class>/{train,test}/<instance>.off``, z up, without colours (OFF has none here).

    Args:
        source: Where the items come from.
        items: What to write; an item without a split goes to ``train``.
        folder: Root of the layout; it is made.

    Returns:
        The files, in the order of the items.
    """
    to_z_up = z_up_rotation(source.up_axis)
    files = []
    for item in items:
        surfaces = _surfaces(source, item, to_z_up)
        starts = np.cumsum([0] + [len(surface.vertices) for surface in surfaces])
        vertices = np.concatenate([surface.vertices for surface in surfaces])
        faces = np.concatenate(
            [surface.faces + start for surface, start in zip(surfaces, starts, strict=False)]
        )
        path = Path(folder) / item.class_name / (item.split or "train") / f"{item.instance_id}.off"
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("w", encoding="ascii") as stream:
            stream.write(f"OFF\n{len(vertices)} {len(faces)} 0\n")
            np.savetxt(stream, vertices, fmt="%.17g")  # every bit of a float64
            np.savetxt(stream, np.insert(faces, 0, 3, axis=1), fmt="%d")
        files.append(path)
    return files


def export_shapenet_layout(
    source: MeshSource, items: Iterable[MeshItem], folder: str | Path
) -> list[Path]:
    """Write ``<synset>/<instance>/models/model_normalized.obj`` with MTL and textures, y up.

    ``taxonomy.json`` names the classes; one that ShapeNet does not have gets a made-up synset that
    begins with 9. Colours that change within a face are replaced by their mean.

    Args:
        source: Where the items come from.
        items: What to write; splits are dropped, as ShapeNet has none.
        folder: Root of the layout; it is made.

    Returns:
        The OBJ files, in the order of the items.
    """
    folder = Path(folder)
    to_y_up = z_up_rotation("y").T @ z_up_rotation(source.up_axis)
    files = []
    counts: dict[str, int] = {}
    for item in items:
        model = folder / synset_for(item.class_name) / item.instance_id
        files.append(_write_obj(_surfaces(source, item, to_y_up), model))
        counts[item.class_name] = counts.get(item.class_name, 0) + 1
    taxonomy = [
        {"synsetId": synset_for(name), "name": name, "children": [], "numInstances": count}
        for name, count in sorted(counts.items())
    ]
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "taxonomy.json").write_text(json.dumps(taxonomy, indent=1), encoding="utf-8")
    return files


def synset_for(class_name: str) -> str:
    """Return ShapeNet's synset of a class, or a made-up one of eight digits that begins with 9."""
    made_up = int(hashlib.sha256(class_name.encode()).hexdigest(), 16) % 10**7
    return SYNSETS.get(class_name, f"9{made_up:07d}")


def z_up_rotation(up_axis: str) -> np.ndarray:
    """Return the smallest rotation, (3, 3), that turns an axis to +z (for −z: about x).

    >>> z_up_rotation("y") @ [0.0, 1.0, 0.0]
    array([0., 0., 1.])
    """
    up = np.zeros(3)
    up["xyz".index(check_up_axis(up_axis)[-1])] = -1.0 if up_axis.startswith("-") else 1.0
    if up[2] < 0:
        return np.diag([1.0, -1.0, -1.0])
    x, y = up[1], -up[0]  # up × z
    cross = np.array([[0.0, 0.0, y], [0.0, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + cross + cross @ cross / (1.0 + up[2])


def _surfaces(source: MeshSource, item: MeshItem, rotation: np.ndarray) -> list[Surface]:
    """Load one object and turn its parts."""
    loaded = source.load(item)
    turn = np.eye(4)
    turn[:3, :3] = rotation
    parts = loaded.dump(concatenate=False) if isinstance(loaded, trimesh.Scene) else [loaded]
    return [
        surface_from_trimesh(part, turn)
        for part in parts
        if isinstance(part, trimesh.Trimesh) and len(part.faces)
    ]


def _write_obj(surfaces: Sequence[Surface], model: Path) -> Path:
    """Write one model's OBJ and MTL to ``models/`` and its textures to ``images/``."""
    (model / "models").mkdir(parents=True, exist_ok=True)
    lines, mtl = ["mtllib model_normalized.mtl"], []
    next_vertex, next_uv, next_material = 1, 1, 0  # OBJ counts from one
    for surface in map(_colours_as_materials, surfaces):
        lines += ["v " + _numbers(vertex) for vertex in surface.vertices]
        corners = [[str(v + next_vertex) for v in face] for face in surface.faces]
        if surface.corner_uv is not None:
            unique, index = np.unique(surface.corner_uv.reshape(-1, 2), axis=0, return_inverse=True)
            lines += ["vt " + _numbers(uv) for uv in unique]
            index = index.reshape(-1, 3) + next_uv
            corners = [
                [f"{v}/{t}" for v, t in zip(face, uvs, strict=True)]
                for face, uvs in zip(corners, index, strict=True)
            ]
            next_uv += len(unique)
        next_vertex += len(surface.vertices)
        for number, material in enumerate(surface.materials):
            name = f"material_{next_material + number}"
            mtl += _mtl_entry(name, material, model)
            chosen = np.flatnonzero(surface.face_material == number)
            if len(chosen):
                lines.append(f"usemtl {name}")
                lines += ["f " + " ".join(corners[face]) for face in chosen]
        next_material += len(surface.materials)
    path = model / "models" / "model_normalized.obj"
    path.with_suffix(".mtl").write_text("\n".join(mtl) + "\n", encoding="utf-8")
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def _numbers(values: Iterable[float]) -> str:
    return " ".join(f"{value:.17g}" for value in values)  # every bit of a float64


def _mtl_entry(name: str, material: Material, model: Path) -> list[str]:
    """Return the MTL lines of a material and write its texture."""
    lines = [f"newmtl {name}", "Kd " + _numbers(material.base_color)]
    if material.texture is not None:
        (model / "images").mkdir(exist_ok=True)
        Image.fromarray(material.texture).save(model / "images" / f"{name}.png")
        lines.append(f"map_Kd ../images/{name}.png")
    return lines


def _colours_as_materials(surface: Surface) -> Surface:
    """Turn face colours into plain materials, because OBJ knows none."""
    if surface.corner_color is None:
        return surface
    colours = np.rint(surface.corner_color.astype(np.float64).mean(axis=1)).astype(np.int64)
    keys = np.column_stack([surface.face_material, colours])
    unique, face_material = np.unique(keys, axis=0, return_inverse=True)
    materials = []
    for material_number, *colour in unique.tolist():
        old = surface.materials[material_number]
        red, green, blue = (
            base * c / 255.0 for base, c in zip(old.base_color, colour, strict=True)
        )
        materials.append(replace(old, base_color=(red, green, blue)))
    return replace(
        surface,
        corner_color=None,
        face_material=face_material.reshape(-1),
        materials=tuple(materials),
    )
