"""Point clouds: farthest points, neighbours, grid cells, sampling of surfaces.

Dense clouds are (B, N, 3). Stacked clouds of different sizes are (N, 3) with the number of the
cloud of each point beside them. Indices carry no gradient. No library with a wheel for this torch
has these for batches of tensors; fpsample's order is not that of the definition.
"""

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor

_CHUNK = 2048  # queries compared with all points at a time, where there is no tree
_SMALLEST_NORM = 1e-12  # a cloud below it is one point, and has no size to divide by


def farthest_point_sample(points: Tensor, count: int, *, start: Tensor | None = None) -> Tensor:
    """Pick points one after the other, each the farthest from those picked before.

    No point is picked twice, duplicates excepted. Of equally far points the first is picked; where
    distances are distinct, the picked points do not depend on the order of the cloud.

    Args:
        points: Shape (B, N, 3).
        count: How many to pick, 1 to N.
        start: Index of the first pick of each cloud, shape (B,); by default the point farthest from
            the cloud's mean.

    Returns:
        Indices in the order of picking, shape (B, count), int64.

    Raises:
        ValueError: If a shape, the count or a start is impossible.
    """
    _check_dense(points, "farthest_point_sample")
    batch, size = points.shape[:2]
    if not 1 <= count <= size:
        raise ValueError(f"cannot pick {count} of {size} points: count must be 1 to {size}")
    points = points.detach()
    points = points if points.dtype in (torch.float32, torch.float64) else points.float()
    if start is None:
        # The mean of float32 depends on the order of the points; that of float64 hardly does.
        wide = points.double() if points.device.type != "mps" else points
        start = (wide - wide.mean(dim=1, keepdim=True)).square().sum(dim=2).argmax(dim=1)
    elif start.shape != (batch,) or bool(((start < 0) | (start >= size)).any()):
        raise ValueError(f"start must hold {batch} indices below {size}, got {start.tolist()}")
    start = start.to(points.device)
    if points.device.type == "cpu":  # numpy's loop has half the overhead of torch's
        return torch.from_numpy(_farthest_numpy(points.numpy(), count, start.numpy()))
    return _farthest_torch(points, count, start)


def _farthest_numpy(
    points: NDArray[np.floating], count: int, start: NDArray[np.int64]
) -> NDArray[np.int64]:
    """The loop of `farthest_point_sample`, by numpy: (B, N, 3) -> (B, count)."""
    planes = np.ascontiguousarray(points.transpose(2, 0, 1))  # (3, B, N)
    batch, size = planes.shape[1:]
    flat, base = planes.reshape(3, -1), np.arange(batch) * size
    nearest = np.full((batch, size), np.inf, planes.dtype)  # squared distance to what was picked
    flat_nearest = nearest.reshape(-1)
    offset, distance = np.empty_like(planes), np.empty_like(nearest)
    picked, last = np.empty((batch, count), np.int64), start
    for step in range(count):
        picked[:, step] = last
        place = last + base
        np.subtract(planes, flat[:, place, None], out=offset)
        np.multiply(offset, offset, out=offset)
        np.add(offset[0], offset[1], out=distance)
        np.add(distance, offset[2], out=distance)
        np.minimum(nearest, distance, out=nearest)
        flat_nearest[place] = -1  # below a duplicate's 0
        last = nearest.argmax(axis=1)
    return picked


def _farthest_torch(points: Tensor, count: int, start: Tensor) -> Tensor:
    """The loop of `farthest_point_sample`, on the device of the points."""
    batch, size = points.shape[:2]
    rows = torch.arange(batch, device=points.device)
    nearest = points.new_full((batch, size), torch.inf)
    picked, last = start.new_empty(batch, count), start
    for step in range(count):
        picked[:, step] = last
        x, y, z = (points - points[rows, last][:, None]).square().unbind(dim=2)
        nearest = torch.minimum(nearest, x + y + z)
        nearest[rows, last] = -1
        last = nearest.argmax(dim=1)
    return picked


