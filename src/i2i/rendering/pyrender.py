"""The paper's renderer for gray images: OpenGL through pyrender, without a display."""

from __future__ import annotations

import os
from importlib.metadata import PackageNotFoundError
from importlib.metadata import version as package_version
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from i2i.errors import RendererUnavailableError
from i2i.geometry.cameras import Camera
from i2i.rendering.base import CHANNELS, Renderer
from i2i.rendering.mesh import RenderMesh
from i2i.rendering.opengl import choose_platform
from i2i.rendering.shading import (
    COLOR_LIGHT,
    GRAY_LIGHT,
    METALLIC,
    ROUGHNESS,
    corner_normals,
    linear_from_srgb,
)
from i2i.rendering.visuals import Material

_SHADING_VERSION = 1
_CLIP_MARGIN = 1.01  # the clipping planes stay clear of the surface


class PyrenderRenderer(Renderer):
    """Rasterises with the same light, material and normals as `EmbreeRenderer`.

    Gray and rgb edges are smoothed by 4 samples (EGL only); depth is taken at pixel centres.

    Args of the environment: PYOPENGL_PLATFORM ("egl" or "osmesa") overrides the choice of library,
    EGL_DEVICE_ID the choice of device.
    """

    name: ClassVar[str] = "pyrender"

    def __init__(self) -> None:
        self._platform = choose_platform()
        self._context: Any = None
        self._mesh: RenderMesh | None = None
        self._scenes: dict[str, Any] = {}

    @property
    def version(self) -> str:
        """Versions of pyrender and of the shading, and the OpenGL platform."""
        release = package_version("pyrender")
        return f"pyrender {release} on {self._platform}, shading {_SHADING_VERSION}"

    @classmethod
    def available(cls) -> None:
        """Return if pyrender and an off-screen OpenGL library are here.

        Raises:
            RendererUnavailableError: with the Debian packages to install.
        """
        try:
            package_version("pyrender")
        except PackageNotFoundError as error:
            raise RendererUnavailableError(
                "the renderer 'pyrender' needs the package pyrender; type: pip install pyrender, "
                "or use the default: renderer=embree"
            ) from error
        choose_platform()

    def close(self) -> None:
        """Free the OpenGL context; the next call makes a new one."""
        if self._context is not None:
            self._context.delete()
        self._context, self._mesh, self._scenes = None, None, {}

    def _ray_lengths(
        self, mesh: RenderMesh, rotations: NDArray[np.float64], camera: Camera, image_size: int
    ) -> NDArray[np.float32]:
        from pyrender.constants import RenderFlags

        scene = self._scene(mesh, "gray", camera)
        context = self._context_of(image_size)
        # Segmentation mode switches multisampling off: depth of the pixel centre, not of a sample.
        flags = RenderFlags.DEPTH_ONLY | RenderFlags.SEG
        nodes = {node: 255 for node in scene.mesh_nodes}
        # z to ray length; the cosine between a ray and the axis is -z of its unit direction
        stretch = (-1.0 / camera.rays(image_size)[..., 2]).astype(np.float32)
        depth = np.empty((len(rotations), image_size, image_size), dtype=np.float32)
        for view, rotation in enumerate(rotations):
            _aim(scene, rotation, camera)
            depth[view] = context.render(scene, flags=flags, seg_node_map=nodes) * stretch
        return depth

    def _colors(
        self,
        mesh: RenderMesh,
        rotations: NDArray[np.float64],
        camera: Camera,
        image_size: int,
        modality: str,
    ) -> NDArray[np.uint8]:
        scene = self._scene(mesh, modality, camera)
        context = self._context_of(image_size)
        channels = CHANNELS[modality]
        images = np.empty((len(rotations), channels, image_size, image_size), dtype=np.uint8)
        for view, rotation in enumerate(rotations):
            _aim(scene, rotation, camera)
            color, _ = context.render(scene)
            # White under white light: the mean of the three equal channels is any one of them.
            images[view] = color.transpose(2, 0, 1)[:channels]
        return images

    def _context_of(self, image_size: int) -> Any:  # noqa: ANN401 - pyrender has no types
        """The one OpenGL context, set to a picture size."""
        if self._context is None:
            self._context = _new_context(image_size, self._platform)
        self._context.viewport_width = image_size
        self._context.viewport_height = image_size
        return self._context

    def _scene(self, mesh: RenderMesh, modality: str, camera: Camera) -> Any:  # noqa: ANN401
        """The pyrender scene of a mesh; those of the last mesh are kept."""
        if self._mesh is not mesh:
            self._mesh, self._scenes = mesh, {}
        key = f"{modality} {camera}"
        if key not in self._scenes:
            self._scenes[key] = _new_scene(mesh, modality, camera)
        return self._scenes[key]


