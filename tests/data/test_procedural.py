"""Procedural objects: closed, bounded, reproducible, all different."""

import numpy as np
import pytest
import trimesh
from helpers.refusals import refused

from gamba_warp.data.dataset import split_of
from gamba_warp.formats.catalogue import find_meshes
from gamba_warp.formats.meshes import load_mesh
from gamba_warp.train.data.procedural import make_object, textures
from gamba_warp.train.data.procedural.looks import MAX_FACES
from gamba_warp.train.sources.commands import data_procedural_command

DRAWN = 48


@pytest.fixture(scope="module")
def objects():
    """The first objects of a seed."""
    return [make_object(np.random.default_rng([5, number])) for number in range(DRAWN)]


def test_every_object_is_unlike_all_others(objects):
    assert len({tuple(np.ptp(mesh.vertices, axis=0)) for mesh in objects}) == len(objects)


def test_the_same_seed_gives_the_same_bits(objects):
    for number in (0, 7, 14, 21):
        again, first = make_object(np.random.default_rng([5, number])), objects[number]
        for name in ("vertices", "faces", "normals", "uvs", "colors", "material_ids"):
            assert np.array_equal(getattr(again, name), getattr(first, name)), name
        for one, other in zip(again.materials, first.materials, strict=True):
            assert np.array_equal(one.color, other.color)
            assert (one.texture is None) == (other.texture is None)
            assert one.texture is None or np.array_equal(one.texture, other.texture)


def test_objects_are_closed_and_have_a_volume(objects):
    for number, mesh in enumerate(objects):
        # Each edge is used equally often in both directions.
        edges = mesh.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
        here, back = (a * len(mesh.vertices) + b for a, b in (edges.T, edges.T[::-1]))
        assert np.array_equal(np.sort(here), np.sort(back)), number
        volume = np.linalg.det(mesh.vertices[mesh.faces]).sum() / 6
        assert volume > 1e-4 * np.ptp(mesh.vertices, axis=0).max() ** 3, number


def test_objects_are_bounded_and_sound(objects):
    thin = 0
    for mesh in objects:
        assert 12 <= len(mesh.faces) <= MAX_FACES
        for values in (mesh.vertices, mesh.normals, mesh.uvs):
            assert np.isfinite(values).all()
        # A face's normals are unit and on its own side, except for slivers.
        across = trimesh.triangles.cross(mesh.vertices[mesh.faces])
        area = np.linalg.norm(across, axis=1)
        big = area > 1e-6 * area.sum()
        assert np.allclose(np.linalg.norm(mesh.normals, axis=2), 1, atol=1e-3)
        own = (mesh.normals[big] * (across[big] / area[big, None])[:, None]).sum(2)
        assert own.min() > 0.7  # cos 40 degrees is .77; the normals are float32
        assert mesh.material_ids.max() < len(mesh.materials) and not mesh.warnings
        sides = np.ptp(mesh.vertices, axis=0)
        thin += sides.min() < 0.02 * sides.max()
    assert thin <= 2


def test_textures_are_small_and_of_colours(objects):
    for mesh in objects:
        for look in mesh.materials:
            assert ((look.color >= 0) & (look.color <= 1)).all()
            if look.texture is not None:
                assert look.texture.dtype == np.uint8 and look.texture.shape[2] == 4
                assert max(look.texture.shape[:2]) <= textures.PRINT
                assert (look.texture[..., 3] == 255).all()
    for name, pattern in textures.PATTERNS.items():
        values = pattern(np.random.default_rng(0))
        assert values.shape == (textures.SIDE,) * 2, name
        assert values.min() >= 0 and values.max() <= 1 and np.ptp(values) > 0.05, name


def test_files_are_the_same_again_and_kept_where_they_are(tmp_path, capsys):
    out = tmp_path / "made"
    assert data_procedural_command(out, count=4, seed=5) == 0
    assert "4 models" in capsys.readouterr().out
    meshes = find_meshes(out)
    assert [mesh.uid for mesh in meshes] == [f"procedural-5-0000{i}" for i in range(4)]
    assert {split_of(mesh.group) for mesh in meshes} == {"train"}
    assert {mesh.attribution["licence"] for mesh in meshes} == {"CC0 1.0"}
    before = [mesh.path.read_bytes() for mesh in meshes]
    meshes[1].path.unlink()
    meshes[2].path.write_bytes(b"kept as it is")
    data_procedural_command(out, count=4, seed=5)
    assert meshes[1].path.read_bytes() == before[1] and len(set(before)) == 4
    assert meshes[2].path.read_bytes() == b"kept as it is"


def test_files_hold_the_objects(tmp_path, objects):
    data_procedural_command(tmp_path, count=3, seed=5)
    for number, mesh in enumerate(find_meshes(tmp_path)):
        read, made = load_mesh(mesh.path), objects[number]
        assert not read.warnings and len(read.faces) == len(made.faces)
        # float32 in the file
        ends, others = ([v.min(0), v.max(0)] for v in (read.vertices, made.vertices))
        assert np.allclose(ends, others, atol=1e-5)
        names = [look.texture is not None for look in read.materials]
        used = [made.materials[i].texture is not None for i in np.unique(made.material_ids)]
        assert sorted(names) == sorted(used)


def test_another_catalogue_is_not_overwritten(tmp_path):
    (tmp_path / "catalogue.json").write_text('{"objects": []}')
    (tmp_path / "chair.glb").write_bytes(b"")
    refused("lists other objects", data_procedural_command, tmp_path, count=1)
    assert (tmp_path / "catalogue.json").read_text() == '{"objects": []}'


@pytest.mark.parametrize("options", [{"count": 0}, {"count": 100_001}, {"count": 1, "seed": -1}])
def test_absurd_options_are_refused(tmp_path, options):
    name, value = [*options.items()][-1]
    refused(f"--{name} {value}: must be", data_procedural_command, tmp_path / "out", **options)
    assert not (tmp_path / "out").exists()
