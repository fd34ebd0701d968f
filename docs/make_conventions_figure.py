"""Draw docs/images/conventions.png: frames, raster axes and the numbered half mesh.

Run from the repository root: ``python docs/make_conventions_figure.py``.
"""

from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from mpl_toolkits.mplot3d import Axes3D

from i2i.geometry.cameras import Camera
from i2i.geometry.icosahedron import icosahedron
from i2i.geometry.rotations import axis_rotation

COLOURS = {"x": "#c0392b", "y": "#27864b", "z": "#2459a8"}
INK, PALE, ACCENT = "#222222", "#c8ccd2", "#e08a00"
MAP_SIZE, COVERAGE = 8, 0.9

# A chair-like block figure, object frame, z up, seat facing +x: (lower corner, upper corner).
BLOCKS = (
    ((-0.35, -0.35, -0.1), (0.35, 0.35, 0.0)),
    ((-0.35, -0.35, 0.0), (-0.25, 0.35, 0.6)),
    ((0.25, 0.25, -0.6), (0.35, 0.35, -0.1)),
    ((0.25, -0.35, -0.6), (0.35, -0.25, -0.1)),
    ((-0.35, 0.25, -0.6), (-0.25, 0.35, -0.1)),
    ((-0.35, -0.35, -0.6), (-0.25, -0.25, -0.1)),
)
# A typical picture: the camera stands in front of the object, to one side and a little above it.
ROTATION = (
    axis_rotation("x", 25.0)
    @ axis_rotation("y", -35.0)
    @ axis_rotation("x", -90.0)
    @ axis_rotation("z", -90.0)
).numpy()


def box_edges() -> list[tuple[np.ndarray, np.ndarray]]:
    """Edges of all blocks as pairs of points in the object frame."""
    edges = []
    for low, high in BLOCKS:
        corners = np.array(
            [[(low, high)[b][i] for i, b in enumerate(bits)] for bits in np.ndindex(2, 2, 2)]
        )
        for a in range(8):
            edges += [(corners[a], corners[a | bit]) for bit in (1, 2, 4) if not a & bit]
    return edges


def draw_frame(ax: Axes3D, origin: np.ndarray, axes: np.ndarray, length: float, tag: str) -> None:
    """Three arrows with labels; ``axes`` has the directions in its columns."""
    for i, name in enumerate("xyz"):
        tip = origin + length * axes[:, i]
        ax.plot(*np.stack((origin, tip)).T, color=COLOURS[name], lw=2.2)
        ax.text(
            *(origin + 1.28 * length * axes[:, i]),
            f"{name}$_{{{tag}}}$",
            color=COLOURS[name],
            fontsize=11,
            ha="center",
            va="center",
        )


def draw_scene(ax: Axes3D) -> None:
    """Object and camera in the object frame."""
    view = ROTATION.T
    camera = view @ np.array([0, 0, 3.2])
    for a, b in box_edges():
        ax.plot(*np.stack((a, b)).T, color=INK, lw=0.8)
    draw_frame(ax, np.zeros(3), np.eye(3), 1.0, "obj")
    draw_frame(ax, camera, view, 0.8, "cam")
    reach, half = 1.0, np.tan(np.radians(22.5))
    corners = np.array([[x * half, y * half, -1] for x, y in ((1, 1), (-1, 1), (-1, -1), (1, -1))])
    corners = camera + reach * corners @ view.T
    for corner, following in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        ax.plot(*np.stack((camera, corner)).T, color=PALE, lw=1)
        ax.plot(*np.stack((corner, following)).T, color=PALE, lw=1)
    ax.plot(*np.stack((camera, np.zeros(3))).T, color=INK, lw=0.8, ls=":")
    ax.text(*(0.5 * camera + (0, 0, 0.16)), "3.2", fontsize=9)
    ax.set_box_aspect((1, 1, 1))
    points = np.stack((camera, np.zeros(3)))
    middle = points.mean(0) + 0.1 * view[:, 2]
    for set_limits, m in zip((ax.set_xlim, ax.set_ylim, ax.set_zlim), middle, strict=True):
        set_limits(m - 1.45, m + 1.45)
    ax.view_init(elev=16, azim=-38)
    ax.set_axis_off()
    ax.set_title("Frames\n$x_{cam}$ = rotation · $x_{obj}$,  view = rotationᵀ", fontsize=11)


