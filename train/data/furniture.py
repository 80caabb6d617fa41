"""820 free textured furniture models, ready for ``gamba data render``.

These are Sweet Home 3D's furniture libraries of Debian's package ``sweethome3d-furniture``: five
``.sh3f`` zip files of OBJ models, each with a 128x128 RGBA icon, a name and a creator. All are
CC BY 3.0 or CC0; the attribution goes into ``catalogue.json`` and from there into every rendered
object.
"""

from __future__ import annotations

import re
import shutil
import subprocess
import tempfile
import zipfile
from collections import Counter
from pathlib import Path, PurePosixPath

from gamba_warp.batch import progress_bar
from gamba_warp.errors import UserError
from gamba_warp.files import PART, atomic_folder, output_folder, write_json
from gamba_warp.formats.catalogue import CATALOGUE, check_rotation
from gamba_warp.untrusted.archives import open_zip
from gamba_warp.untrusted.names import parts_of, plain_name

from .groups import ObjectInfo, split_groups, textures_of

PACKAGE = "sweethome3d-furniture"
INSTALLED = Path("/usr/share/sweethome3d/furniture")
_PROPERTIES = "PluginFurnitureCatalog.properties"
_MAX_TEXT = _MAX_ICON = 16 << 20  # bytes; published ones have a few kB
_TEXT = {"capture_output": True, "encoding": "utf-8", "errors": "replace"}
_BY = "https://creativecommons.org/licenses/by/3.0/"

# By library: the creator to credit, if not each model's; the licence; the URL of its text.
LIBRARIES: dict[str, tuple[str, str, str]] = {
    "BlendSwap-CC-0": ("", "CC0 1.0", "https://creativecommons.org/publicdomain/zero/1.0/"),
    "BlendSwap-CC-BY": ("", "CC BY 3.0", _BY),
    "KatorLegaz": ("Andrew Kator & Jennifer Legaz", "CC BY 3.0 US", _BY + "us/"),
    "Reallusion": ("Reallusion, www.reallusion.com", "CC BY 3.0 US", _BY + "us/"),
    "Scopia": (
        "Scopia Visual Interfaces Systems, s.l. and Emmanuel Puybaret / eTeks",
        "CC BY 3.0",
        _BY,
    ),
}


def get_furniture(out: Path, deb: Path | None = None, tree: Path | None = None) -> int:
    """Unpack the libraries, and write the catalogue of all models.

    Args:
        out: folder for the models, their icons and catalogue.json.
        deb: the package file, or None.
        tree: folder with the .sh3f files, or None. Without both, the installed package is used, or
            apt-get downloads it.

    Returns:
        The number of models.

    Raises:
        UserError: no library is found, one is damaged, or two models have the same name.
    """
    out, objects = output_folder(out), []
    with tempfile.TemporaryDirectory(dir=out, prefix=PART) as scratch:
        paths = sorted(_find_libraries(deb, tree, Path(scratch)).glob("*.sh3f"))
        if not paths:
            raise UserError(f"{deb or tree or INSTALLED}: contains no .sh3f libraries")
        for path in paths:
            try:
                objects += unpack_library(path, out)
            except UserError as error:  # name the package, not the temporary folder
                reason = str(error).replace(f"{scratch}/", f"{deb or PACKAGE}: ")
                raise UserError(reason) from error
    counts = Counter(entry["uid"] for entry in objects)
    if repeated := next((uid for uid, count in counts.items() if count > 1), None):
        raise UserError(f"two models are called {repeated}")
    groups = split_groups(
        [
            ObjectInfo(e["uid"], e["model"].split("/")[0], e["name"], textures_of(out / e["model"]))
            for e in objects
        ]
    )
    objects = [{**entry, "group": groups[entry["uid"]]} for entry in objects]
    write_json(out / CATALOGUE, {"objects": sorted(objects, key=lambda entry: entry["uid"])})
    return len(objects)


def _find_libraries(deb: Path | None, tree: Path | None, scratch: Path) -> Path:
    """Return the folder of the .sh3f files."""
    if tree is not None:
        if not tree.is_dir():
            raise UserError(f"{tree}: no such folder")
        library = next(iter(sorted(tree.rglob("*.sh3f"))), None)
        return library.parent if library else tree
    if deb is None:
        if INSTALLED.is_dir():
            return INSTALLED
        deb = _download(scratch)
    if not deb.is_file():
        raise UserError(f"{deb}: no such file")
    if shutil.which("dpkg-deb") is None:
        raise UserError(f"dpkg-deb is missing: unpack {deb}, and pass the folder as --tree")
    result = subprocess.run(["dpkg-deb", "--extract", str(deb), str(scratch / "deb")], **_TEXT)
    if result.returncode:
        raise UserError(f"{deb}: cannot be unpacked ({result.stderr.strip()})")
    return _find_libraries(None, scratch / "deb", scratch)


