"""Test for self-intersections of a mesh, by a tree of boxes (README)."""

from __future__ import annotations

from typing import no_type_check

import numpy as np
import torch
import warp as wp

from ..runtime.launch import parallel_launch

wp.set_module_options({"enable_backward": False})

# A corner is in the plane of a face with which it shares another corner, if the sine of its
# direction's angle to the plane is below this: float64 tells no side of it.
_FLAT = wp.constant(wp.float64(1e-12))
_PIECES = 64  # of a launch, so that no thread waits long for another


def cuts_itself(vertices: np.ndarray, faces: np.ndarray) -> bool:
    """Return True if two faces of a mesh intersect, as README defines.

    Args:
        vertices: ``[V, 3]``, finite, within 1e37 of the origin; those of one place are one.
        faces: ``[F, 3]`` integers below V; none without area.

    Raises:
        ValueError: a shape is another.
    """
    for name, array in (("vertices", vertices), ("faces", faces)):
        if array.ndim != 2 or array.shape[1] != 3:
            raise ValueError(f"{name} has shape {array.shape}, must be [N, 3]")
    if len(faces) < 2:
        return False
    # The tree's boxes are of float32. A neighbour of a rounded number lies beyond the number.
    rounded = np.asarray(vertices, np.float32)
    below, above = (np.nextafter(rounded, np.float32(end)) for end in (-np.inf, np.inf))
    first, second, third = faces.T
    low = np.minimum(np.minimum(below[first], below[second]), below[third])
    high = np.maximum(np.maximum(above[first], above[second]), above[third])
    low, high = (wp.array(box, dtype=wp.vec3, device="cpu") for box in (low, high))
    tree = wp.Bvh(low, high, constructor="median", leaf_size=4)
    places = wp.array(np.asarray(vertices, np.float64), dtype=wp.vec3d, device="cpu")
    index = wp.array(np.ascontiguousarray(faces, np.int32), dtype=wp.int32, device="cpu")
    found = torch.zeros(1, dtype=torch.int32)
    parallel_launch(_cuts, len(faces), [tree.id, low, high, places, index], [found], pieces=_PIECES)
    return bool(found)


@wp.func
@no_type_check
def _corners(vertices: wp.array[wp.vec3d], faces: wp.array2d[wp.int32], i: int):
    return wp.matrix_from_rows(vertices[faces[i, 0]], vertices[faces[i, 1]], vertices[faces[i, 2]])


@wp.func
@no_type_check
def _normal(t: wp.mat33d):
    return wp.cross(t[1] - t[0], t[2] - t[0])


@wp.func
@no_type_check
def _heights(t: wp.mat33d, origin: wp.vec3d, normal: wp.vec3d):
    """Signed distances of the corners from a plane, times the normal's length."""
    return wp.vec3d(
        wp.dot(normal, t[0] - origin), wp.dot(normal, t[1] - origin), wp.dot(normal, t[2] - origin)
    )


@wp.func
@no_type_check
def _apart(t: wp.mat33d, other: wp.mat33d, normal: wp.vec3d):
    """Tells if an edge of a triangle parts it from another one of its plane."""
    for k in range(3):
        across = wp.cross(normal, t[(k + 1) % 3] - t[k])  # points into t
        if wp.max(_heights(other, t[k], across)) < wp.float64(0.0):
            return True
    return False


@wp.func
@no_type_check
def _span(t: wp.mat33d, heights: wp.vec3d, along: wp.vec3d):
    """Ends, along a line, of the part of a triangle in the plane that its heights are of."""
    low = wp.float64(wp.inf)
    high = -low
    for k in range(3):
        j = (k + 1) % 3
        at = wp.dot(t[k], along)
        if heights[k] * heights[j] < wp.float64(0.0):
            at += (wp.dot(t[j], along) - at) * heights[k] / (heights[k] - heights[j])
        elif heights[k] != wp.float64(0.0):
            continue
        low = wp.min(low, at)
        high = wp.max(high, at)
    return wp.vec2d(low, high)


