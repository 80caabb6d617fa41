"""A small ray caster for textured meshes; Open3D finds the hits, and numpy shades them."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from PIL import Image

from gamba_warp.formats.materials import to_display, to_linear
from gamba_warp.formats.meshes import TexturedMesh
from gamba_warp.versions import import_open3d

SAMPLES = 3  # rays along each side of a pixel; odd, so that one goes through the pixel's centre
LAYERS = 8  # number of surfaces that a ray may pass through
STEP = 1e-4  # object units behind a transparent surface at which its ray goes on
GLOSS = 0.02  # share that even a black surface reflects, so that its shape shows
OPAQUE = 0.02  # transmittance below which a ray ends
# What the lights of an object are drawn from: height of the key light in degrees, its strength,
# that of the ambient light, and the tint of both lights.
USUAL = {"height": (25, 70), "key": (0.5, 0.85), "ambient": (0.4, 0.6), "tint": (0.92, 1.0)}
VARIED = {"height": (0, 90), "key": (0.3, 1.1), "ambient": (0.2, 0.7), "tint": (0.75, 1.0)}

_TO_LINEAR = to_linear(np.arange(256) / 255.0)


@dataclass
class Lights:
    """The light of one object, the same for all its views, in its own frame.

    Attributes:
        ambient: light from above, ``[3]``; half of it comes from below.
        directions: unit vectors towards the lights, ``[L, 3]``.
        colors: linear colours of the lights, ``[L, 3]``.
        head: strength of a lamp at the camera.
    """

    ambient: np.ndarray
    directions: np.ndarray
    colors: np.ndarray
    head: float

    @classmethod
    def sample(cls, rng: np.random.Generator, varied: bool = False) -> Lights:
        """Draws a key light and a fill light from above, ambient light and a lamp at the camera.

        Args:
            rng: source of chance.
            varied: whether strength, height and tint of the lights differ more than usual.
        """
        ranges = VARIED if varied else USUAL
        azimuth = rng.uniform(0, 2 * math.pi) + np.array([0, rng.uniform(0.5, 1.5) * math.pi])
        height = np.sin(np.radians([rng.uniform(*ranges["height"]), rng.uniform(0, 50)]))
        flat = np.sqrt(1 - height**2)
        tints = rng.uniform(*ranges["tint"], size=(2, 3))
        return cls(
            ambient=np.full(3, rng.uniform(*ranges["ambient"])),
            directions=np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), height], 1),
            colors=tints * np.array([[rng.uniform(*ranges["key"])], [rng.uniform(0.1, 0.3)]]),
            head=rng.uniform(0.1, 0.25),
        )

    def shade(self, normals: np.ndarray, to_camera: np.ndarray) -> np.ndarray:
        """Returns ``[P, 3]``, the light that white points with unit ``normals [P, 3]`` send on."""
        lambert = np.maximum(normals @ self.directions.T.astype(np.float32), 0)
        light = lambert @ self.colors.astype(np.float32)
        light += (0.75 + 0.25 * normals[:, 2:]) * self.ambient.astype(np.float32)
        light += self.head * np.maximum(_dot(normals, to_camera), 0)
        return light


class _Textures:
    """The textures of all materials, at every halved size, in one flat array of texels."""

    def __init__(self, mesh: TexturedMesh) -> None:
        chains = [_halvings(m.texture) for m in mesh.materials]
        deepest = max(map(len, chains))
        levels = [[c[min(i, len(c) - 1)] for i in range(deepest)] for c in chains]
        start, texels, starts = 0, [], {}
        for picture in (p for chain in chains for p in chain):
            starts[id(picture)] = start
            texels.append(picture.reshape(-1, 4))
            start += len(texels[-1])
        self.texels = np.concatenate(texels)
        self.starts = np.array([[starts[id(p)] for p in row] for row in levels])
        self.widths = np.array([[p.shape[1] for p in row] for row in levels])
        self.heights = np.array([[p.shape[0] for p in row] for row in levels])
        self.colors = np.stack([m.color for m in mesh.materials]).astype(np.float32)
        self.textured = np.array([m.texture is not None for m in mesh.materials])

    def sample(self, material: np.ndarray, uv: np.ndarray, level: np.ndarray) -> np.ndarray:
        """Samples ``[P, 4]`` linear RGBA, colour premultiplied, of the materials at the UVs."""
        color = self.colors[material]
        color[:, :3] *= color[:, 3:]
        some = np.flatnonzero(self.textured[material])
        if not len(some):
            return color
        material, uv, level = material[some], uv[some], level[some]
        level = np.clip(level, 0, self.starts.shape[1] - 1)
        start = self.starts[material, level]
        width, height = self.widths[material, level], self.heights[material, level]
        x = (uv[:, 0] - np.floor(uv[:, 0])) * width - 0.5
        y = (1 - (uv[:, 1] - np.floor(uv[:, 1]))) * height - 0.5
        x0, y0 = np.floor(x).astype(np.int64), np.floor(y).astype(np.int64)
        fx, fy = (x - x0).astype(np.float32), (y - y0).astype(np.float32)
        out = np.zeros((len(uv), 4), np.float32)
        for dy, wy in ((0, 1 - fy), (1, fy)):
            row = start + (y0 + dy) % height * width
            for dx, wx in ((0, 1 - fx), (1, fx)):
                texel = self.texels[row + (x0 + dx) % width]
                weight = wx * wy * (texel[:, 3] * np.float32(1 / 255))
                out[:, :3] += weight[:, None] * _TO_LINEAR[texel[:, :3]]
                out[:, 3] += weight
        color[some] *= out
        return color


def _halvings(texture: np.ndarray | None) -> list[np.ndarray]:
    if texture is None:
        return [np.full((1, 1, 4), 255, np.uint8)]
    chain = [np.ascontiguousarray(texture)]
    while max(chain[-1].shape[:2]) > 1:
        height, width = (max(1, n // 2) for n in chain[-1].shape[:2])
        small = Image.fromarray(chain[-1]).resize((width, height), Image.Resampling.BOX)
        chain.append(np.asarray(small))
    return chain


def _blend(corners: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Blends the corners' values ``[P, 3, K]`` by barycentric ``weights [P, 3]`` to ``[P, K]``."""
    return np.einsum("pck,pc->pk", corners, weights)


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.einsum("pk,pk->p", a, b)[:, None]


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.maximum(np.sqrt(_dot(vectors, vectors)), 1e-12)