def ball_query(
    centres: Tensor, points: Tensor, *, radius: float, count: int, nearest: bool = False
) -> Tensor:
    """Points within a ball around each centre: the first in the order of the cloud, or the nearest.

    Where a ball holds more than `count` points, the first ones depend on the order of the cloud;
    the nearest ones do not, and come nearest first.

    Args:
        centres: Shape (B, M, 3).
        points: Shape (B, N, 3).
        radius: Of the ball; a point at exactly this distance is outside.
        count: How many indices each centre gets. Fewer points in the ball are repeated cyclically;
            an empty ball gives the point nearest to the centre.
        nearest: Which are taken.

    Returns:
        Indices into `points`, shape (B, M, count), int64.

    Raises:
        ValueError: If a shape, the radius or the count is impossible.
    """
    _check_dense(centres, "ball_query")
    _check_dense(points, "ball_query")
    if len(centres) != len(points):
        raise ValueError(f"centres of {len(centres)} clouds, points of {len(points)}")
    _check_ball(radius, count)
    distance = _distances(centres.detach(), points.detach())  # (B, M, N)
    inside = distance < radius
    found = inside.sum(dim=-1)
    slot = torch.arange(count, device=points.device) % found.clamp(min=1)[..., None]
    if nearest:
        candidates = distance.topk(min(count, points.shape[1]), dim=-1, largest=False).indices
        return candidates.gather(-1, slot)
    members = inside.nonzero()[:, -1]  # of all balls, one after the other
    if len(members) == 0:
        return distance.argmin(dim=-1)[..., None].expand(*found.shape, count).clone()
    first = found.flatten().cumsum(0).view_as(found) - found
    index = members[(first[..., None] + slot).clamp(max=len(members) - 1)]
    empty = found == 0
    if bool(empty.any()):
        index[empty] = distance[empty].argmin(dim=-1)[:, None]
    return index


def gather_points(values: Tensor, index: Tensor) -> Tensor:
    """Values of the indexed points of each cloud.

    Args:
        values: Shape (B, N, C...).
        index: Shape (B, ...).

    Returns:
        Shape (B, ..., C...): the shape of the index, then that of a value.
    """
    batch, size = values.shape[:2]
    first = torch.arange(batch, device=index.device).view(batch, *[1] * (index.ndim - 1)) * size
    # Twice as fast on a CPU, forward and backward, as indexing by two tensors.
    rows = values.flatten(0, 1).index_select(0, (index + first).flatten())
    return rows.view(*index.shape, *values.shape[2:])


def grid_subsample(points: Tensor, batch: Tensor, cell: float) -> tuple[Tensor, Tensor]:
    """One point, the mean, for each occupied cell of a cubic grid laid over each cloud.

    The grid starts at the cloud's smallest coordinates, so it moves with the cloud. The order of
    the result is that of the cells: it does not depend on the order of the points.

    Args:
        points: Stacked clouds, shape (N, 3).
        batch: Number of the cloud of each point, from 0, shape (N,).
        cell: Side of a cell.

    Returns:
        Means, shape (M, 3), and the numbers of their clouds in rising order, shape (M,).

    Raises:
        ValueError: If there are no points, a shape is wrong, or the cell is not positive or is
            far too small.
    """
    _check_stacked(points, batch, "grid_subsample")
    if not cell > 0:
        raise ValueError(f"cell={cell} is not possible: give the side of a cell, such as 0.02")
    if len(points) == 0:
        raise ValueError("grid_subsample got no points")
    clouds = int(batch.max()) + 1
    wide = points if points.device.type == "mps" else points.double()
    corner = wide.new_full((clouds, 3), torch.inf)
    corner = corner.scatter_reduce(0, batch[:, None].expand(-1, 3), wide, "amin")
    place = ((wide - corner[batch]) / cell).floor().long()  # from 0
    extent = place.amax(dim=0) + 1
    if clouds * float(extent.double().prod()) > 2**62:
        raise ValueError(f"cell={cell} is too small for clouds of this size")
    key = ((batch * extent[0] + place[:, 0]) * extent[1] + place[:, 1]) * extent[2] + place[:, 2]
    cells, inverse, members = torch.unique(key, return_inverse=True, return_counts=True)
    total = wide.new_zeros(len(cells), 3).index_add(0, inverse, wide)
    return (total / members[:, None]).to(points.dtype), cells // extent.prod()


def radius_neighbours(
    queries: Tensor,
    query_batch: Tensor,
    points: Tensor,
    point_batch: Tensor,
    *,
    radius: float,
    limit: int,
) -> Tensor:
    """The nearest points within a radius of each query, of the query's own cloud.

    Args:
        queries: Stacked clouds, shape (M, 3), in the order of their numbers.
        query_batch: Their numbers, shape (M,).
        points: Stacked clouds, shape (N, 3), in the order of their numbers.
        point_batch: Their numbers, shape (N,).
        radius: A point at exactly this distance is outside.
        limit: How many to give at most.

    Returns:
        Indices into `points`, the nearest first, N in place of missing ones: shape (M, limit),
        int64.

    Raises:
        ValueError: If a shape, an order, the radius or the limit is impossible.
    """
    _check_stacked(queries, query_batch, "radius_neighbours")
    _check_stacked(points, point_batch, "radius_neighbours")
    _check_ball(radius, limit)
    clouds = 1 + max([int(b.max()) for b in (query_batch, point_batch) if len(b)], default=-1)
    search = _nearest_tree if points.device.type == "cpu" else _nearest_torch
    out = query_batch.new_full((len(queries), limit), len(points))
    for query_part, point_part in zip(
        _parts(query_batch, clouds), _parts(point_batch, clouds), strict=True
    ):
        members = points[point_part].detach()
        if not len(members) or query_part.start == query_part.stop:
            continue
        local = search(queries[query_part].detach(), members, radius, limit)
        missing = local == len(members)
        out[query_part] = torch.where(missing, len(points), local + point_part.start)
    return out


