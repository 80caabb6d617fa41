"""Meshes of glTF, compared with known values; unread content is a warning that names it."""

import base64
import io
import json

import numpy as np
import pytest
import trimesh
from helpers.meshes import glb
from helpers.refusals import refused
from PIL import Image

from gamba_warp.color_spaces import to_linear
from gamba_warp.formats.meshes import load_mesh

SQUARE = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], "<f4")
CORNERS = np.array([0, 1, 2, 0, 2, 3], "<u2")
UVS = np.array([[0, 1], [1, 1], [1, 0], [0, 0]], "<f4")  # the image upright
# Rows from the top: red, green; blue, white.
PAINT = np.array([[[255, 0, 0], [0, 255, 0]], [[0, 0, 255], [255, 255, 255]]], np.uint8)
_TYPES = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4", 16: "MAT4"}
_KINDS = {"i1": 5120, "u1": 5121, "i2": 5122, "u2": 5123, "u4": 5125, "f4": 5126}


class Document:
    """A glTF document to which arrays are added; its first mesh is a square of one primitive."""

    def __init__(self, **more):
        self.binary = b""
        self.tree = {"asset": {"version": "2.0"}, "accessors": [], "bufferViews": []}
        self.attributes = {"POSITION": self.array(SQUARE)}
        self.primitive = {"attributes": self.attributes, "indices": self.array(CORNERS)}
        self.tree |= {"meshes": [{"primitives": [self.primitive]}], "nodes": [{"mesh": 0}]}
        self.tree |= {"scenes": [{"nodes": [0]}]} | more
        if "materials" in more:
            self.primitive["material"] = 0

    def view(self, data):
        self.binary += bytes(-len(self.binary) % 4)
        view = {"buffer": 0, "byteOffset": len(self.binary), "byteLength": len(data)}
        self.binary += data
        self.tree["bufferViews"].append(view)
        return len(self.tree["bufferViews"]) - 1

    def array(self, values, **more):
        values = np.asarray(values)
        width = values.size // len(values)
        kind = _KINDS[values.dtype.str[1:]]
        accessor = {"componentType": kind, "type": _TYPES[width], "count": len(values)}
        accessor |= {"bufferView": self.view(values.tobytes())} | more
        self.tree["accessors"].append(accessor)
        return len(self.tree["accessors"]) - 1

    def sparse(self, at, values):
        """Return changes of an accessor: ``values`` at the indices ``at``."""
        kind = _KINDS[at.dtype.str[1:]]
        return {
            "count": len(at),
            "indices": {"bufferView": self.view(at.tobytes()), "componentType": kind},
            "values": {"bufferView": self.view(np.array(values, "<f4").tobytes())},
        }

    def paint(self, info=(), texture=(), base=(), **material):
        """Give the square the texture ``PAINT``."""
        pixels = io.BytesIO()
        Image.fromarray(PAINT).save(pixels, "PNG")
        self.tree["images"] = [{"bufferView": self.view(pixels.getvalue())}]
        self.tree["textures"] = [{"source": 0} | dict(texture)]
        roughness = {"baseColorTexture": {"index": 0} | dict(info)} | dict(base)
        self.tree["materials"] = [{"pbrMetallicRoughness": roughness} | material]
        self.primitive["material"] = 0
        self.attributes.setdefault("TEXCOORD_0", self.array(UVS))
        return self

    def load(self, folder):
        self.tree["buffers"] = [{"byteLength": len(self.binary)}]
        path = folder / "a.glb"
        path.write_bytes(glb(self.tree, self.binary))
        return load_mesh(path)


def places(mesh):
    """Return the corners ``[F, 3, 3]``."""
    return mesh.vertices[mesh.faces]


def seen(mesh, at):
    """Return the texel, display RGB, at a point ``[x, y]`` of the square."""
    (face,) = (i for i in range(len(mesh.faces)) if _inside(places(mesh)[i], at))
    corners = np.column_stack([places(mesh)[face][:, :2], np.ones(3)])
    u, v = np.linalg.solve(corners.T, [*at, 1]) @ mesh.uvs[face]
    texture = mesh.materials[mesh.material_ids[face]].texture
    rows, columns = texture.shape[:2]
    return texture[int((1 - v) % 1 * rows), int(u % 1 * columns), :3].tolist()