@wp.func
@no_type_check
def _meet(a: wp.mat33d, b: wp.mat33d):
    """Return True if two triangles have a point in common (Möller 1997)."""
    zero = wp.float64(0.0)
    of_a = _normal(a)
    heights_b = _heights(b, a[0], of_a)
    if wp.min(heights_b) > zero or wp.max(heights_b) < zero:
        return False
    of_b = _normal(b)
    heights_a = _heights(a, b[0], of_b)
    if wp.min(heights_a) > zero or wp.max(heights_a) < zero:
        return False
    if heights_b == wp.vec3d() or heights_a == wp.vec3d():
        return not (_apart(a, b, of_a) or _apart(b, a, of_b))
    along = wp.cross(of_a, of_b)
    span_a = _span(a, heights_a, along)
    span_b = _span(b, heights_b, along)
    return span_a[0] <= span_b[1] and span_b[0] <= span_a[1]


@wp.func
@no_type_check
def _cross_behind(a1: wp.vec3d, a2: wp.vec3d, b1: wp.vec3d, b2: wp.vec3d):
    """Return True if two triangles with a corner at the origin have a ray from it in common.

    Within both angles, not along an edge; triangles of one plane have none.
    """
    of_a = wp.cross(a1, a2)
    of_b = wp.cross(b1, b2)
    at_a1 = wp.dot(of_b, a1)
    at_a2 = wp.dot(of_b, a2)
    at_b1 = wp.dot(of_a, b1)
    at_b2 = wp.dot(of_a, b2)
    if at_a1 * at_a2 >= wp.float64(0.0) or at_b1 * at_b2 >= wp.float64(0.0):
        return False
    least_a = _FLAT * wp.length(of_b)
    least_b = _FLAT * wp.length(of_a)
    if wp.abs(at_a1) < least_a * wp.length(a1) or wp.abs(at_a2) < least_a * wp.length(a2):
        return False
    if wp.abs(at_b1) < least_b * wp.length(b1) or wp.abs(at_b2) < least_b * wp.length(b2):
        return False
    ray_a = a1 * wp.abs(at_a2) + a2 * wp.abs(at_a1)
    ray_b = b1 * wp.abs(at_b2) + b2 * wp.abs(at_b1)
    return wp.dot(ray_a, ray_b) > wp.float64(0.0)


@wp.kernel
@no_type_check
def _cuts(
    offset: wp.int32,
    tree: wp.uint64,
    low_in: wp.array[wp.vec3],
    high_in: wp.array[wp.vec3],
    vertices_in: wp.array[wp.vec3d],
    faces_in: wp.array2d[wp.int32],
    found_out: wp.array[wp.int32],
):
    i = offset + wp.tid()
    if found_out[0] != 0:
        return
    a = _corners(vertices_in, faces_in, i)
    query = wp.bvh_query_aabb(tree, low_in[i], high_in[i])
    j = wp.int32(0)
    while wp.bvh_query_next(query, j):
        if j <= i:
            continue
        shared = wp.int32(0)
        of_a = wp.int32(0)
        of_b = wp.int32(0)
        for k in range(3):
            for m in range(3):
                if faces_in[i, k] == faces_in[j, m]:
                    shared += 1
                    of_a = k
                    of_b = m
        if shared > 1:
            continue  # neighbours along an edge; repeated faces have a flag of their own
        b = _corners(vertices_in, faces_in, j)
        if shared == 0:
            if not _meet(a, b):
                continue
        else:
            p = a[of_a]
            a1 = a[(of_a + 1) % 3] - p
            a2 = a[(of_a + 2) % 3] - p
            if not _cross_behind(a1, a2, b[(of_b + 1) % 3] - p, b[(of_b + 2) % 3] - p):
                continue
        found_out[0] = 1  # whichever thread writes it, it is the same
        return
