"""Packed records of an object for the viewer, uploaded to the graphics card unchanged.

One Gaussian has 32 bytes, as in ``.splat``, with more precision: three float32 of the mean, seven
float16 (opacity, colour, scales) and three 16-bit numbers of the rotation. The rotation is the
vector part of the quaternion over 1 + w (modified Rodrigues parameters), which is regular for
w >= 0. Gaussians are sorted by covered area, so that the viewer can skip the last ones in motion.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch

from ..color_spaces import to_display, to_linear
from ..errors import UserError
from ..formats.meshes import TexturedMesh
from ..formats.read import UNKNOWN, rotation_between
from ..gaussians import Gaussians
from ..images import to_uint8

_VISIBLE = 0.05  # opacity from which a Gaussian counts for the object's extent
_MOST = 6e4  # float16 ends at 65504


RECORD = np.dtype(
    [("means", "<f4", 3), ("look", "<f2", 4), ("scales", "<f2", 3), ("turns", "<i2", 3)]
)


class Frame(NamedTuple):
    """The viewer's frame: the object's, moved and scaled.

    Attributes:
        center: ``[3]`` float64, its origin.
        size: its unit of length.
    """

    center: np.ndarray
    size: float


def own_frame(gaussians: Gaussians, name: str) -> Frame:
    """Return a frame that moves an object to the origin, with a longest side of 1.

    Half a percent of the centres at each end of each axis does not count, so that floaters far from
    the object do not shrink it.

    Raises:
        UserError: the object has no extent.
    """
    opacities = gaussians.opacities.detach().cpu().numpy()
    means = gaussians.means.detach().double().cpu().numpy()
    means = means[opacities >= min(_VISIBLE, opacities.max())]
    low, high = np.percentile(means, [0.5, 99.5], axis=0)
    reach = 4 * float(gaussians.scales.detach().double().median())
    size = max(float((high - low).max()), reach)
    if not 0 < size < np.inf:
        raise UserError(f"{name}: all Gaussians are at one point, so there is nothing to look at")
    return Frame((low + high) / 2, size)


def frame_of_mesh(mesh: Any) -> Frame:
    """Return a frame that moves a mesh's bounding box to the origin, with a longest side of 1."""
    low, high = mesh.vertices.min(0), mesh.vertices.max(0)
    return Frame((low + high) / 2, float((high - low).max()))


def visible(gaussians: Gaussians, name: str) -> Gaussians:
    """Return one object's visible Gaussians, sorted by covered area, on the CPU.

    Arguments and errors are those of ``visible_order``.
    """
    order = visible_order(gaussians, name)
    return gaussians.detach().to("cpu", torch.float32).select(order)


def visible_order(gaussians: Gaussians, name: str) -> torch.Tensor:
    """Return the numbers of one object's visible Gaussians, int64, sorted by covered area.

    Args:
        gaussians: ``[N]``.
        name: named in errors.

    Raises:
        UserError: a value is not finite, or nothing can be seen.
        ValueError: there is a batch dimension.
    """
    if gaussians.opacities.dim() != 1:
        raise ValueError(
            f"one object expected, got leading shape {tuple(gaussians.opacities.shape[:-1])}"
        )
    gaussians = gaussians.detach().to("cpu", torch.float32)
    if count := int((~gaussians.is_finite()).sum()):
        raise UserError(f"{name}: {count} of {gaussians.num} Gaussians are not finite")
    seen = gaussians.is_drawn().nonzero()[:, 0]
    if not len(seen):
        raise UserError(f"{name}: no Gaussian has an opacity of 1/255 or more")
    widest = gaussians.scales[seen].sort(-1).values
    cover = gaussians.opacities[seen] * widest[:, 1] * widest[:, 2]
    return seen[cover.argsort(descending=True, stable=True)]


