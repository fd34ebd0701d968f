"""One mesh in Blender's only scene: geometry, materials, camera, light, and pictures from Cycles.

Blender as a module is one global state for a process. `CyclesScene` starts from factory settings,
so nothing of an earlier mesh, of a user's preferences or of another scene is left. It belongs in a
process of its own, see `i2i.rendering.blender_process`.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from i2i.geometry.cameras import Camera
from i2i.rendering.mesh import RenderMesh
from i2i.rendering.shading import (
    COLOR_LIGHT,
    DIELECTRIC_REFLECTANCE,
    GRAY_LIGHT,
    METALLIC,
    ROUGHNESS,
    corner_normals,
    linear_from_srgb,
)
from i2i.rendering.visuals import Material

SEED = 0  # of Cycles' sampling: the same for every picture
# A lamp of P watts gives P / (4 pi d^2) on a surface that faces it at distance d; the shared
# shading counts with intensity / d^2, and takes the mirrored share off a white surface's diffuse
# light twice (as pyrender's shader does) where Cycles takes it off once.
_WATTS = 4 * np.pi * (1 - DIELECTRIC_REFLECTANCE * (1 - METALLIC) - METALLIC)
_NEAR = 1e-3  # a ray starts here; the object may reach up to the camera
_LAYER = 2e-3  # surfaces that are closer to each other are taken for one, in object units
_BRIGHTEST = 1.0  # light that a path of several surfaces brings at most; 1 is white
_CENTRE_FILTER = 0.01  # narrowest pixel filter that Cycles takes, in pixels
_COLOR, _UV = "corner color", "corner uv"  # a plain "color" would mean the object's own


class CyclesScene:
    """A mesh that Cycles draws from any side; the set-up is shared by all pictures.

    Making another one empties Blender's state and ends the use of this one.

    Args:
        mesh: In the object frame.
        modality: "gray", "rgb", or "depth" for ray lengths in place of light.
        camera: Distance and field of view.
        image_size: Side of the picture in pixels, at least 4.
        samples: Paths through each pixel; "depth" takes one, through its centre.
        bounces: Reflections from surface to surface; 0 is the light of the camera's lamp alone.
        denoise: Filter the picture with Intel's Open Image Denoise.
        folder: Where Blender leaves its picture for Python.
    """

    def __init__(
        self,
        mesh: RenderMesh,
        modality: str,
        camera: Camera,
        image_size: int,
        *,
        samples: int,
        bounces: int,
        denoise: bool,
        folder: Path,
    ) -> None:
        import bpy

        bpy.ops.wm.read_factory_settings(use_empty=True)
        self._bpy = bpy
        self._camera = camera
        self._size = image_size
        self._file = str(folder / "view.exr")
        self._picture: Any = None
        scene = bpy.context.scene
        _set_output(scene, image_size, self._file)
        if modality == "depth":
            _set_sampling(scene, samples=1, bounces=0, denoise=False, filter_width=_CENTRE_FILTER)
        else:
            _set_sampling(scene, samples=samples, bounces=bounces, denoise=denoise)
        scene.collection.objects.link(_object(bpy, mesh, modality))
        self._eye = _eye(bpy, camera, mesh.bounding_radius)
        scene.collection.objects.link(self._eye)
        scene.camera = self._eye
        if modality != "depth":
            lamp = _lamp(bpy, COLOR_LIGHT if modality == "rgb" else GRAY_LIGHT)
            scene.collection.objects.link(lamp)
            lamp.parent = self._eye

    def shoot(self, rotation: NDArray[np.float64]) -> NDArray[np.float32]:
        """One picture: linear light or ray lengths times the coverage, and the coverage.

        Args:
            rotation: Object to camera, shape (3, 3).

        Returns:
            Shape (H, W, 4), first row on top.
        """
        pose = np.eye(4)
        # The camera moves and the object rests, so that Cycles keeps the object's tree of boxes.
        pose[:3, :3] = rotation.T
        pose[:3, 3] = rotation.T @ self._camera.position
        self._eye.matrix_world = pose.T.tolist()  # Blender takes lists as columns
        self._bpy.ops.render.render(write_still=True)
        if self._picture is None:
            self._picture = self._bpy.data.images.load(self._file)
        else:
            self._picture.reload()
        values = np.empty(self._size * self._size * 4, dtype=np.float32)
        self._picture.pixels.foreach_get(values)
        return values.reshape(self._size, self._size, 4)[::-1]


def _set_output(scene: Any, image_size: int, file: str) -> None:  # noqa: ANN401 - bpy has no types
    """A square picture as linear floats with its coverage, into one file."""
    render = scene.render
    render.engine = "CYCLES"
    render.resolution_x = render.resolution_y = image_size
    render.resolution_percentage = 100
    render.pixel_aspect_x = render.pixel_aspect_y = 1.0
    render.film_transparent = True
    render.use_file_extension = False
    render.filepath = file
    render.image_settings.file_format = "OPEN_EXR"
    render.image_settings.color_mode = "RGBA"
    render.image_settings.color_depth = "32"
    render.image_settings.exr_codec = "NONE"
    render.use_persistent_data = True  # keep the mesh in Cycles from view to view
    # Workers run beside each other with one thread each (they are started with this variable).
    threads = os.environ.get("OMP_NUM_THREADS", "")
    if threads.isdigit() and int(threads) > 0:
        render.threads_mode = "FIXED"
        render.threads = int(threads)


def _set_sampling(
    scene: Any,  # noqa: ANN401
    *,
    samples: int,
    bounces: int,
    denoise: bool,
    filter_width: float = 1.0,
) -> None:
    """Cycles on the processor, with everything off that would look at the picture to save work."""
    cycles = scene.cycles
    cycles.device = "CPU"
    cycles.seed = SEED
    cycles.samples = samples
    cycles.use_adaptive_sampling = False
    cycles.sampling_pattern = "TABULATED_SOBOL"
    cycles.use_denoising = denoise
    if denoise:
        cycles.denoiser = "OPENIMAGEDENOISE"
        cycles.denoising_use_gpu = False
    cycles.pixel_filter_type = "BOX"  # the mean over the pixel's own square
    cycles.filter_width = filter_width
    cycles.max_bounces = cycles.diffuse_bounces = cycles.glossy_bounces = bounces
    cycles.transmission_bounces = cycles.volume_bounces = 0
    cycles.caustics_reflective = cycles.caustics_refractive = False
    cycles.sample_clamp_direct = 0.0
    # A path that finds a highlight by chance is a white speck that no number of samples removes.
    cycles.sample_clamp_indirect = _BRIGHTEST
    cycles.use_auto_tile = False


def _eye(bpy: Any, camera: Camera, radius: float) -> Any:  # noqa: ANN401
    """A pinhole camera; Blender's has the axes of ours."""
    lens = bpy.data.cameras.new("eye")
    lens.type = "PERSP"
    lens.sensor_fit = "HORIZONTAL"
    lens.angle = np.radians(camera.fov_deg)
    lens.shift_x = lens.shift_y = 0.0
    lens.dof.use_dof = False
    lens.clip_start = _NEAR
    lens.clip_end = 2 * (camera.distance + radius)
    return bpy.data.objects.new("eye", lens)