def _inside(triangle, at):
    edges = np.roll(triangle, -1, 0)[:, :2] - triangle[:, :2]
    off = np.asarray(at) - triangle[:, :2]
    return (edges[:, 0] * off[:, 1] - edges[:, 1] * off[:, 0] > 0).all()


RED, GREEN, BLUE, WHITE = PAINT.reshape(4, 3).tolist()
FOUR = [(0.2, 0.9), (0.9, 0.8), (0.1, 0.2), (0.8, 0.1)]  # of red, green, blue and white


@pytest.mark.parametrize("kind", ["i1", "i2", "u1", "u2"])
def test_normalised_integers_are_fractions(tmp_path, kind):
    most = np.iinfo(kind).max
    document = Document(extensionsUsed=["KHR_mesh_quantization"])
    whole = (SQUARE * most).astype(kind)
    document.attributes["POSITION"] = document.array(whole, normalized=True)
    document.attributes["NORMAL"] = document.array(np.full((4, 3), [0, 0, most], kind))
    document.attributes["TEXCOORD_0"] = document.array((UVS * most).astype(kind), normalized=True)
    mesh = document.paint().load(tmp_path)
    np.testing.assert_allclose(places(mesh), SQUARE[CORNERS.reshape(2, 3)], atol=1e-7)
    assert [seen(mesh, at) for at in FOUR] == [RED, GREEN, BLUE, WHITE] and not mesh.warnings
    np.testing.assert_allclose(mesh.normals[..., 2], 1)
    document.attributes["POSITION"] = document.array(whole)
    np.testing.assert_array_equal(places(document.load(tmp_path)).max((0, 1)), [most, most, 0])


def test_rows_with_a_stride(tmp_path):
    """Three numbers of 16 bits take eight bytes, as the format requires."""
    document, rows = Document(), np.zeros((4, 4), "<i2")
    rows[:, :3] = SQUARE * 7
    document.attributes["POSITION"] = document.array(rows, type="VEC3")
    document.tree["bufferViews"][-1]["byteStride"] = 8
    want = 7 * SQUARE[CORNERS.reshape(2, 3)]
    np.testing.assert_array_equal(places(document.load(tmp_path)), want)


@pytest.mark.parametrize("kind", ["u1", "u2", "f4"])
@pytest.mark.parametrize("width", [3, 4])
def test_colours_of_vertices_are_linear_light(tmp_path, kind, width):
    display = np.array([[51, 128, 204, 0], [0, 255, 17, 99], [9, 90, 200, 1], [255, 1, 2, 3]])
    light = to_linear(display / 255)
    if kind != "f4":
        light = np.rint(light * np.iinfo(kind).max)
    document = Document()
    values = light.astype(kind)[:, :width]
    document.attributes["COLOR_0"] = document.array(np.ascontiguousarray(values), normalized=True)
    mesh = document.load(tmp_path)
    want = display[CORNERS.reshape(2, 3)] | [0, 0, 0, 255]  # without a material it is opaque
    # The dark ones of 8 bits are as coarse as that, display 13 is linear 1 of 255.
    assert np.abs(mesh.colors.astype(int) - want).max() <= (7 if kind == "u1" else 0)
    assert not mesh.warnings  # and it is no part without colours


def test_alpha_of_vertices_counts_where_the_material_blends(tmp_path):
    document = Document(materials=[{"alphaMode": "BLEND"}])
    document.attributes["COLOR_0"] = document.array(np.full((4, 4), 0.4, "<f4"))
    assert document.load(tmp_path).colors[..., 3].max() == 102
    document.tree["materials"] = [{}]
    assert document.load(tmp_path).colors[..., 3].min() == 255


def test_a_texture_is_scaled_before_it_is_turned(tmp_path):
    change = {"offset": [0.1, 0.2], "scale": [2, 0.5], "rotation": 0.6}
    mesh = Document().paint({"extensions": {"KHR_texture_transform": change}}).load(tmp_path)
    u, v = (UVS * [2, 0.5]).T
    turned = np.cos(0.6) * u + np.sin(0.6) * v + 0.1, np.cos(0.6) * v - np.sin(0.6) * u + 0.2
    want = np.stack([turned[0], 1 - turned[1]], -1)[CORNERS.reshape(2, 3)]
    np.testing.assert_allclose(mesh.uvs, want, atol=1e-6)


