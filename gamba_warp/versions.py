"""The version of this package, and those of other packages that decide what is computed."""

from __future__ import annotations

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
    "tyro",
)


def installed(*packages: str) -> dict[str, str]:
    """Versions of those of the packages that are installed, by their names on PyPI."""
    from importlib.metadata import PackageNotFoundError, version

    found = {}
    for package in packages:
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            continue
    return found


def used_versions() -> dict[str, str]:
    """Versions of this package, of Python and of every package that is used, by name."""
    import platform

    found = installed(*_USED)
    named = {
        "gamba_warp": __version__,
        "python": f"{platform.python_version()} on {platform.system()} {platform.machine()}",
    }
    for name in _USED:
        if name in found or not name.startswith("open3d"):  # one of its two packages is enough
            named[name] = found.get(name, "not installed")
    return named
