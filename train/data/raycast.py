"""Small ray caster for textured meshes: Open3D finds the hits, a Warp kernel shades them."""

# Annotations of kernels are values for Warp, not types.
# pyright: reportInvalidTypeForm=false

import math
from dataclasses import dataclass
from typing import Any, no_type_check

import numpy as np
import warp as wp
from PIL import Image

from gamba_warp.color_spaces import to_display, to_linear
from gamba_warp.formats.meshes import TexturedMesh
from gamba_warp.kernels.runtime.views import struct
from gamba_warp.versions import import_open3d

SAMPLES = 3  # rays along each side of a pixel; odd, so that one goes through the pixel's centre
LAYERS = 8  # number of surfaces that a ray may pass through
STEP = 1e-4  # object units behind a transparent surface at which its ray continues
GLOSS = 0.02  # fraction reflected even by a black surface, so that its shape shows
OPAQUE = 0.02  # transmittance below which a ray ends
# Ranges of the lights of an object: height of the key light in degrees, its strength, that of the
# ambient light, and the tint of both lights.
DEFAULT = {"height": (25, 70), "key": (0.5, 0.85), "ambient": (0.4, 0.6), "tint": (0.92, 1.0)}
RANDOMIZED = {"height": (0, 90), "key": (0.3, 1.1), "ambient": (0.2, 0.7), "tint": (0.75, 1.0)}


@dataclass
class Lights:
    """Lights of one object, the same for all its views, in its own frame.

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
    def sample(cls, rng: np.random.Generator, randomized: bool = False) -> "Lights":
        """Draw a key light and a fill light from above, ambient light and a lamp at the camera.

        Args:
            rng: random generator.
            randomized: draw strength, height and tint of the lights from wider ranges.
        """
        ranges = RANDOMIZED if randomized else DEFAULT
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


@struct
class _Surface:
    """Mesh with its materials and lights, for ``_shade``.

    Attributes:
        normals: ``[3 F]`` unit normals of the faces' corners.
        uvs: ``[3 F]`` of the corners.
        colors: ``[3 F]`` display RGBA of the corners; empty if all are white.
        face_normals: ``[F]`` unit.
        density: ``[F]`` widths of a texture per object unit.
        materials: ``[F]`` indices into the materials.
        plain: ``[M]`` linear RGBA of the materials, the colour premultiplied.
        levels: number of halvings of a texture; 0 for a material without one.
        texels: ``[T]`` display RGBA of all textures at every halved size.
        starts: ``[M, L]`` first texel of a material's texture, by number of halvings.
        widths: ``[M, L]`` texels.
        heights: ``[M, L]`` texels.
        linear: ``[256]`` linear light of display values.
        ambient: light from above; half of it comes from below.
        to_lights: ``[K]`` unit vectors towards the lights.
        lights: ``[K]`` linear colours.
        head: strength of a lamp at the camera.
    """

    normals: wp.array(dtype=wp.vec3)
    uvs: wp.array(dtype=wp.vec2)
    colors: wp.array(dtype=wp.vec4)
    face_normals: wp.array(dtype=wp.vec3)
    density: wp.array(dtype=wp.float32)
    materials: wp.array(dtype=wp.int32)
    plain: wp.array(dtype=wp.vec4)
    levels: wp.array(dtype=wp.int32)
    texels: wp.array(dtype=wp.vec4ub)
    starts: wp.array2d(dtype=wp.int64)
    widths: wp.array2d(dtype=wp.int32)
    heights: wp.array2d(dtype=wp.int32)
    linear: wp.array(dtype=wp.float32)
    ambient: wp.vec3
    to_lights: wp.array(dtype=wp.vec3)
    lights: wp.array(dtype=wp.vec3)
    head: wp.float32


@wp.func
@no_type_check
def _to_linear(display: wp.float32):
    """Linear light of an sRGB display value in [0, 1]."""
    return wp.where(display <= 0.04045, display / 12.92, wp.pow((display + 0.055) / 1.055, 2.4))


@wp.func
@no_type_check
def _texel(s: _Surface, start: wp.int64, width: wp.int32, height: wp.int32, x: int, y: int):
    """Read one texel as linear RGBA, colour premultiplied; textures repeat."""
    column, row = x % width, y % height
    if column < 0:
        column += width
    if row < 0:
        row += height
    value = s.texels[start + wp.int64(row) * wp.int64(width) + wp.int64(column)]
    alpha = wp.float32(value[3]) / 255.0
    red, green = s.linear[wp.int32(value[0])], s.linear[wp.int32(value[1])]
    blue = s.linear[wp.int32(value[2])]
    return wp.vec4(alpha * red, alpha * green, alpha * blue, alpha)


@wp.func
@no_type_check
def _textured(s: _Surface, material: int, uv: wp.vec2, level: int):
    """Bilinear sample of a material's texture at one of its sizes."""
    width, height = s.widths[material, level], s.heights[material, level]
    start = s.starts[material, level]
    x = (uv[0] - wp.floor(uv[0])) * wp.float32(width) - 0.5
    y = (1.0 - (uv[1] - wp.floor(uv[1]))) * wp.float32(height) - 0.5
    x0, y0 = wp.floor(x), wp.floor(y)
    fx, fy = x - x0, y - y0
    column, row = wp.int32(x0), wp.int32(y0)
    top = (1.0 - fx) * _texel(s, start, width, height, column, row)
    top += fx * _texel(s, start, width, height, column + 1, row)
    low = (1.0 - fx) * _texel(s, start, width, height, column, row + 1)
    low += fx * _texel(s, start, width, height, column + 1, row + 1)
    return (1.0 - fy) * top + fy * low