@pytest.mark.parametrize("within", [False, True])
def test_second_coordinates(tmp_path, within):
    document = Document()
    document.attributes["TEXCOORD_0"] = document.array(np.zeros((4, 2), "<f4"))
    document.attributes["TEXCOORD_1"] = document.array(UVS)
    change = {"extensions": {"KHR_texture_transform": {"texCoord": 1}}}
    mesh = document.paint(change if within else {"texCoord": 1}).load(tmp_path)
    assert [seen(mesh, at) for at in FOUR] == [RED, GREEN, BLUE, WHITE] and not mesh.warnings


def test_webp_by_its_extension(tmp_path):
    document = Document().paint()
    document.tree["textures"] = [{"extensions": {"EXT_texture_webp": {"source": 0}}}]
    mesh = document.load(tmp_path)
    assert mesh.materials[0].texture is not None and not mesh.warnings


def test_surfaces_that_only_emit_light(tmp_path):
    document = Document().paint(emissiveTexture={"index": 0}, emissiveFactor=[1, 1, 1])
    document.tree["materials"][0]["pbrMetallicRoughness"] = {"baseColorFactor": [0, 0, 0, 1]}
    mesh = document.load(tmp_path)
    assert [seen(mesh, at) for at in FOUR] == [RED, GREEN, BLUE, WHITE]
    assert mesh.warnings == ["emission of a surface is drawn as its base colour, shaded"]
    assert mesh.materials[0].color.tolist() == [1, 1, 1, 1]
    strength = {"KHR_materials_emissive_strength": {"emissiveStrength": 0.5}}
    document.tree["materials"][0] |= {"extensions": strength, "emissiveFactor": [1, 0.5, 0]}
    del document.tree["materials"][0]["emissiveTexture"]
    mesh = document.load(tmp_path)
    assert mesh.materials[0].color.tolist() == [0.5, 0.25, 0, 1]


def with_material(painted, base, **material):
    """Return the square with a material, perhaps with the texture ``PAINT``."""
    if painted:
        return Document().paint(base=base, **material)
    return Document(materials=[{"pbrMetallicRoughness": base} | material])


@pytest.mark.parametrize("painted", [False, True])
@pytest.mark.parametrize(
    "mode, alpha, cutoff, want",
    [
        *(("OPAQUE", 0.4, {}, 1), ("OPAQUE", 0.6, {}, 1)),
        *(("BLEND", 0.4, {}, 0.4), ("BLEND", 0.6, {}, 0.6)),
        *(("MASK", 0.6, {}, 1), ("MASK", 0.5, {}, 1)),
        ("MASK", 0.25, {"alphaCutoff": 0.25}, 1),
    ],
)
def test_alpha(tmp_path, mode, alpha, cutoff, want, painted):
    base = {"baseColorFactor": [1, 1, 1, alpha]}
    (material,) = with_material(painted, base, alphaMode=mode, **cutoff).load(tmp_path).materials
    texel = material.texture[0, 0, 3] / 255 if painted else 1
    np.testing.assert_allclose(material.color[3] * texel, want)


@pytest.mark.parametrize(
    "base, material, painted",
    [
        ({"baseColorFactor": [1, 1, 1, 0.4]}, {"alphaMode": "MASK"}, False),
        ({"baseColorFactor": [1, 1, 1, 0]}, {"alphaMode": "BLEND"}, True),
        ({}, {"alphaMode": "MASK", "alphaCutoff": 2.0}, True),
        ({}, {"alphaMode": "BLEND"}, False),  # its vertices have no alpha
    ],
)
def test_a_mesh_that_would_be_invisible_is_opaque(tmp_path, base, material, painted):
    document = with_material(painted, base, **material)
    document.attributes["COLOR_0"] = document.array(np.array([[1, 1, 1, painted]] * 4, "<f4"))
    mesh = document.load(tmp_path)
    assert mesh.warnings[-1] == "all its surfaces are transparent by their alpha: drawn opaque"
    (material,) = mesh.materials
    assert material.color[3] == 1 and mesh.colors[..., 3].min() == 255
    assert (material.texture is not None) == painted
    assert not painted or material.texture[..., 3].min() == 255