def _parts(batch: Tensor, clouds: int) -> list[slice]:
    """Where each cloud lies in a stack."""
    if bool((batch.diff() < 0).any()):
        raise ValueError("radius_neighbours wants each cloud in one piece, in rising order")
    ends = batch.bincount(minlength=clouds).cumsum(0).tolist()
    return [slice(a, b) for a, b in zip([0, *ends[:-1]], ends, strict=True)]


def _nearest_tree(queries: Tensor, points: Tensor, radius: float, limit: int) -> Tensor:
    """Indices (M, limit) by a k-d tree; N where there is none."""
    tree = cKDTree(points.double().numpy())
    _, index = tree.query(queries.double().numpy(), k=limit, distance_upper_bound=radius)
    return torch.from_numpy(np.asarray(index, np.int64).reshape(len(queries), limit))


def _nearest_torch(queries: Tensor, points: Tensor, radius: float, limit: int) -> Tensor:
    """Indices (M, limit) by comparing all with all; N where there is none."""
    found = min(limit, len(points))
    parts = []
    for part in queries.split(_CHUNK):
        distance, index = _distances(part, points).topk(found, largest=False)
        index = torch.where(distance < radius, index, len(points))
        parts.append(torch.nn.functional.pad(index, (0, limit - found), value=len(points)))
    return torch.cat(parts)


def normalize_points(points: Tensor) -> Tensor:
    """Clouds (B, N, 3) with the mean at 0 and the largest norm 1; a single point becomes 0."""
    _check_dense(points, "normalize_points")
    centred = points - points.mean(dim=1, keepdim=True)
    size = centred.norm(dim=2).amax(dim=1)[:, None, None]
    return torch.where(size > _SMALLEST_NORM, centred / size.clamp(min=_SMALLEST_NORM), 0.0)


def sample_surface(
    vertices: NDArray[np.floating], faces: NDArray[np.integer], uniforms: NDArray[np.floating]
) -> NDArray[np.float64]:
    """Points spread evenly over the area of a mesh.

    Args:
        vertices: Shape (V, 3).
        faces: Indices of the corners of triangles, shape (F, 3).
        uniforms: Three numbers in [0, 1) for each point, shape (P, 3): one for the face, two for
            the place in it.

    Returns:
        Shape (P, 3).

    Raises:
        ValueError: If the mesh has no area or a number is outside [0, 1).
    """
    if not bool(((uniforms >= 0) & (uniforms < 1)).all()):
        raise ValueError("sample_surface wants numbers in [0, 1)")
    corners = np.asarray(vertices, np.float64)[faces]  # (F, 3, 3)
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    share = np.linalg.norm(np.cross(b - a, c - a), axis=1).cumsum()
    if not len(share) or not 0 < share[-1] < np.inf:
        raise ValueError("the mesh has no area to sample points from")
    last = int(np.searchsorted(share, share[-1]))  # the last face with an area
    face = np.minimum(np.searchsorted(share, uniforms[:, 0] * share[-1], side="right"), last)
    root, v = np.sqrt(uniforms[:, 1:2]), uniforms[:, 2:3]
    # The root makes the density even: towards corner `a` the triangle gets narrower.
    return (1 - root) * a[face] + root * (1 - v) * b[face] + root * v * c[face]


def _distances(a: Tensor, b: Tensor) -> Tensor:
    """Distances (..., M, N) without the cancellation of the matrix product's short cut."""
    return torch.cdist(a, b, compute_mode="donot_use_mm_for_euclid_dist")


def _check_dense(points: Tensor, name: str) -> None:
    if points.ndim != 3 or points.shape[2] != 3 or points.shape[1] == 0:
        raise ValueError(f"{name} wants clouds of shape (B, N, 3), got {tuple(points.shape)}")


def _check_stacked(points: Tensor, batch: Tensor, name: str) -> None:
    if points.ndim != 2 or points.shape[1] != 3 or batch.shape != points.shape[:1]:
        raise ValueError(
            f"{name} wants points (N, 3) and the numbers (N,) of their clouds, got "
            f"{tuple(points.shape)} and {tuple(batch.shape)}"
        )


def _check_ball(radius: float, count: int) -> None:
    if not radius > 0 or count < 1:
        raise ValueError(f"radius={radius}, count={count}: both must be positive")