@wp.kernel(enable_backward=False)
@no_type_check
def _shade(
    s: _Surface,
    spacing: wp.float32,
    rays_in: wp.array(dtype=wp.int32),
    directions_in: wp.array(dtype=wp.vec3),
    distances_in: wp.array(dtype=wp.float32),
    faces_in: wp.array(dtype=wp.uint32),
    corners_in: wp.array(dtype=wp.vec2),
    travelled_out: wp.array(dtype=wp.float32),
    colors_out: wp.array(dtype=wp.vec4),
    depths_out: wp.array(dtype=wp.float32),
):
    """Composite the hit of each ray behind the surfaces before it.

    Args:
        s: the mesh and its lights.
        spacing: distance between neighbouring rays at depth 1.
        rays_in: numbers of the rays; the hit arguments are in the same order.
        directions_in: of all rays, at depth 1.
        distances_in: from the last start of the ray to the hit, infinite for a miss.
        faces_in: faces that were hit.
        corners_in: barycentric weights of their second and third corner.
        travelled_out: depth reached by all rays; also read.
        colors_out: linear RGBA, colour premultiplied; also read.
        depths_out: depth at which half of the light is blocked; also read.
    """
    hit = wp.tid()
    if not wp.isfinite(distances_in[hit]):
        travelled_out[rays_in[hit]] = wp.inf
        return
    ray, face = rays_in[hit], wp.int32(faces_in[hit])
    depth = travelled_out[ray] + distances_in[hit]
    travelled_out[ray] = depth
    b, c = corners_in[hit][0], corners_in[hit][1]
    a = 1.0 - b - c
    first = 3 * face
    to_camera = -wp.normalize(directions_in[ray])
    normal = a * s.normals[first] + b * s.normals[first + 1] + c * s.normals[first + 2]
    # Faces are two-sided; the normal points to the side facing the camera.
    side = wp.dot(s.face_normals[face], to_camera)
    normal = wp.normalize(normal) * wp.where(side > 0.0, 1.0, wp.where(side < 0.0, -1.0, 0.0))
    material = s.materials[face]
    base = s.plain[material]
    if s.levels[material] > 0:
        size = wp.float32(s.widths[material, 0]) * wp.float32(s.heights[material, 0])
        spread = s.density[face] * wp.sqrt(size) * depth * spacing
        level = wp.int32(wp.rint(wp.log2(wp.max(spread, 1.0))))
        uv = a * s.uvs[first] + b * s.uvs[first + 1] + c * s.uvs[first + 2]
        base = wp.cw_mul(base, _textured(s, material, uv, wp.min(level, s.levels[material] - 1)))
    if s.colors.shape[0] > 0:
        blend = a * s.colors[first] + b * s.colors[first + 1] + c * s.colors[first + 2]
        red, green, blue = _to_linear(blend[0]), _to_linear(blend[1]), _to_linear(blend[2])
        alpha = blend[3]
        base = wp.cw_mul(base, wp.vec4(alpha * red, alpha * green, alpha * blue, alpha))
    light = (0.75 + 0.25 * normal[2]) * s.ambient
    light += s.head * wp.max(wp.dot(normal, to_camera), 0.0) * wp.vec3(1.0)
    for k in range(s.lights.shape[0]):
        light += wp.max(wp.dot(normal, s.to_lights[k]), 0.0) * s.lights[k]
    seen = colors_out[ray]
    through, gloss = 1.0 - seen[3], GLOSS * base[3]
    seen += through * wp.vec4(
        (base[0] + gloss) * light[0],
        (base[1] + gloss) * light[1],
        (base[2] + gloss) * light[2],
        base[3],
    )
    colors_out[ray] = seen
    if seen[3] >= 0.5 and depths_out[ray] == 0.0:
        depths_out[ray] = depth


