"""How far points are from a mesh, without the project's own geometry."""

import numpy as np
import trimesh


def distance_to(mesh, points):
    """Distance of each point (P, 3) to the nearest triangle, by comparing with all."""
    triangles, best = mesh.vertices[mesh.faces], np.full(len(points), np.inf)
    centre = triangles.mean(axis=1)
    radius = np.linalg.norm(triangles - centre[:, None], axis=2).max(axis=1)
    for number, point in enumerate(points):
        # Only triangles whose ball is near enough can be the nearest.
        away = np.linalg.norm(centre - point, axis=1)
        near = triangles[away - radius <= (away + radius).min()]
        found = trimesh.triangles.closest_point(near, np.broadcast_to(point, (len(near), 3)))
        best[number] = np.linalg.norm(found - point, axis=1).min()
    return best
