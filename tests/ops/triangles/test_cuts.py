"""Faces that cut each other: known answers, at any turn, place and size, and pymeshlab's."""

import numpy as np
import pytest
import trimesh

from gamba_warp.kernels.triangles import cuts_itself

# A face, the corners of another one, and which of these it has in common with the first.
FACE = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
PAIRS = {
    "through": ([[0.2, 0.2, -1], [0.3, 0.2, 1], [0.2, 0.3, 1]], True),
    "an edge through an edge": ([[-1, 0.4, -0.5], [-1, 0.4, 0.5], [1, 0.4, 0.1]], True),
    "beside": ([[1.2, 1.2, -1], [1.3, 1.2, 1], [1.2, 1.3, 1]], False),
    "within its box": ([[0.8, 0.8, -1], [0.9, 0.8, 1], [0.8, 0.9, 1]], False),
    "above": ([[0.2, 0.2, 0.1], [0.3, 0.2, 1], [0.2, 0.3, 1]], False),
    "on it": ([[0.25, 0.25, 0], [0.3, 0.2, 1], [0.2, 0.3, 1]], True),
    "in its plane": ([[0.25, 0.25, 0], [2, 0.25, 0], [2, 0.5, 0]], True),
    "in its plane, within": ([[0.125, 0.125, 0], [0.25, 0.125, 0], [0.125, 0.25, 0]], True),
    "in its plane, beside": ([[0.75, 0.75, 0], [2, 0.5, 0], [2, 1, 0]], False),
    "from a corner": ([[0.0, 0, 0], [0.5, 0.5, -1], [0.5, 0.5, 1]], True),
    "from a corner, short": ([[0.0, 0, 0], [0.1, 0.1, -0.1], [0.1, 0.1, 0.1]], True),
    "from a corner, away": ([[0.0, 0, 0], [-0.5, -0.5, -1], [-0.5, -0.5, 1]], False),
    "from a corner, beside": ([[0.0, 0, 0], [0.5, -0.5, -1], [0.5, -0.5, 1]], False),
    "from a corner, in its plane": ([[0.0, 0, 0], [0.9, 0.1, 0], [0.1, 0.9, 0]], False),
    "from an edge": ([[0.0, 0, 0], [1, 0, 0], [0.5, 0.25, 0.1]], False),
    "from an edge, folded onto it": ([[0.0, 0, 0], [1, 0, 0], [0.5, 0.25, 0]], False),
}


def mesh_of(corners):
    """Vertices and faces ``[F, 3]`` of corners ``[F, 3, 3]``; those of one place are one vertex."""
    vertices, index = np.unique(np.reshape(corners, (-1, 3)), axis=0, return_inverse=True)
    return vertices, index.reshape(-1, 3)


@pytest.mark.parametrize("pair", PAIRS)
def test_pairs(pair):
    other, cut = PAIRS[pair]
    for first in range(3):
        for turn in (np.eye(3), -np.eye(3)[[1, 0, 2]], np.eye(3)[[2, 0, 1]] * [8.0, 8, 8]):
            corners = np.stack([np.roll(FACE, first, 0), other]) @ turn
            for faces in (corners, corners[::-1], corners[:, ::-1]):
                assert cuts_itself(*mesh_of(faces)) == cut


@pytest.mark.parametrize("pair", [name for name in PAIRS if "its plane" not in name])
def test_pairs_anywhere(pair):
    """Turned, far away and small, where rounding leaves no two faces in one plane."""
    if pair == "on it":  # or above it, by rounding
        return
    turn = trimesh.transformations.rotation_matrix(1.0, [1, 2, 3])[:3, :3]
    for scale, shift in ((1e-3, 1.0), (1e3, 0.0), (1.0, -7.0)):
        corners = np.stack([FACE, PAIRS[pair][0]]) @ turn * scale + shift
        assert cuts_itself(*mesh_of(corners)) == PAIRS[pair][1]


def test_meshes():
    ball = trimesh.creation.icosphere(3)
    assert not cuts_itself(ball.vertices, ball.faces)
    dented = ball.vertices.copy()
    dented[0] *= -1.01  # through the other side
    assert cuts_itself(dented, ball.faces)
    for distance, cut in ((1.9, True), (2.1, False)):
        two = trimesh.util.concatenate([ball, ball.copy().apply_translation([distance, 0.3, 0])])
        assert cuts_itself(two.vertices, two.faces) == (cut and distance < 1.95)
    flat = trimesh.creation.annulus(0.2, 1, 0.5).vertices
    assert not cuts_itself(flat, np.zeros((0, 3), int)) and not cuts_itself(
        flat, np.eye(3, dtype=int)[:1]
    )
    with pytest.raises(ValueError, match="faces has shape"):
        cuts_itself(flat, np.zeros((4, 4), int))


@pytest.mark.parametrize("seed", range(6))
def test_the_answers_of_pymeshlab(seed):
    pymeshlab = pytest.importorskip("pymeshlab")
    rng, ball = np.random.default_rng(seed), trimesh.creation.icosphere(2)
    answers = set()
    for noise in np.geomspace(0.01, 0.3, 12):
        vertices = ball.vertices + noise * rng.normal(size=ball.vertices.shape)
        meshes = pymeshlab.MeshSet()
        meshes.add_mesh(pymeshlab.Mesh(vertices, ball.faces.astype(np.int32)))
        meshes.compute_selection_by_self_intersections_per_face()
        answers.add(cut := meshes.current_mesh().selected_face_number() > 0)
        assert cuts_itself(vertices, ball.faces) == cut
    assert answers == {True, False}