def _halvings(texture: np.ndarray | None) -> list[np.ndarray]:
    """Mipmaps of a texture down to one texel; empty without a texture."""
    if texture is None:
        return []
    chain = [np.ascontiguousarray(texture)]
    while max(chain[-1].shape[:2]) > 1:
        height, width = (max(1, n // 2) for n in chain[-1].shape[:2])
        small = Image.fromarray(chain[-1]).resize((width, height), Image.Resampling.BOX)
        chain.append(np.asarray(small))
    return chain


def _directions(pose: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """World directions ``[H W, 3]`` of unit depth, for columns ``x [W]`` and rows ``y [H]``."""
    right, up, back = pose[:3, :3].T
    across = x[:, None] * right - back
    return (y[:, None, None] * up + across).astype(np.float32).reshape(-1, 3)


class RayCaster:
    """Renderer of one mesh with fixed lights.

    Args:
        mesh: in object units, z-up, centred.
        lights: lights in the mesh's frame.
        threads: number of Open3D's threads; 0 means all cores.
    """

    def __init__(self, mesh: TexturedMesh, lights: Lights, threads: int = 1) -> None:
        self.mesh, self.lights, self.threads = mesh, lights, threads
        self._scene = import_open3d().t.geometry.RaycastingScene(nthreads=threads)
        self._scene.add_triangles(mesh.vertices.astype(np.float32), mesh.faces.astype(np.uint32))
        corners = mesh.vertices[mesh.faces]
        edges = corners[:, 1:] - corners[:, :1]
        normal = np.cross(edges[:, 0], edges[:, 1])
        area = np.linalg.norm(normal, axis=1)
        uv_edges = mesh.uvs[:, 1:] - mesh.uvs[:, :1]
        uv_area = np.abs(
            uv_edges[:, 0, 0] * uv_edges[:, 1, 1] - uv_edges[:, 0, 1] * uv_edges[:, 1, 0]
        )
        chains = [_halvings(m.texture) for m in mesh.materials]
        sizes = np.zeros((3, len(chains), max(1, *map(len, chains))), np.int64)
        start, texels = 0, [np.zeros((0, 4), np.uint8)]
        for row, chain in enumerate(chains):
            for level, image in enumerate(chain):
                sizes[:, row, level] = start, image.shape[1], image.shape[0]
                texels.append(image.reshape(-1, 4))
                start += len(texels[-1])
        plain = np.stack([m.color for m in mesh.materials]).astype(np.float32)
        plain[:, :3] *= plain[:, 3:]
        colors = np.zeros((0, 4), np.float32)
        if (mesh.colors != 255).any():
            colors = mesh.colors.reshape(-1, 4).astype(np.float32) / 255
        s: Any = _Surface()
        s.normals = _array(mesh.normals.reshape(-1, 3), wp.vec3)
        s.uvs = _array(mesh.uvs.reshape(-1, 2), wp.vec2)
        s.colors = _array(colors, wp.vec4)
        s.face_normals = _array(normal / np.maximum(area, 1e-30)[:, None], wp.vec3)
        s.density = _array(np.sqrt(uv_area / np.maximum(area, 1e-12)), wp.float32)
        s.materials = _array(mesh.material_ids, wp.int32)
        s.plain = _array(plain, wp.vec4)
        s.levels = _array(np.array([len(chain) for chain in chains]), wp.int32)
        s.texels = _array(np.concatenate(texels), wp.vec4ub)
        s.starts = _array(sizes[0], wp.int64)
        s.widths, s.heights = _array(sizes[1], wp.int32), _array(sizes[2], wp.int32)
        s.linear = _array(to_linear(np.arange(256) / 255.0), wp.float32)
        s.ambient, s.head = wp.vec3(*lights.ambient), lights.head
        s.to_lights = _array(lights.directions, wp.vec3)
        s.lights = _array(lights.colors, wp.vec3)
        self._surface = s

    def render(self, pose: np.ndarray, size: int, fov: float) -> tuple[np.ndarray, np.ndarray]:
        """Render one view.

        Args:
            pose: ``[4, 4]`` camera to world, OpenGL frame.
            size: side of the image, pixels.
            fov: degrees, of the image's side.

        Returns:
            ``[size, size, 4]`` float32 display RGBA in [0, 1], colour not premultiplied; and
            ``[size, size]`` float32 depth along the optical axis at the pixels' centres, of the
            point where half the light is blocked; 0 without one.
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
        image = np.concatenate([to_display(np.clip(straight, 0, 1)) * (alpha > 0), alpha], -1)
        return image, full_depth[SAMPLES // 2 :: SAMPLES, SAMPLES // 2 :: SAMPLES]

    def last_depth(self, pose: np.ndarray, size: int, fov: float) -> np.ndarray:
        """Depth of the last surface along each ray, ignoring transparency.

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
        hits = self._scene.cast_rays(rays, nthreads=self.threads)
        depth = far - hits["t_hit"].numpy()  # negative behind the camera or without a hit
        return np.maximum(depth, 0).reshape(size, size).astype(np.float32)

    def _window(self, pose: np.ndarray, n: int, half: float) -> tuple[tuple, tuple]:
        """Find the ranges of sample rows and columns that the object can cover."""
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
        """Trace rays to linear RGBA ``[P, 4]``, colour premultiplied, and depth ``[P]``.

        The directions must have unit depth.
        """
        count = len(directions)
        color = np.zeros((count, 4), np.float32)
        depth = np.zeros(count, np.float32)
        travelled = np.zeros(count, np.float32)
        alive = np.arange(count, dtype=np.int32)
        outputs = [_array(travelled, wp.float32), _array(color, wp.vec4), _array(depth, wp.float32)]
        rays = np.concatenate([np.broadcast_to(origin, directions.shape), directions], 1)
        for _ in range(LAYERS):
            hits = self._scene.cast_rays(rays, nthreads=self.threads)
            parts = hits["t_hit"], hits["primitive_ids"], hits["primitive_uvs"]
            distances, faces, corners = (part.numpy() for part in parts)
            operands = [
                *(_array(alive, wp.int32), _array(directions, wp.vec3)),
                *(_array(distances, wp.float32), _array(faces, wp.uint32)),
                _array(corners, wp.vec2),
            ]
            inputs = [self._surface, spacing, *operands]
            wp.launch(_shade, len(alive), inputs=inputs, outputs=outputs, device="cpu")
            alive = alive[(color[alive, 3] < 1 - OPAQUE) & np.isfinite(travelled[alive])]
            if not len(alive):
                break
            travelled[alive] += STEP
            d = directions[alive]
            rays = np.concatenate([origin + travelled[alive, None] * d, d], 1)
        return color, depth


def _array(values: np.ndarray, dtype: Any) -> Any:
    """Convert to a Warp array, which shares the memory if the type already matches."""
    kind = wp.dtype_to_numpy(getattr(dtype, "_wp_scalar_type_", dtype))
    return wp.array(np.ascontiguousarray(values, kind), dtype=dtype, device="cpu", copy=False)