def _new_context(image_size: int, platform: str) -> Any:  # noqa: ANN401
    """A pyrender off-screen context; RendererUnavailableError if OpenGL refuses."""
    os.environ["PYOPENGL_PLATFORM"] = platform  # pyrender reads it when it is imported
    try:
        import pyrender

        return pyrender.OffscreenRenderer(image_size, image_size)
    # OpenGL bindings raise what they like: ImportError, AttributeError, AssertionError, GLError.
    except Exception as error:
        raise RendererUnavailableError(
            f"OpenGL on the platform {platform!r} gave no off-screen context "
            f"({type(error).__name__}: {error}); set PYOPENGL_PLATFORM=osmesa (Debian package "
            "libosmesa6) or =egl (libegl1 libgl1-mesa-dri), or use renderer=embree"
        ) from error


def _new_scene(mesh: RenderMesh, modality: str, camera: Camera) -> Any:  # noqa: ANN401
    """The mesh, a camera and a light that sits on it."""
    import pyrender

    scene = pyrender.Scene(bg_color=[1.0, 1.0, 1.0, 1.0], ambient_light=[0.0, 0.0, 0.0])
    scene.add(pyrender.Mesh(primitives=_primitives(mesh, painted=modality == "rgb")))
    reach = mesh.bounding_radius * _CLIP_MARGIN
    lens = pyrender.PerspectiveCamera(
        yfov=np.radians(camera.fov_deg),
        aspectRatio=1.0,
        znear=max(camera.distance - reach, 0.01),
        zfar=camera.distance + reach,
    )
    scene.main_camera_node = scene.add(lens)
    intensity = COLOR_LIGHT if modality == "rgb" else GRAY_LIGHT
    scene.add(
        pyrender.PointLight(color=[1.0, 1.0, 1.0], intensity=intensity),
        parent_node=scene.main_camera_node,
    )
    return scene


def _aim(scene: Any, rotation: NDArray[np.float64], camera: Camera) -> None:  # noqa: ANN401
    """Put the camera where it sees the object under `rotation` (object to camera)."""
    pose = np.eye(4)
    pose[:3, :3] = rotation.T
    pose[:3, 3] = rotation.T @ np.array([0.0, 0.0, camera.distance])
    scene.set_pose(scene.main_camera_node, pose)


def _primitives(mesh: RenderMesh, *, painted: bool) -> list[Any]:
    """One pyrender primitive for each material in use, each face in both windings.

    The shader does not turn normals towards the viewer, and a material that is called double sided
    shows black backs. With every face twice, once for each side with its own normal, and back faces
    culled, both sides are lit alike whatever the winding in the file.
    """
    normals = corner_normals(mesh.vertices, mesh.faces)
    group = mesh.face_material if painted else np.zeros(len(mesh.faces), dtype=np.int64)
    return [
        _primitive(
            mesh,
            np.flatnonzero(group == index),
            normals,
            mesh.materials[index] if painted else None,
        )
        for index in np.unique(group)
    ]


def _primitive(
    mesh: RenderMesh,
    chosen: NDArray[np.int64],
    normals: NDArray[np.float64],
    material: Material | None,
) -> Any:  # noqa: ANN401
    """Some faces with one material; None is the paper's white."""
    import pyrender

    def both(values: NDArray[np.generic], sign: float = 1.0) -> NDArray[np.float32]:
        front = values[chosen].astype(np.float32)
        sides = np.concatenate([front, sign * front[:, ::-1]])
        return sides.reshape(-1, values.shape[-1])

    color, texture, uv = np.ones(3), None, None
    tint = None
    if material is not None:
        color = linear_from_srgb(material.base_color)
        if mesh.corner_uv is not None and material.texture is not None:
            uv = both(mesh.corner_uv)
            texture = _texture(material.texture)
        if mesh.corner_color is not None:
            tint = both(linear_from_srgb(mesh.corner_color / 255.0))
            tint = np.concatenate([tint, np.ones((len(tint), 1), dtype=np.float32)], axis=1)
    return pyrender.Primitive(
        positions=both(mesh.vertices[mesh.faces]),
        normals=both(normals, -1.0),
        texcoord_0=uv,
        color_0=tint,
        material=pyrender.MetallicRoughnessMaterial(
            baseColorFactor=[*color, 1.0],
            baseColorTexture=texture,
            metallicFactor=METALLIC,
            roughnessFactor=ROUGHNESS,
            alphaMode="OPAQUE",
            doubleSided=False,
        ),
    )


def _texture(picture: NDArray[np.uint8]) -> Any:  # noqa: ANN401
    """A pyrender texture; with four channels, since OpenGL wants rows of whole 4-byte words."""
    import pyrender

    opaque = np.full((*picture.shape[:2], 1), 255, dtype=np.uint8)
    return pyrender.Texture(
        source=np.concatenate([picture, opaque], axis=2), source_channels="RGBA"
    )