def test_a_part_that_is_invisible_beside_others_stays_so(tmp_path):
    document = with_material(False, {"baseColorFactor": [1, 1, 1, 0]}, alphaMode="BLEND")
    document.tree["materials"].append({})
    document.tree["meshes"][0]["primitives"].append(document.primitive | {"material": 1})
    mesh = document.load(tmp_path)
    assert [material.color[3] for material in mesh.materials] == [0, 1] and not mesh.warnings


def test_diffuse_and_specular(tmp_path):
    """A nonmetal of the older kind of material has its diffuse colour."""
    gloss = {"diffuseFactor": [0.5, 0.25, 0.125, 1], "specularFactor": [0.04, 0.04, 0.04]}
    extension = {"KHR_materials_pbrSpecularGlossiness": gloss}
    document = Document(materials=[{"extensions": extension}])
    mesh = document.load(tmp_path)
    np.testing.assert_allclose(mesh.materials[0].color[:3], [0.5, 0.25, 0.125], atol=0.02)
    document.paint().tree["materials"] = [{"extensions": extension}]
    gloss |= {"diffuseFactor": [1, 1, 1, 1], "diffuseTexture": {"index": 0}}
    mesh = document.load(tmp_path)
    got = [seen(mesh, at) for at in FOUR]
    np.testing.assert_allclose(got, PAINT.reshape(4, 3), atol=12)  # trimesh's own rounding


def test_strips_and_fans(tmp_path):
    """All faces have one orientation, odd ones of a strip too."""
    rows = {5: [0, 1, 3, 2], 6: [0, 1, 2, 3]}
    document = Document()
    parts = [document.primitive]
    for mode, indices in rows.items():
        parts.append({"attributes": document.attributes, "mode": mode})
        parts[-1]["indices"] = document.array(np.array(indices, "u1"))
    document.tree["meshes"] = [{"primitives": parts}]
    across = trimesh.triangles.cross(places(document.load(tmp_path)))
    assert across.tolist() == [[0, 0, 1]] * 6


def test_nodes(tmp_path):
    half = np.sqrt(0.5)
    matrix = [0, 2, 0, 0, -2, 0, 0, 0, 0, 0, 2, 0, 5, 6, 7, 1]  # by columns
    nodes = [
        {"children": [1, 2], "translation": [1, 2, 3]},
        {"mesh": 0, "rotation": [0, 0, half, half], "scale": [2, 3, 1]},
        {"mesh": 0, "matrix": matrix},
        {"mesh": 0},  # in no scene
    ]
    mesh = Document(nodes=nodes, scenes=[{"nodes": [0]}]).load(tmp_path)
    square = SQUARE[CORNERS.reshape(2, 3)].astype(float)
    turned = square[..., [1, 0, 2]] * [-3, 2, 1] + [1, 2, 3]
    np.testing.assert_allclose(places(mesh)[:2], turned, atol=1e-6)
    np.testing.assert_allclose(places(mesh)[2:], square[..., [1, 0, 2]] * [-2, 2, 2] + [6, 8, 10])


def instanced(**attributes):
    """Return the square, repeated by a node that moves all instances by (0, 0, 3)."""
    document = Document()
    given = {name: document.array(np.asarray(rows)) for name, rows in attributes.items()}
    extension = {"EXT_mesh_gpu_instancing": {"attributes": given}}
    document.tree["nodes"] = [{"mesh": 0, "translation": [0, 0, 3], "extensions": extension}]
    document.tree["extensionsUsed"] = ["EXT_mesh_gpu_instancing"]
    return document


def test_instances(tmp_path):
    square = SQUARE[CORNERS.reshape(2, 3)]
    moves = np.array([[1, 2, 0], [-5, 0, 1]], "<f4")
    mesh = instanced(TRANSLATION=moves).load(tmp_path)
    np.testing.assert_array_equal(places(mesh)[:2], square + [1, 2, 3])
    np.testing.assert_array_equal(places(mesh)[2:], square + [-5, 0, 4])
    assert mesh.warnings == ["a part has no material: grey"]
    # A quarter turn about z as bytes, then a mirror, with other sizes.
    quats = np.rint(np.array([[0, 0, 0.5**0.5, 0.5**0.5], [0, 0, 0, 1]]) * 127).astype("i1")
    scales = np.array([[2, 3, 1], [-1, 1, 1]], "<f4")
    mesh = instanced(TRANSLATION=moves, ROTATION=quats, SCALE=scales, _ID=moves).load(tmp_path)
    turned = square[..., [1, 0, 2]] * [-3, 2, 1] + [1, 2, 3]
    np.testing.assert_allclose(places(mesh)[:2], turned, atol=1e-6)
    corners = places(mesh)
    across = trimesh.triangles.cross(corners)
    np.testing.assert_allclose(across[:, 2], [6, 6, 1, 1])
    assert corners[2:, :, 0].max() == -5 and corners[2:, :, 0].min() == -6
    assert len(instanced().load(tmp_path).faces) == 2


