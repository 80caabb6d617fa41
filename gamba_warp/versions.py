"""Versions of this package and its dependencies, required and optional.

The core (setup.cfg, ``install_requires``) runs the kernels and the model, and turns an image with
alpha into a ``.ply``, a turntable and a page. Everything else needs an extra; ``to_install`` tells
how to install it.
"""

from __future__ import annotations

import sys
from importlib.util import find_spec
from types import ModuleType

__version__ = "0.1.0"
_USED = (
    "torch",
    "warp-lang",
    "numpy",
    "pillow",
    "safetensors",
    "timm",
    "kornia",
    "scikit-image",
    "trimesh",
    "pymeshlab",
    "open3d-cpu",
    "open3d",
    "imageio-ffmpeg",
    "onnxruntime",
    "pillow-heif",
    "gsplat",
    "tyro",
)
# The extra that brings a library, by import name. A command with its own extra names that
# instead if it holds the library too.
EXTRA_OF = {
    "backports.zstd": "spz",
    "gradio": "app",
    "gsplat": "gsplat",
    "huggingface_hub": "hub",
    "hypothesis": "stress",
    "imageio_ffmpeg": "video",
    "kornia": "eval",
    "manifold3d": "mesh",
    "onnxruntime": "photo",
    "open3d": "mesh",
    "pillow_heif": "photo",
    "pooch": "photo",
    "pymeshlab": "mesh",
    "scipy": "mesh",
    "skimage": "mesh",
    "tensorboard": "train",
    "timm": "train",
    "trimesh": "mesh",
    "webdataset": "shards",
    "xatlas": "mesh",
}
# Libraries of the evaluation of shapes, and of the procedural objects.
SHAPES = ("kornia", "manifold3d", "open3d", "pymeshlab", "scipy", "skimage", "trimesh")
PROCEDURAL = ("trimesh", "manifold3d")
HOLDS = {
    "photo": {"kornia", "onnxruntime", "pillow_heif", "pooch", "skimage"},
    "train": {"kornia", "tensorboard", "timm"},
    "mesh": {*SHAPES, "xatlas"},
    "eval": {*SHAPES, "xatlas"},
    "gsplat": {"gsplat"},
    "app": {
        *("gradio", "imageio_ffmpeg", "onnxruntime", "pillow_heif", "pooch"),
        *SHAPES,
    },
    "shards": {"webdataset"},
    "stress": {"hypothesis"},
    "all": set(EXTRA_OF),
}


def installed(*packages: str) -> dict[str, str]:
    """Return versions of the installed ones among the packages, by their names on PyPI."""
    from importlib.metadata import PackageNotFoundError, version

    versions = {}
    for package in packages:
        try:
            versions[package] = version(package)
        except PackageNotFoundError:
            continue
    return versions


def used_versions() -> dict[str, str]:
    """Return versions of this package, Python and every dependency, by name."""
    import platform

    versions = installed(*_USED)
    named = {
        "gamba_warp": __version__,
        "python": f"{platform.python_version()} on {platform.system()} {platform.machine()}",
    }
    for name in _USED:
        if name in versions or not name.startswith("open3d"):  # one of its two packages is enough
            named[name] = versions.get(name, "not installed")
    return named


def advice(library: str, command: str, extra: str = "") -> str | None:
    """Return how to install an optional library that a command needs; None for any other library.

    Args:
        library: the failed import; also a submodule, such as ``scipy.spatial``.
        command: the command that needs it.
        extra: the command's extra, if it has one.
    """
    name = library if library in EXTRA_OF else library.partition(".")[0]
    if name not in EXTRA_OF:
        return None
    if name not in HOLDS.get(extra, ()):
        extra = EXTRA_OF[name]
    return f"{command} needs {name}, which is not installed: {to_install(extra)}"


def require(*libraries: str) -> None:
    """Refuse missing libraries before any work is done.

    Args:
        libraries: import names, such as ``trimesh``.

    Raises:
        ModuleNotFoundError: one is missing; the console script prints how to get it (``advice``).
    """
    for name in libraries:
        if find_spec(name) is None:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)


def to_install(extra: str) -> str:
    """Return how to install an extra: from the checkout, or from a wheel's file.

    It names no package: the name is not registered in any index, and somebody else could register
    it.
    """
    return f"pip install '.[{extra}]' in the checkout, or 'FILE.whl[{extra}]'"


def import_open3d() -> ModuleType:
    """Return the ``open3d`` module, which is imported nowhere else.

    Its Linux wheel needs ``libusb-1.0.so.0`` from the system; ``libusb-package`` carries the
    library, and loading it first satisfies the linker without root.
    """
    import ctypes

    if "open3d" not in sys.modules and sys.platform == "linux":
        try:
            import libusb_package

            ctypes.CDLL(str(libusb_package.get_library_path()), mode=ctypes.RTLD_GLOBAL)
        except (ImportError, OSError):
            pass  # the system may have the library; else the import reports it
    import open3d

    return open3d