def _directions(pose: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """World directions ``[H W, 3]`` of unit depth, through columns ``x [W]`` and rows ``y [H]``."""
    local = np.stack([*np.meshgrid(x, y), np.full((len(y), len(x)), -1.0)], -1)
    return (local.reshape(-1, 3) @ pose[:3, :3].T).astype(np.float32)


class RayCaster:
    """Pictures of one mesh under one light.

    Args:
        mesh: in object units, z-up, centred.
        lights: lights in the mesh's frame.
        threads: number of Open3D's threads; 0 means all cores.
    """

    def __init__(self, mesh: TexturedMesh, lights: Lights, threads: int = 1) -> None:
        self._o3d = import_open3d()
        self.mesh, self.lights, self.threads = mesh, lights, threads
        core = self._o3d.core
        self._scene = self._o3d.t.geometry.RaycastingScene(nthreads=threads)
        self._scene.add_triangles(
            core.Tensor(mesh.vertices.astype(np.float32)),
            core.Tensor(mesh.faces.astype(np.uint32)),
        )
        self._textures = _Textures(mesh)
        corners = mesh.vertices[mesh.faces]
        edges = corners[:, 1:] - corners[:, :1]
        normal = np.cross(edges[:, 0], edges[:, 1])
        area = np.linalg.norm(normal, axis=1)
        self._face_normals = (normal / np.maximum(area, 1e-30)[:, None]).astype(np.float32)
        uv_edges = mesh.uvs[:, 1:] - mesh.uvs[:, :1]
        uv_area = np.abs(
            uv_edges[:, 0, 0] * uv_edges[:, 1, 1] - uv_edges[:, 0, 1] * uv_edges[:, 1, 0]
        )
        # Texture widths per object unit; a texture's width times this is its texels per unit.
        self._uv_density = np.sqrt(uv_area / np.maximum(area, 1e-12)).astype(np.float32)
        self._has_colors = bool((mesh.colors != 255).any())

    def render(self, pose: np.ndarray, size: int, fov: float) -> tuple[np.ndarray, np.ndarray]:
        """Renders one view.

        Args:
            pose: ``[4, 4]`` camera to world, OpenGL frame.
            size: side of the picture, pixels.
            fov: degrees, of the picture's side.

        Returns:
            ``[size, size, 4]`` float32 display RGBA in [0, 1], colour not premultiplied; and
            ``[size, size]`` float32 depth along the optical axis at the pixels' centres: of the
            point where half the light is blocked, or 0 if there is none.
        """
        n = size * SAMPLES
        half = math.tan(math.radians(fov) / 2)
        rows, columns = self._window(pose, n, half)
        y = half * (1 - 2 * (np.arange(*rows) + 0.5) / n)
        x = half * (2 * (np.arange(*columns) + 0.5) / n - 1)
        directions = _directions(pose, x, y)
        color, depth = self._trace(pose[:3, 3].astype(np.float32), directions, 2 * half / n)
        full = np.zeros((n, n, 4), np.float32)
        full[slice(*rows), slice(*columns)] = color.reshape(len(y), len(x), 4)
        full_depth = np.zeros((n, n), np.float32)
        full_depth[slice(*rows), slice(*columns)] = depth.reshape(len(y), len(x))
        mean = sum(full[i::SAMPLES, j::SAMPLES] for i in range(SAMPLES) for j in range(SAMPLES))
        mean *= np.float32(1 / SAMPLES**2)
        alpha = mean[..., 3:]
        straight = np.divide(
            mean[..., :3], alpha, out=np.zeros_like(mean[..., :3]), where=alpha > 0
        )
        picture = np.concatenate([to_display(np.clip(straight, 0, 1)) * (alpha > 0), alpha], -1)
        return picture, full_depth[SAMPLES // 2 :: SAMPLES, SAMPLES // 2 :: SAMPLES]

    def last_depth(self, pose: np.ndarray, size: int, fov: float) -> np.ndarray:
        """Depth of the last surface that a ray meets, however transparent what it meets is.

        Args:
            pose: as for ``render``, like ``size`` and ``fov``.

        Returns:
            ``[size, size]`` float32 along the optical axis, at the pixels' centres; 0 without a
            hit.
        """
        half = math.tan(math.radians(fov) / 2)
        x = half * (2 * (np.arange(size) + 0.5) / size - 1)
        directions = _directions(pose, x, -x)
        origin = pose[:3, 3].astype(np.float32)
        corners = (self.mesh.vertices - pose[:3, 3]) @ pose[:3, 2]
        far = max(0.0, float(-corners.min())) + 1.0  # behind all of the mesh
        rays = np.concatenate([origin + far * directions, -directions], 1).astype(np.float32)
        hits = self._scene.cast_rays(self._o3d.core.Tensor(rays), nthreads=self.threads)
        depth = far - hits["t_hit"].numpy()  # what is behind the camera, or no hit, is below 0
        return np.maximum(depth, 0).reshape(size, size).astype(np.float32)

    def _window(self, pose: np.ndarray, n: int, half: float) -> tuple[tuple, tuple]:
        """Finds the ranges of sample rows and columns that the object can cover."""
        local = (self.mesh.vertices - pose[:3, 3]) @ pose[:3, :3]
        if (local[:, 2] > -1e-3).any():  # the camera is beside or inside the object
            return (0, n), (0, n)
        plane = local[:, :2] / (-local[:, 2:] * half)
        low = np.floor((1 + plane.min(0)) / 2 * n - 1)
        high = np.ceil((1 + plane.max(0)) / 2 * n + 1)
        (left, bottom), (right, top) = np.clip(low, 0, n), np.clip(high, 0, n)
        rows, columns = (int(n - top), int(n - bottom)), (int(left), int(right))
        return rows, columns

    def _trace(
        self, origin: np.ndarray, directions: np.ndarray, spacing: float
    ) -> tuple[np.ndarray, np.ndarray]:
        """Traces rays to linear RGBA ``[P, 4]``, colour premultiplied, and depth ``[P]``.

        The directions must have unit depth.
        """
        count = len(directions)
        color = np.zeros((count, 4), np.float32)
        depth = np.zeros(count, np.float32)
        alive = np.arange(count)
        travelled = np.zeros(count, np.float32)
        for _ in range(LAYERS):
            if not len(alive):
                break
            d = directions[alive]
            rays = np.concatenate([origin + travelled[alive, None] * d, d], 1)
            hits = self._scene.cast_rays(self._o3d.core.Tensor(rays), nthreads=self.threads)
            distance = hits["t_hit"].numpy()
            hit = np.isfinite(distance)
            alive, d = alive[hit], d[hit]
            travelled[alive] += distance[hit]
            faces = hits["primitive_ids"].numpy()[hit].astype(np.int64)
            layer = self._surface(
                faces, hits["primitive_uvs"].numpy()[hit], d, travelled[alive] * spacing
            )
            through = 1 - color[alive, 3:]
            color[alive] += through * layer
            blocked = (color[alive, 3] >= 0.5) & (depth[alive] == 0)
            depth[alive[blocked]] = travelled[alive[blocked]]
            alive = alive[color[alive, 3] < 1 - OPAQUE]
            travelled[alive] += STEP
        return color, depth

    def _surface(
        self, faces: np.ndarray, bary: np.ndarray, directions: np.ndarray, footprint: np.ndarray
    ) -> np.ndarray:
        """Shades the hit points to ``[P, 4]`` linear RGBA, colour premultiplied."""
        mesh = self.mesh
        weights = np.column_stack([1 - bary[:, 0] - bary[:, 1], bary])
        to_camera = -_unit(directions)
        normals = _unit(_blend(mesh.normals[faces], weights))
        # Faces have two sides, and the normal is that of the side that the camera sees.
        normals *= np.sign(_dot(self._face_normals[faces], to_camera))
        material = mesh.material_ids[faces]
        uv = _blend(mesh.uvs[faces], weights)
        texels = np.sqrt(self._textures.widths[:, 0] * self._textures.heights[:, 0])[material]
        spread = self._uv_density[faces] * texels * footprint
        level = np.round(np.log2(np.maximum(spread, 1.0))).astype(np.int64)
        base = self._textures.sample(material, uv, level)
        if self._has_colors:
            vertex = _blend(mesh.colors[faces].astype(np.float32), weights / 255)
            base[:, :3] *= to_linear(vertex[:, :3]) * vertex[:, 3:]
            base[:, 3] *= vertex[:, 3]
        base[:, :3] += GLOSS * base[:, 3:]
        base[:, :3] *= self.lights.shade(normals, to_camera)
        return base