def test_instances_that_are_not_read(tmp_path):
    rows = np.ones((2, 3), "<f4")
    refused("2 x 3 numbers scale", instanced(TRANSLATION=rows[:1], SCALE=rows).load, tmp_path)
    refused("2 x 3 numbers rotation", instanced(ROTATION=rows).load, tmp_path)
    document = skinned()
    given = {"TRANSLATION": document.array(rows)}
    document.tree["nodes"][0]["extensions"] = {"EXT_mesh_gpu_instancing": {"attributes": given}}
    warning = "instances of a skinned mesh (EXT_mesh_gpu_instancing) are not supported"
    assert warning in document.load(tmp_path).warnings


def test_a_mirroring_node_keeps_the_outside(tmp_path):
    nodes = [{"mesh": 0}, {"mesh": 0, "scale": [-1, 1, 1]}]
    document = Document(nodes=nodes, scenes=[{"nodes": [0, 1]}])
    document.attributes["NORMAL"] = document.array(np.tile(np.array([0, 0, 1], "<f4"), (4, 1)))
    mesh = document.load(tmp_path)
    corners = places(mesh)
    across = trimesh.triangles.cross(corners)
    assert (across[:, 2] == 1).all() and (mesh.normals[..., 2] == 1).all()
    assert corners[2:, :, 0].max() == 0 and corners[2:, :, 0].min() == -1


def test_normals_of_a_stretched_node(tmp_path):
    """Normals follow the inverse transpose; those 40 degrees off a face would be replaced."""
    half = np.sqrt(0.5)
    tilted = {"mesh": 0, "scale": [1.2, 1, 1], "rotation": [half, 0, 0, half]}
    nodes = [{"children": [1], "scale": [1, 0.8, 1]}, tilted]
    document = Document(nodes=nodes, scenes=[{"nodes": [0]}])
    slope = np.array([0.6, 0, 0.8])  # of a surface x * 0.6 + z * 0.8 = 0
    points = SQUARE - np.outer(SQUARE[:, 0] * 0.75, [0, 0, 1])
    document.attributes["POSITION"] = document.array(points.astype("<f4"))
    document.attributes["NORMAL"] = document.array(np.tile(slope, (4, 1)).astype("<f4"))
    mesh = document.load(tmp_path)
    across = trimesh.triangles.cross(places(mesh))
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    np.testing.assert_allclose(mesh.normals, np.repeat(across[:, None], 3, 1), atol=1e-6)


def skinned(**more):
    """Return the square with its right side bound to a joint that is 10 to the right."""
    nodes = [{"mesh": 0, "skin": 0, "scale": [100, 100, 100]}, {}, {"translation": [10, 0, 0]}]
    document = Document(nodes=nodes, scenes=[{"nodes": [0, 1, 2]}])
    joints = np.array([[0, 0, 0, 0], [1, 0, 0, 0], [1, 0, 0, 0], [0, 0, 0, 0]], "u1")
    document.attributes["JOINTS_0"] = document.array(joints)
    document.attributes["WEIGHTS_0"] = document.array(np.eye(4, dtype="<f4")[[0, 0, 0, 0]])
    inverse = np.tile(np.eye(4, dtype="<f4"), (2, 1, 1))
    inverse[1, 3, 0] = -8  # by columns
    matrices = document.array(inverse.reshape(2, 16))
    document.tree["skins"] = [{"joints": [1, 2], "inverseBindMatrices": matrices} | more]
    return document


def test_skins_follow_their_joints(tmp_path):
    mesh = skinned().load(tmp_path)
    want = np.array([[0, 0, 0], [3, 0, 0], [3, 1, 0], [0, 1, 0]])[CORNERS.reshape(2, 3)]
    np.testing.assert_allclose(places(mesh), want)
    for changes in ({"joints": [1, 9]}, {"joints": []}):
        mesh = skinned(**changes).load(tmp_path)
        assert "a skin with joints outside of the scene is not applied" in mesh.warnings
        assert places(mesh).max() == 1  # the node of a skinned mesh does not move it
    document = skinned(joints=[1])
    refused("JOINTS_0 or WEIGHTS_0 is invalid", document.load, tmp_path)


