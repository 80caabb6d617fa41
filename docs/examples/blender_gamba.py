"""Add-on for Blender: File, Import, "Gamba (picture or Gaussians)".

Install this file under Edit, Preferences, Add-ons. Blender's Python needs nothing else: the add-on
runs the program ``gamba``, which is installed on its own, and imports the ``.glb`` that it writes.
"""

import shutil
import subprocess
import tempfile
from pathlib import Path

import bpy
from bpy_extras.io_utils import ImportHelper

bl_info = {
    "name": "Gamba: picture to 3D",
    "author": "gamba_warp",
    "version": (0, 1, 0),
    "blender": (3, 6, 0),
    "location": "File > Import > Gamba (picture or Gaussians)",
    "description": "Import a picture, or a file of Gaussians, as a textured mesh",
    "category": "Import-Export",
}
GAUSSIANS = {".ply", ".splat", ".spz"}


class GambaPreferences(bpy.types.AddonPreferences):
    """Settings: the path of the program."""

    bl_idname = __name__
    program: bpy.props.StringProperty(
        name="Program",
        description="The command gamba: .venv/bin/gamba of a checkout",
        subtype="FILE_PATH",
        default=shutil.which("gamba") or "gamba",
    )

    def draw(self, context):
        """Show the settings."""
        self.layout.prop(self, "program")


def command(program: str, path: Path, folder: Path, faces: int, texture: int) -> list[str]:
    """Return the command that writes a ``.glb`` of a picture or of a file of Gaussians."""
    kind = "export" if path.suffix.lower() in GAUSSIANS else "reconstruct"
    made = ["--turntable", "none", "--no-page"] if kind == "reconstruct" else []
    mesh = ["--mesh", "glb", "--faces", str(faces), "--texture", str(texture)]
    return [program, kind, *mesh, *made, "--out", str(folder), "--quiet", "--", str(path)]


class ImportGamba(bpy.types.Operator, ImportHelper):
    """Import a picture, or a file of Gaussians, as a textured mesh."""

    bl_idname = "import_scene.gamba"
    bl_label = "Import with Gamba"
    bl_options = {"REGISTER", "UNDO"}
    filename_ext = ""
    filter_glob: bpy.props.StringProperty(
        default="*.png;*.jpg;*.jpeg;*.webp;*.ply;*.splat;*.spz", options={"HIDDEN"}
    )
    faces: bpy.props.IntProperty(name="Faces", default=10_000, min=100, max=1_000_000)
    texture: bpy.props.IntProperty(name="Texture, pixels", default=1024, min=64, max=8192)

    def execute(self, context):
        """Run gamba, and import what it writes; an error is shown in one line."""
        settings = context.preferences.addons[__name__].preferences
        path = Path(self.filepath)
        with tempfile.TemporaryDirectory(prefix="gamba-") as folder:
            words = command(settings.program, path, Path(folder), self.faces, self.texture)
            try:
                done = subprocess.run(words, capture_output=True, text=True)
            except OSError as error:
                self.report({"ERROR"}, f"{settings.program}: {error.strerror}")
                return {"CANCELLED"}
            made = sorted(Path(folder).rglob("*.glb"))
            if done.returncode or not made:
                lines = done.stderr.strip().splitlines() or ["gamba wrote no mesh"]
                self.report({"ERROR"}, lines[-1])
                return {"CANCELLED"}
            bpy.ops.import_scene.gltf(filepath=str(made[0]))
        return {"FINISHED"}


def menu(self, context):
    """Add the entry to File, Import."""
    self.layout.operator(ImportGamba.bl_idname, text="Gamba (picture or Gaussians)")


def register():
    """Register the add-on."""
    bpy.utils.register_class(GambaPreferences)
    bpy.utils.register_class(ImportGamba)
    bpy.types.TOPBAR_MT_file_import.append(menu)


def unregister():
    """Remove the add-on."""
    bpy.types.TOPBAR_MT_file_import.remove(menu)
    bpy.utils.unregister_class(ImportGamba)
    bpy.utils.unregister_class(GambaPreferences)
