"""The steps inside the network: the icosahedron, the projection onto it, the dynamic filter."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d.art3d import Line3DCollection

from i2i.geometry.icosahedron import Icosahedron
from i2i.viz.style import (
    BLUE,
    HEAT,
    INK,
    ORANGE,
    VERMILION,
    ImageArray,
    new_figure,
    show_image,
    to_numpy,
)


def icosahedron_figure(mesh: Icosahedron, *, heading: str = "") -> Figure:
    """The mesh in space and as the camera sees it, its visible half numbered.

    Args:
        mesh: From `i2i.geometry.icosahedron.icosahedron`.
        heading: Text above the figure.

    Returns:
        The figure.
    """
    vertices, visible = to_numpy(mesh.vertices), to_numpy(mesh.visible)
    figure = new_figure(9.0, 4.2)
    if heading:
        figure.suptitle(heading, fontsize=11, color=INK)
    space = figure.add_subplot(1, 2, 1, projection="3d")
    edges = _edges(mesh)
    space.add_collection3d(Line3DCollection(vertices[edges], colors="0.75", linewidths=0.8))
    hidden = np.setdiff1d(np.arange(len(vertices)), visible)
    for members, color, label in ((visible, BLUE, "visible"), (hidden, ORANGE, "hidden")):
        space.scatter(*vertices[members].T, color=color, s=22, depthshade=False,
                      label=f"{len(members)} {label} vertices")  # fmt: skip
    limit = (-0.75, 0.75)
    space.set(xlabel="x (right)", ylabel="y (up)", zlabel="z (to the camera)", xlim=limit,
              ylim=limit, zlim=limit, xticks=[-0.5, 0, 0.5], yticks=[-0.5, 0, 0.5],
              zticks=[-0.5, 0, 0.5])  # fmt: skip
    space.set_box_aspect((1, 1, 1))
    space.tick_params(labelsize=7)
    space.view_init(elev=25, azim=-60)
    space.legend(fontsize=8, loc="upper left", frameon=False)
    flat = figure.add_subplot(1, 2, 2)
    draw_half_mesh(flat, mesh, labels=[str(index) for index in visible])
    flat.set_title("as the camera sees it", fontsize=9)
    return figure


def projection_figure(
    image: ImageArray,
    *,
    feature_map: ImageArray,
    positions: ImageArray,
    signal: ImageArray,
    mesh: Icosahedron,
    heading: str = "",
) -> Figure:
    """From the image over the encoder's map to the signal on the visible vertices.

    Args:
        image: Shape (C, H, W), in [0, 1].
        feature_map: Encoder's output, shape (C', S, S); its norm over the channels is drawn.
        positions: Where each visible vertex is sampled, (row, column) in cells of the map with
            cell centres at i + ½, shape (V_half, 2), as `i2i.nn.projectors.sampling_positions`
            gives them.
        signal: Projector's output, shape (V_half, C''); its norm is drawn.
        mesh: The icosahedron.
        heading: Text above the figure.

    Returns:
        The figure.
    """
    norms = np.linalg.norm(to_numpy(feature_map), axis=0)
    spots = to_numpy(positions)[:, ::-1]  # x, y of the plot are column, row
    size = norms.shape[0]
    figure = new_figure(10.5, 3.6)
    if heading:
        figure.suptitle(heading, fontsize=11, color=INK)
    left, middle, right = figure.subplots(1, 3)
    pixels = to_numpy(image)
    show_image(left, pixels, title="image and the projected vertices")
    scale = pixels.shape[-1] / size
    left.plot(*(spots.T * scale - 0.5), ".", color=VERMILION, markersize=7)
    drawn = middle.imshow(norms, cmap=HEAT, extent=(0, size, size, 0), interpolation="nearest")
    middle.plot(
        *spots.T,
        "o",
        markerfacecolor="none",
        markeredgecolor=VERMILION,
        markeredgewidth=1.5,
        markersize=8,
    )
    middle.set(xlabel="column (cells)", ylabel="row (cells)")
    middle.set_title("encoder's map: norm over its channels", fontsize=9)
    figure.colorbar(drawn, ax=middle, shrink=0.8)
    draw_half_mesh(right, mesh, values=np.linalg.norm(to_numpy(signal), axis=-1))
    right.set_title("signal on the visible vertices: norm", fontsize=9)
    return figure


def filter_figure(
    dynamic_filter: ImageArray,
    *,
    mesh: Icosahedron,
    names: Sequence[str] | None = None,
    heading: str = "",
) -> Figure:
    """The filter that the image makes: one half mesh for each output of the group convolution.

    Args:
        dynamic_filter: ψ of one image, shape (V_half, n, m); its norm over n is drawn.
        mesh: The icosahedron.
        names: Titles of the m outputs.
        heading: Text above the figure.

    Returns:
        The figure.
    """
    norms = np.linalg.norm(to_numpy(dynamic_filter), axis=1)  # (V_half, m)
    outputs = norms.shape[1]
    names = [f"output {index}" for index in range(outputs)] if names is None else names
    columns = min(outputs, 4)
    rows = -(-outputs // columns)
    figure = new_figure(2.4 * columns + 0.6, 2.4 * rows + 0.3)
    if heading:
        figure.suptitle(heading, fontsize=11, color=INK)
    norm = Normalize(0.0, max(float(norms.max()), 1e-12))
    grid = figure.subplots(rows, columns, squeeze=False)
    for axes in grid.flat:
        axes.set_axis_off()
    for index, axes in zip(range(outputs), grid.flat, strict=False):
        draw_half_mesh(axes, mesh, values=norms[:, index], norm=norm, compact=True)
        axes.set_title(names[index], fontsize=9)
    figure.colorbar(ScalarMappable(norm, HEAT), ax=grid, label="norm of ψ over n", shrink=0.8)
    return figure


def draw_half_mesh(
    axes: Axes,
    mesh: Icosahedron,
    *,
    values: np.ndarray | None = None,
    norm: Normalize | None = None,
    labels: Sequence[str] | None = None,
    compact: bool = False,
) -> None:
    """Draw the visible vertices as the camera sees them, x right and y up.

    Args:
        axes: Where to.
        mesh: The icosahedron.
        values: Colour of each visible vertex, shape (V_half,).
        norm: Range of the colours; that of the values if None, with a colour bar of its own.
        labels: Text in each vertex.
        compact: Leave out the axes.
    """
    vertices, visible = to_numpy(mesh.vertices), to_numpy(mesh.visible)
    for start, end in _edges(mesh):
        if start in visible and end in visible:
            axes.plot(*vertices[[start, end], :2].T, color="0.8", linewidth=0.8, zorder=1)
    points = vertices[visible, :2]
    own_bar = values is not None and norm is None
    drawn = axes.scatter(
        points[:, 0], points[:, 1], s=60 if compact else 170, zorder=2,
        edgecolor=INK, linewidth=0.5,
        c="white" if values is None else values, cmap=None if values is None else HEAT,
        norm=norm if values is not None else None,
    )  # fmt: skip
    if own_bar and axes.figure is not None:
        axes.figure.colorbar(drawn, ax=axes, shrink=0.8)
    for point, label in zip(points, labels or [], strict=False):
        axes.text(point[0], point[1], label, ha="center", va="center", fontsize=7, color=INK)
    ticks = [-1.0, -0.5, 0.0, 0.5, 1.0]
    axes.set(aspect="equal", xlim=(-1.1, 1.1), ylim=(-1.1, 1.1), xticks=ticks, yticks=ticks)
    if compact:
        axes.set_axis_off()
    else:
        axes.set(xlabel="x (right)", ylabel="y (up)")
        axes.tick_params(labelsize=7)


def _edges(mesh: Icosahedron) -> np.ndarray:
    """Pairs of vertices that share an edge, shape (E, 2)."""
    faces = to_numpy(mesh.faces)
    pairs = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    return np.unique(np.sort(pairs, axis=1), axis=0)