def test_weights_of_a_skin(tmp_path):
    """A vertex without weights follows the first joint; a second set of joints adds to the sum."""
    document = skinned()
    weights = np.array([[1, 0, 0, 0], [0, 0, 0, 0], [2, 0, 0, 0], [1, 0, 0, 0]], "<f4")
    document.attributes["WEIGHTS_0"] = document.array(weights)
    mesh = document.load(tmp_path)
    want = np.array([[0, 0, 0], [1, 0, 0], [3, 1, 0], [0, 1, 0]])[CORNERS.reshape(2, 3)]
    np.testing.assert_allclose(places(mesh), want)
    document.attributes["JOINTS_1"] = document.array(np.tile(np.array([1, 0, 0, 0], "u1"), (4, 1)))
    document.attributes["WEIGHTS_1"] = document.array(np.eye(4, dtype="<f4")[[0, 0, 0, 0]])
    mesh = document.load(tmp_path)
    want = np.array([[1, 0, 0], [3, 0, 0], [3, 1, 0], [1, 1, 0]])[CORNERS.reshape(2, 3)]
    np.testing.assert_allclose(places(mesh), want)
    document.attributes["JOINTS_1"] = document.array(np.full((4, 4), 2, "u1"))
    refused("JOINTS_1 or WEIGHTS_1 is invalid", document.load, tmp_path)


@pytest.mark.parametrize("at, valid", [(3, True), (4, False)])
def test_the_last_sparse_index(tmp_path, at, valid):
    document = Document()
    sparse = document.sparse(np.array([at], "u1"), [0, 1, 5])
    document.attributes["POSITION"] = document.array(SQUARE, sparse=sparse)
    if valid:
        assert places(document.load(tmp_path))[1, 2].tolist() == [0, 1, 5]
    else:
        refused("changes value 4 of 4", document.load, tmp_path)


def test_morph_targets_and_sparse_values(tmp_path):
    document = Document()
    sparse = document.sparse(np.array([2], "<u2"), [0, 0, 5])
    accessor = {"componentType": 5126, "type": "VEC3", "count": 4, "sparse": sparse}
    document.tree["accessors"].append(accessor)
    document.primitive["targets"] = [{"POSITION": len(document.tree["accessors"]) - 1}]
    assert not places(document.load(tmp_path))[..., 2].any()
    document.tree["meshes"][0]["weights"] = [0.5]
    assert places(document.load(tmp_path))[..., 2].max() == 2.5
    document.tree["nodes"][0]["weights"] = [2]
    assert places(document.load(tmp_path))[..., 2].max() == 10
    document.tree["nodes"][0]["weights"] = []
    refused(r"nodes\[0\].weights: Expected .* of length >= 1", document.load, tmp_path)
    del document.tree["nodes"][0]["weights"]
    document.attributes["POSITION"] = document.array(SQUARE, sparse=sparse)
    document.primitive["targets"] = []
    assert places(document.load(tmp_path))[:, :, 2].tolist() == [[0, 0, 5], [0, 5, 0]]


def test_names_of_other_files_may_be_encoded(tmp_path):
    folder = tmp_path / "inner"
    folder.mkdir()
    document = Document().paint()
    Image.fromarray(PAINT).save(folder / "wood dark.png")
    document.tree["images"] = [{"uri": "wood%20dark.png"}]
    document.tree["buffers"] = [{"byteLength": len(document.binary), "uri": "my%20model.bin"}]
    (folder / "my model.bin").write_bytes(document.binary)
    path = folder / "a.gltf"
    path.write_text(json.dumps(document.tree))
    mesh = load_mesh(path)
    assert mesh.materials[0].texture is not None and not mesh.warnings
    # The decoded name is what must stay inside of the folder.
    (tmp_path / "out.bin").write_bytes(document.binary)
    for name in ("..%2Fout.bin", "%2e%2e/out.bin", "%2e%2e%5cout.bin", str(tmp_path / "out.bin")):
        document.tree["buffers"][0]["uri"] = name
        path.write_text(json.dumps(document.tree))
        refused("not found|outside of .*inner, not read", load_mesh, path)
    data = "data:application/octet-stream;base64," + base64.b64encode(document.binary).decode()
    document.tree["buffers"][0]["uri"] = data
    path.write_text(json.dumps(document.tree))
    assert len(load_mesh(path).faces) == 2