def _lamp(bpy: Any, intensity: float) -> Any:  # noqa: ANN401
    """A point of light."""
    light = bpy.data.lights.new("lamp", "POINT")
    light.energy = intensity * _WATTS
    light.shadow_soft_size = 0.0
    return bpy.data.objects.new("lamp", light)


def _object(bpy: Any, mesh: RenderMesh, modality: str) -> Any:  # noqa: ANN401
    """The mesh with normals and materials.

    Each face has corners of its own: what differs between the faces at a vertex (normals, colours,
    coordinates) then needs no rule for how Blender shares it.
    """
    count = len(mesh.faces)
    made = bpy.data.meshes.new("mesh")
    made.vertices.add(3 * count)
    made.vertices.foreach_set("co", mesh.vertices[mesh.faces].astype(np.float32).ravel())
    made.loops.add(3 * count)
    made.loops.foreach_set("vertex_index", np.arange(3 * count, dtype=np.int32))
    made.polygons.add(count)
    made.polygons.foreach_set("loop_start", np.arange(0, 3 * count, 3, dtype=np.int32))
    made.update(calc_edges=True)
    if modality == "depth":
        made.materials.append(_ray_length_material(bpy))
    else:
        normals = corner_normals(mesh.vertices, mesh.faces).reshape(-1, 3)
        made.normals_split_custom_set(normals.astype(np.float32))
        _paint(bpy, made, mesh, painted=modality == "rgb")
    return bpy.data.objects.new("object", made)