def draw_picture(ax: Axes) -> None:
    """What the camera sees, with the raster's axes."""
    size = 128
    camera = Camera()
    for a, b in box_edges():
        pixels = camera.project(np.stack((a, b)) @ ROTATION.T, size)
        ax.plot(*pixels.T, color=INK, lw=0.8)
    origin = np.zeros(3)
    for i, name in enumerate("xyz"):
        line = camera.project(np.stack((origin, 0.85 * np.eye(3)[i])) @ ROTATION.T, size)
        ax.annotate(
            "", line[1], line[0], arrowprops={"arrowstyle": "->", "color": COLOURS[name], "lw": 2}
        )
        tip = line[0] + 1.16 * (line[1] - line[0])
        ax.text(*tip, f"{name}$_{{obj}}$", color=COLOURS[name], ha="center", va="center")
    angle = np.linspace(0, 2 * np.pi, 200)
    radius = camera.ball_radius() * size / 2
    ax.plot(64 + radius * np.cos(angle), 64 + radius * np.sin(angle), color=PALE, lw=1, ls="--")
    ax.text(64, 64 - radius - 3, "unit ball, 79 %", color="#7a808a", ha="center", fontsize=8)
    raster_axes(ax, size)
    ax.set_title("Picture, 128 × 128\ncolumn right (+x), row down (−y)", fontsize=11)


def raster_axes(ax: Axes, size: int) -> None:
    """Frame of a raster with its two axes outside."""
    ax.set_xlim(0, size)
    ax.set_ylim(size, 0)
    ax.set_aspect("equal")
    ax.xaxis.tick_top()
    ax.set_xticks([0, size / 2, size])
    ax.set_yticks([0, size / 2, size])
    ax.tick_params(labelsize=8)
    ax.set_xlabel("column →", fontsize=9)
    ax.set_ylabel("← row", fontsize=9)


def draw_half_mesh(ax: Axes) -> None:
    """The 16 visible vertices over the cells of the feature map."""
    mesh = icosahedron(1)
    centre, half = MAP_SIZE / 2, MAP_SIZE / 2 * COVERAGE
    for i in range(MAP_SIZE + 1):
        ax.axhline(i, color=PALE, lw=0.7)
        ax.axvline(i, color=PALE, lw=0.7)
    angle = np.linspace(0, 2 * np.pi, 200)
    ax.plot(
        centre + half * np.cos(angle), centre + half * np.sin(angle), color=INK, lw=0.9, ls="--"
    )
    visible = mesh.visible.tolist()
    pixel = {
        v: (centre + half * a, centre - half * b)
        for v, (a, b) in zip(visible, mesh.visible_xy.tolist(), strict=True)
    }
    edges = {tuple(sorted((f[i], f[i - 1]))) for f in mesh.faces.tolist() for i in range(3)}
    for a, b in edges:
        if a in pixel and b in pixel:
            ax.plot(*zip(pixel[a], pixel[b], strict=True), color="#8d949e", lw=0.8, zorder=1)
    for v, (column, row) in pixel.items():
        corner = v < 12
        ax.scatter(
            column,
            row,
            s=210,
            color=ACCENT if corner else "white",
            edgecolors=INK,
            linewidths=1.0,
            zorder=3,
        )
        ax.text(column, row, str(v), ha="center", va="center", fontsize=8, zorder=4)
    raster_axes(ax, MAP_SIZE)
    ax.set_title("Half mesh on the 8 × 8 map\ncorners filled, midpoints open", fontsize=11)


def main() -> None:
    """Write the picture beside this file."""
    figure = plt.figure(figsize=(13, 4.9), dpi=110)
    draw_scene(figure.add_subplot(1, 3, 1, projection="3d"))
    draw_picture(figure.add_subplot(1, 3, 2))
    draw_half_mesh(figure.add_subplot(1, 3, 3))
    figure.tight_layout(w_pad=2.5)
    path = Path(__file__).parent / "images" / "conventions.png"
    path.parent.mkdir(exist_ok=True)
    figure.savefig(path, metadata={"Software": None})
    print(f"wrote {path}")


if __name__ == "__main__":
    main()
