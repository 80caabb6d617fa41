"""Objects in the published layouts of G-Objaverse, small."""

import json
import math
from pathlib import Path

import numpy as np
from PIL import Image

from helpers.images import bytes_of

# 25 views on an orbit, of which the last repeats the first, top and bottom, 13 on another orbit.
VIEWS = 40
ELEVATION = {number: 20.0 for number in range(25)} | {25: 89.9, 26: -89.9}
ELEVATION |= {number: 2.0 for number in range(27, 40)}
SIZE = 32  # those of the set have 512
FOV = 2 * math.atan(0.5 * 1024 / 1422.222)
# Unused files beside a view's image and camera.
OTHERS = ("_albedo.png", "_hdr.exr", "_mr.png", "_nd.exr", "_ng.exr")


def camera(number: int) -> dict:
    """The camera of a view: its OpenCV axes in a z-up world, position and distance."""
    azimuth = math.radians(15.0 * number if number < 25 else 30.0 * (number - 27))
    elevation = math.radians(ELEVATION[number])
    distance = 1.2 + 0.01 * number
    flat, height = math.cos(elevation), math.sin(elevation)
    back = np.array([math.cos(azimuth) * flat, math.sin(azimuth) * flat, height])
    right = np.array([-math.sin(azimuth), math.cos(azimuth), 0.0])
    down = np.cross(right, back)
    vectors = {"x": right, "y": down, "z": -back, "origin": distance * back}
    return {name: x.tolist() for name, x in vectors.items()} | {"distance": distance}


def files_of(number: int) -> dict[str, bytes]:
    """The files of a view by their names after the number."""
    values = camera(number)
    values.pop("distance")
    values |= {"x_fov": FOV, "y_fov": FOV, "max_depth": 5.0}
    values["bbox"] = [[-0.5, -0.31, -0.5], [0.5, 0.31, 0.5]]
    pixels = np.zeros((SIZE, SIZE, 4), np.uint8)
    pixels[8:24, 8:24] = (200, number, 50, 255)
    image = bytes_of(Image.fromarray(pixels))
    others = {suffix: b"not read" for suffix in OTHERS}
    return {".json": json.dumps(values).encode(), ".png": image, **others}


def write_object(folder: Path, views: int = VIEWS) -> None:
    """Write an object; ``folder`` is ``ROOT/dictionary_id/instance_id``."""
    for number in range(views):
        view = folder / "campos_512_v4" / f"{number:05d}"
        view.mkdir(parents=True)
        for suffix, data in files_of(number).items():
            (view / f"{number:05d}{suffix}").write_bytes(data)