def with_primitive(**primitive):
    return lambda d: d.tree["meshes"][0]["primitives"].append(primitive)


def with_array(name, values):
    return lambda d: d.attributes.update({name: d.array(values)})


def with_texture(**texture):
    return lambda d: d.tree.update(textures=[texture], samplers=[{"wrapS": 33071}])


def with_surface(**material):
    return lambda d: d.tree["materials"][0].update(material)


UNREAD = {
    **{
        f"only triangles are read, not {name}": with_primitive(attributes={"POSITION": 0}, mode=i)
        for i, name in enumerate(("points", "lines", "a line loop", "a line strip"))
    },
    "a primitive without POSITION is ignored": with_primitive(attributes={}),
    "COLOR_0 of 3 x 3 numbers is ignored": with_array("COLOR_0", SQUARE[:3]),
    "NORMAL of 3 x 3 numbers is ignored": with_array("NORMAL", SQUARE[:3]),
    "TEXCOORD_0 of 4 x 3 numbers is ignored": with_array("TEXCOORD_0", SQUARE),
    **{
        f"a texture's image is named by {name}, which is not supported": with_texture(**texture)
        for name, texture in (
            ("nothing", {}),
            ("KHR_texture_basisu", {"extensions": {"KHR_texture_basisu": {"source": 0}}}),
            ("MSFT_texture_dds", {"extensions": {"MSFT_texture_dds": {"source": 0}}}),
        )
    },
    "a clamped or mirrored texture is drawn as a repeating one": with_texture(source=0, sampler=0),
    "a.png: not found": lambda d: d.tree.update(images=[{"uri": "a.png"}]),
    "an unlit surface is drawn shaded": with_surface(extensions={"KHR_materials_unlit": {}}),
    "emission of a surface with a base colour is not drawn": with_surface(emissiveFactor=[0, 1, 0]),
    "metallicRoughnessTexture is not drawn": with_surface(
        pbrMetallicRoughness={"metallicRoughnessTexture": {"index": 0}}
    ),
    **{
        f"{name} is not drawn": with_surface(**{name: {"index": 0}})
        for name in ("normalTexture", "occlusionTexture")
    },
    **{
        f"the extension {name} is not supported": with_surface(extensions={name: {}})
        for name in ("KHR_materials_clearcoat", "KHR_materials_transmission", "MSFT_lod")
    },
    "the extension ADOBE_x is not supported": lambda d: d.tree.update(extensionsUsed=["ADOBE_x"]),
    "one of 2 scenes is read": lambda d: d.tree["scenes"].append({}),
    "the file needs a reader of glTF 2.1, and is read as 2.0": (
        lambda d: d.tree["asset"].update(minVersion="2.1")
    ),
}


@pytest.mark.parametrize("warning", UNREAD)
def test_unread_content_is_named(tmp_path, warning):
    document = Document().paint()
    document.attributes["TEXCOORD_0"] = document.array(2 * UVS)  # beyond 1, where it repeats
    assert not document.load(tmp_path).warnings
    UNREAD[warning](document)
    mesh = document.load(tmp_path)
    assert warning in mesh.warnings and len(mesh.faces) == 2


def test_names_that_look_like_extensions(tmp_path):
    document = Document(nodes=[{"mesh": 0, "name": "LP_body"}]).paint()
    document.attributes["_BATCHID"] = 0
    assert not document.load(tmp_path).warnings


@pytest.mark.parametrize(
    "name", ["KHR_draco_mesh_compression", "EXT_meshopt_compression", "KHR_meshopt_compression"]
)
def test_packed_triangles_are_refused_by_name(tmp_path, name):
    """A plain copy beside them is read."""
    document = Document(extensionsUsed=[name])
    assert len(document.load(tmp_path).faces) == 2
    del document.tree["accessors"][0]["bufferView"]
    refused(f"compressed by {name}", document.load, tmp_path)
    document = Document(extensionsRequired=[name])
    refused(f"compressed by {name}", document.load, tmp_path)