def _paint(bpy: Any, made: Any, mesh: RenderMesh, *, painted: bool) -> None:  # noqa: ANN401
    """Materials of the faces; one white one if not `painted`."""
    if not painted:
        made.materials.append(_material(bpy, Material(), uv=False, tint=False))
        return
    uv, tint = mesh.corner_uv is not None, mesh.corner_color is not None
    for material in mesh.materials:
        made.materials.append(_material(bpy, material, uv=uv, tint=tint))
    made.polygons.foreach_set("material_index", mesh.face_material.astype(np.int32))
    if mesh.corner_uv is not None:
        layer = made.uv_layers.new(name=_UV)
        layer.uv.foreach_set("vector", mesh.corner_uv.astype(np.float32).ravel())
    if mesh.corner_color is not None:
        colors = np.ones((3 * len(mesh.faces), 4), dtype=np.float32)
        colors[:, :3] = linear_from_srgb(mesh.corner_color.reshape(-1, 3) / 255.0)
        attribute = made.color_attributes.new(_COLOR, "FLOAT_COLOR", "CORNER")
        attribute.data.foreach_set("color", colors.ravel())


def _material(bpy: Any, material: Material, *, uv: bool, tint: bool) -> Any:  # noqa: ANN401
    """The paper's surface in a colour, times a texture, times the corner colours."""
    made = bpy.data.materials.new("material")
    made.use_nodes = True
    tree = made.node_tree
    surface = tree.nodes["Principled BSDF"]
    surface.inputs["Metallic"].default_value = METALLIC
    surface.inputs["Roughness"].default_value = ROUGHNESS
    color = tree.nodes.new("ShaderNodeRGB").outputs[0]
    color.default_value = [*(float(v) for v in linear_from_srgb(material.base_color)), 1.0]
    if uv and material.texture is not None:
        where = tree.nodes.new("ShaderNodeUVMap")
        where.uv_map = _UV
        picture = tree.nodes.new("ShaderNodeTexImage")
        picture.image = _texture(bpy, material.texture)
        picture.extension, picture.interpolation = "REPEAT", "Linear"
        tree.links.new(where.outputs["UV"], picture.inputs["Vector"])
        color = _product(tree, color, picture.outputs["Color"])
    if tint:
        corner = tree.nodes.new("ShaderNodeAttribute")
        corner.attribute_name = _COLOR
        color = _product(tree, color, corner.outputs["Color"])
    tree.links.new(color, surface.inputs["Base Color"])
    _let_through_near_rays(tree, surface)
    return made


def _let_through_near_rays(tree: Any, surface: Any) -> None:  # noqa: ANN401
    """Make the surface invisible to rays that start next to it.

    Real files hold the same surface twice, or one surface on another. Without this, such layers
    would throw shadows and light on each other, in patterns that come from rounding.
    """
    length = tree.nodes.new("ShaderNodeLightPath").outputs["Ray Length"]
    near = tree.nodes.new("ShaderNodeMath")
    near.operation = "LESS_THAN"
    tree.links.new(length, near.inputs[0])
    near.inputs[1].default_value = _LAYER
    mix = tree.nodes.new("ShaderNodeMixShader")
    tree.links.new(near.outputs[0], mix.inputs[0])
    tree.links.new(surface.outputs[0], mix.inputs[1])
    tree.links.new(tree.nodes.new("ShaderNodeBsdfTransparent").outputs[0], mix.inputs[2])
    tree.links.new(mix.outputs[0], tree.nodes["Material Output"].inputs["Surface"])


def _product(tree: Any, first: Any, second: Any) -> Any:  # noqa: ANN401
    """A node that multiplies two colours; its output."""
    node = tree.nodes.new("ShaderNodeVectorMath")
    node.operation = "MULTIPLY"
    tree.links.new(first, node.inputs[0])
    tree.links.new(second, node.inputs[1])
    return node.outputs["Vector"]


def _texture(bpy: Any, picture: NDArray[np.uint8]) -> Any:  # noqa: ANN401
    """An image of Blender; its rows go up."""
    height, width = picture.shape[:2]
    image = bpy.data.images.new("texture", width, height, alpha=False)
    image.colorspace_settings.name = "sRGB"
    values = np.ones((height, width, 4), dtype=np.float32)
    values[..., :3] = picture[::-1] / np.float32(255)
    image.pixels.foreach_set(values.ravel())
    image.pack()  # else a render may look for a file
    return image


def _ray_length_material(bpy: Any) -> Any:  # noqa: ANN401
    """A surface that shines with its distance from the camera, along the ray."""
    made = bpy.data.materials.new("ray length")
    made.use_nodes = True
    tree = made.node_tree
    tree.nodes.clear()
    distance = tree.nodes.new("ShaderNodeCameraData").outputs["View Distance"]
    shine = tree.nodes.new("ShaderNodeEmission")
    tree.links.new(distance, shine.inputs["Strength"])
    out = tree.nodes.new("ShaderNodeOutputMaterial")
    tree.links.new(shine.outputs[0], out.inputs["Surface"])
    return made
