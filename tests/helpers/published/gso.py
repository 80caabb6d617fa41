"""Models in the published layout of Google Scanned Objects, small."""

import zipfile
from pathlib import Path

import numpy as np
from PIL import Image

from helpers.images import bytes_of

# Metadata of a model, with another name.
PBTXT = """model {
  file: "model.sdf"
}
name: "A_BOX"
description: "A BOX\\nThis basic box has two colors."
version: 1
authors {
  name: "Google"
  email: "scanned-objects@google.com"
}
legal {
  copyright: "Copyright 2020 Google LLC."
  license: "Creative Commons Attribution 4.0 International"
}
annotations {
  key: "brand"
  value: "PlanToys"
}
categories {
  first: "Toys"
}
"""
MTL = """# Copyright 2020 Google LLC.
newmtl material_0
# shader_type beckmann
map_Kd texture.png

# Kd: Diffuse reflectivity.
Kd 1.000000 1.000000 1.000000
"""
# A box of 2 x 1 x 4, z up. Its front (-y) and sides show the texture's left half, its back the
# right half.
_CORNERS = [(x, y, z) for x in (-1, 1) for y in (-0.5, 0.5) for z in (-2, 2)]
_FACES = [
    ((0, 4, 5, 1), 1),
    ((6, 2, 3, 7), 2),
    ((2, 0, 1, 3), 1),
    ((4, 6, 7, 5), 1),
    ((1, 5, 7, 3), 1),
    ((0, 2, 6, 4), 1),
]


def obj() -> str:
    """The mesh's text."""
    rows = ["mtllib model.mtl", "usemtl material_0"]
    rows += [f"v {x} {y} {z}" for x, y, z in _CORNERS]
    rows += ["vt 0.25 0.5", "vt 0.75 0.5"]
    rows += ["f " + " ".join(f"{c + 1}/{texel}" for c in face) for face, texel in _FACES]
    return "\n".join(rows) + "\n"


def texture() -> bytes:
    """An image, red on the left and blue on the right."""
    pixels = np.zeros((8, 8, 3), np.uint8)
    pixels[:, :4, 0] = pixels[:, 4:, 2] = 255
    return bytes_of(Image.fromarray(pixels))


def files() -> dict[str, bytes]:
    """Content of a model's folder."""
    return {
        "model.config": b"<model></model>",
        "model.sdf": b"<sdf></sdf>",
        "metadata.pbtxt": PBTXT.encode(),
        "meshes/model.obj": obj().encode(),
        "meshes/model.mtl": MTL.encode(),
        "materials/textures/texture.png": texture(),
        **{f"thumbnails/{number}.jpg": b"an image" for number in range(5)},
    }


def write_model(root: Path, name: str) -> Path:
    """Write a model's folder."""
    for place, data in files().items():
        path = root / name / place
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(data)
    return root / name


def write_zip(root: Path, name: str, top: str = "") -> Path:
    """Write a model's zip like the Fuel server, or with a folder around everything."""
    root.mkdir(parents=True, exist_ok=True)
    with zipfile.ZipFile(root / f"{name}.zip", "w", zipfile.ZIP_DEFLATED) as archive:
        for place, data in files().items():
            archive.writestr(top + place, data)
    return root / f"{name}.zip"
