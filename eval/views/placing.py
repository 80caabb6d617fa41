"""The meshes of training objects that the retrieval took, placed as shapes of the test objects."""

from __future__ import annotations

from pathlib import Path

from gamba_warp.cameras import relative_to_reference
from gamba_warp.data.dataset import ViewDataset
from gamba_warp.errors import UserError
from gamba_warp.formats.catalogue import find_meshes
from gamba_warp.formats.meshes import default_up, load_mesh
from gamba_warp.surfaces.extract import Surface
from gamba_warp.surfaces.files import save_mesh

from .baselines import Found


class TrainingMeshes:
    """The meshes that a dataset was rendered from, by uid.

    As for ``eval-geometry``, a file is turned to z-up by its suffix, after the rotation that
    ``catalogue.json`` states, its bounding box is centred, and its longest side becomes 1: the
    world of the views, unless they were rendered with ``--stretch``.
    """

    def __init__(self, folder: Path, training: ViewDataset) -> None:
        """Finds the files; none is read yet.

        Raises:
            UserError: there is no folder, no mesh of any training object, or a bad catalogue.
        """
        self.training = training
        self.meshes = {mesh.uid: mesh for mesh in find_meshes(folder)}
        if not self.meshes.keys() & set(training.uids):
            raise UserError(f"{folder}: has a mesh of none of the {len(training)} training objects")

    def place(self, found: Found, distance: float) -> Surface:
        """The mesh of an object, so turned and sized that its view is the input picture.

        Args:
            found: the object, and the view that was taken for the input.
            distance: of the input camera from the object's centre in the world of the result.

        Returns:
            Triangles in the input camera's world: its axes, the object's centre as the origin.

        Raises:
            UserError: there is no such mesh, or it or the view cannot be read.
        """
        if found.uid not in self.meshes:
            raise UserError(f"there is no mesh of the training object {found.uid}")
        mesh = self.meshes[found.uid]
        upright, _, _ = load_mesh(mesh.path).normalized(default_up(mesh.path), mesh.rotation)
        viewmat = self.training.load(found.uid, views=[found.view]).cameras.viewmats[0].double()
        _, scale = relative_to_reference(viewmat[None], viewmat, distance)
        vertices = scale.item() * upright.vertices @ viewmat[:3, :3].numpy().T
        return Surface(vertices, upright.faces)

    def save(self, path: Path, found: Found, distance: float) -> None:
        """Writes what ``place`` returns as a ``.ply``; the errors are those of both."""
        surface = self.place(found, distance)
        path.parent.mkdir(parents=True, exist_ok=True)
        save_mesh(path, surface, "opencv")