def pack_gaussians(gaussians: Gaussians, frame: Frame) -> tuple[bytes, bytes]:
    """Return the records, and the coefficients of the harmonics.

    Args:
        gaussians: ``[N]``, finite, on the CPU.
        frame: the viewer's frame.

    Returns:
        32 bytes per Gaussian; and float16 ``[N, K * 3]``, each row zero-padded to a multiple of 8
        numbers, or nothing.
    """
    records = np.empty(gaussians.num, RECORD)
    records["means"] = (gaussians.means.double().numpy() - frame.center) / frame.size
    look = torch.cat([gaussians.opacities[:, None], gaussians.colors], 1).numpy()
    records["look"] = look.clip(-_MOST, _MOST)
    records["scales"] = (gaussians.scales.double().numpy() / frame.size).clip(0, _MOST)
    records["turns"] = np.rint(32767 * _rodrigues(gaussians))
    if gaussians.harmonics is None:
        return records.tobytes(), b""
    rows = gaussians.harmonics.reshape(gaussians.num, -1).numpy().clip(-_MOST, _MOST)
    padded = np.zeros((len(rows), -(-rows.shape[1] // 8) * 8), "<f2")
    padded[:, : rows.shape[1]] = rows
    return records.tobytes(), padded.tobytes()


def _rodrigues(gaussians: Gaussians) -> np.ndarray:
    if gaussians.quats is None:
        return np.zeros((gaussians.num, 3))
    quats = gaussians.quats.double().numpy()
    norms = np.linalg.norm(quats, axis=1, keepdims=True)
    quats = np.where(norms > 0, quats / norms.clip(1e-300), [1.0, 0, 0, 0])
    quats = np.where(quats[:, :1] < 0, -quats, quats)  # the same rotation
    return quats[:, 1:] / (1 + quats[:, :1])


class ViewedMesh(NamedTuple):
    """Triangles with coloured corners.

    Attributes:
        vertices: ``[V, 3]`` float64.
        faces: ``[F, 3]`` int64.
        colors: ``[V, 3]`` float32, display values in [0, 1].
    """

    vertices: np.ndarray
    faces: np.ndarray
    colors: np.ndarray


def viewed_mesh(mesh: TexturedMesh, axes: str = "opengl") -> ViewedMesh:
    """Convert a mesh for the viewer, which uses OpenCV's axes (y down).

    A texture is reduced to its colours at the corners.

    Args:
        mesh: as in its file.
        axes: of the mesh; those that ``formats.read.read`` calls unknown are taken for OpenGL's (y
            up), which ``save_mesh`` writes by default.
    """
    turn = rotation_between("opengl" if axes == UNKNOWN else axes, "opencv")
    vertices = mesh.vertices @ turn.T
    paint = (255 * _corner_colors(mesh) + 0.5).astype(np.int64)
    # A vertex with several colours is split.
    keys = mesh.faces << 24 | paint[..., 0] << 16 | paint[..., 1] << 8 | paint[..., 2]
    pairs, corners = np.unique(keys, return_inverse=True)
    colors = np.stack([pairs >> 16 & 255, pairs >> 8 & 255, pairs & 255], 1) / np.float32(255)
    faces = corners.reshape(mesh.faces.shape)
    return ViewedMesh(vertices[pairs >> 24], faces, colors)


def _corner_colors(mesh: TexturedMesh) -> np.ndarray:
    """Return display values ``[F, 3, 3]``: the product of material, texture and vertex colours."""
    light = to_linear(mesh.colors[..., :3].astype(np.float32) / 255)
    for i, material in enumerate(mesh.materials):
        mine = mesh.material_ids == i
        light[mine] *= material.color[:3]
        if material.texture is not None:
            height, width = material.texture.shape[:2]
            u, v = np.moveaxis(mesh.uvs[mine] % 1, -1, 0)
            rows = ((1 - v) * height).astype(int).clip(0, height - 1)
            columns = (u * width).astype(int).clip(0, width - 1)
            light[mine] *= to_linear(material.texture[rows, columns, :3] / np.float32(255))
    return to_display(light.clip(0, 1))


def pack_mesh(mesh: Any, frame: Frame, name: str) -> tuple[bytes, int, int]:
    """Pack a mesh as float32 vertices, their 8-bit RGBA, and 32-bit corners of the faces.

    Args:
        mesh: has ``vertices [V, 3]``, ``faces [F, 3]`` and ``colors [V, 3]`` in [0, 1] or None.
        frame: the viewer's frame.
        name: named in errors.

    Returns:
        The bytes, V and F.

    Raises:
        UserError: a vertex is not finite, faces are missing, or an index is out of range.
    """
    vertices = (np.asarray(mesh.vertices, np.float64) - frame.center) / frame.size
    faces = np.asarray(mesh.faces, np.int64)
    if not len(faces) or not np.isfinite(vertices).all():
        raise UserError(f"{name}: the mesh has no faces, or vertices that are not finite")
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise UserError(f"{name}: a face names vertex {faces.max()} of {len(vertices)}")
    rgba = np.full((len(vertices), 4), 255, np.uint8)
    rgba[:, :3] = 190 if mesh.colors is None else to_uint8(np.asarray(mesh.colors)[:, :3])
    parts = vertices.astype("<f4"), rgba, faces.astype("<u4")
    return b"".join(part.tobytes() for part in parts), len(vertices), len(faces)