def _download(folder: Path) -> Path:
    """Download Debian's package with apt-get, which does not need root for this."""
    if shutil.which("apt-get") is None:
        raise UserError(
            f"apt-get is missing: get {PACKAGE}_*_all.deb from a Debian mirror and pass it as --deb"
        )
    print(f"downloading {PACKAGE} (125 MB) with apt-get")
    command = ["apt-get", "download", PACKAGE]
    result = subprocess.run(command, cwd=folder, **_TEXT)
    if result.returncode:  # a fresh container has no package lists
        subprocess.run(["apt-get", "update"], capture_output=True)
        result = subprocess.run(command, cwd=folder, **_TEXT)
    files = sorted(folder.glob("*.deb"))
    if result.returncode or not files:
        reason = (result.stderr.strip().splitlines() or ["no file was downloaded"])[-1]
        raise UserError(f"apt-get download {PACKAGE}: {reason}; or pass the file as --deb")
    return files[0]


def read_properties(data: bytes) -> dict[str, str]:
    """Parse a Java ``.properties`` file: ``key=value`` lines in Latin-1, other letters escaped."""
    text = re.sub(r"\\\r?\n[ \t]*", "", data.decode("latin-1"))
    text = re.sub(r"\\u([0-9a-fA-F]{4})", lambda match: chr(int(match[1], 16)), text)
    pairs = (line.partition("=") for line in text.splitlines() if not line.lstrip().startswith("#"))
    return {key.strip(): value.strip() for key, sign, value in pairs if sign}


def unpack_library(path: Path, out: Path) -> list[dict]:
    """Unpack one .sh3f into a folder of its name, unless it exists, and its icons.

    Returns:
        The library's catalogue entries.

    Raises:
        UserError: the file is not a zip, lacks a furniture catalogue or has a forbidden member, or
            the folder exists and lacks a model.
    """
    library = plain_name(path.stem, str(path))
    if library.lower() in ("icons", CATALOGUE):
        raise UserError(f"{path}: a library cannot be called {library}")
    if not path.is_file() or not zipfile.is_zipfile(path):  # reading a pipe would never end
        raise UserError(f"{path}: not a furniture library (not a zip file)")
    with open_zip(path) as archive:
        catalogue = read_properties(archive.read(_PROPERTIES, _MAX_TEXT))
        members = [name for name in archive.names if not name.endswith(".properties")]
        numbers = [key.partition("#")[2] for key in catalogue if key.startswith("model#")]
        try:
            entries = [_entry(library, catalogue, number, path) for number in numbers]
            images = [catalogue[f"icon#{number}"].lstrip("/") for number in numbers]
        except KeyError as error:
            raise UserError(f"{path}: not a furniture library (no {error})") from error
        missing = {e["model"].removeprefix(f"{library}/") for e in entries} - {*members}
        if missing:
            raise UserError(f"{path}: not a furniture library ({min(missing)!r} is missing)")
        icons = [archive.read(image, _MAX_ICON) for image in images]
        if not (out / library).exists():
            with atomic_folder(out / library) as part:
                for member in progress_bar(members, desc=library, unit="file", leave=False):
                    archive.unpack(member, part)
    for entry, icon in zip(entries, icons):
        if not (out / entry["model"]).is_file():
            raise UserError(f"{out / library}: is not the library {path}; move it away")
        (output_folder(out / "icons") / f"{entry['uid']}.png").write_bytes(icon)
    return entries


def _entry(library: str, catalogue: dict[str, str], number: str, path: Path) -> dict:
    """Entry of one model in catalogue.json; raises KeyError if a line of it is missing."""
    source = f"{path}: model {number}"
    model = PurePosixPath(*parts_of(catalogue[f"model#{number}"].lstrip("/"), source))
    uid = re.sub(r"[^\w.-]+", "_", f"{library}-{model.parent.name}".lower())
    name = " ".join(catalogue.get(f"name#{number}", model.stem).split())
    credit, licence, text = LIBRARIES.get(library, ("", catalogue.get("license", ""), ""))
    origin = catalogue.get("name", library)
    entry = {
        "uid": plain_name(uid, source),
        "name": name,
        "category": catalogue.get(f"category#{number}", ""),
        "model": f"{library}/{model}",
        "attribution": {
            "creator": credit or catalogue.get(f"creator#{number}", "unknown"),
            "licence": licence,
            "licence_text": text,
            "source": f"Sweet Home 3D furniture library '{origin}'",
        },
    }
    if f"modelRotation#{number}" in catalogue:
        entry["rotation"] = check_rotation(
            catalogue[f"modelRotation#{number}"].split(), source
        ).tolist()
    return entry
