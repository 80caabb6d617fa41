"""rembg's published matting models: where a copy of them may lie, and how one is fetched.

The files and their places are those of rembg, so that who has rembg needs nothing more. rembg
itself is not used: its first import compiles numba functions for minutes (docs/photo.md).
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import urlsplit

from ..batch import progress_bar
from ..errors import first_line

_FROM = "https://github.com/danielgatis/rembg/releases/download/v0.0.0"
_SECONDS = 20  # without an answer, after which the network counts as not there


class Published(NamedTuple):
    """A model that rembg publishes.

    Attributes:
        name: of the model; its file is ``NAME.onnx``.
        md5: of the file, as rembg states it.
        megabytes: size of the file.
        licence: of the weights.
    """

    name: str
    md5: str
    megabytes: int
    licence: str

    @property
    def address(self) -> str:
        """Where it is published."""
        return f"{_FROM}/{self.name}.onnx"


# The first is the one that is fetched; of those that are there, the first is used.
PUBLISHED = (
    Published("isnet-general-use", "fc16ebd8b0c10d971d3513d564d01e29", 179, "Apache 2.0"),
    Published("u2net", "60024c5c889badc19c04ad937298a77b", 176, "Apache 2.0"),
    Published("silueta", "55e59e0d8062d2f5d013f4725ee84782", 44, "Apache 2.0"),
    Published("u2netp", "8e83ca70e441ab06c318d82300c84806", 5, "Apache 2.0"),
)


class NotFetched(Exception):
    """The model could not be fetched; the text says why, in one line."""


def _homes() -> tuple[Path, Path]:
    """The folder of rembg, and the one that it had before: it looks into both itself."""
    chosen, data = os.environ.get("U2NET_HOME"), os.environ.get("XDG_DATA_HOME")
    if chosen:
        return Path(chosen).expanduser(), Path(chosen).expanduser()
    new = os.environ.get("REMBG_HOME") or (f"{data}/rembg" if data else "~/.rembg")
    return Path(os.path.expanduser(new)), Path(os.path.expanduser(f"{data or '~'}/.u2net"))


def kept() -> Path | None:
    """A published model that lies in rembg's folders, the best that is there; None if none is."""
    home, former = _homes()
    for model in PUBLISHED:
        file = f"{model.name}.onnx"
        for path in (home / "models" / model.name / file, former / file):
            if path.is_file():
                return path
    return None


def may_fetch() -> bool:
    """Whether the network may be asked: not where ``GAMBA_OFFLINE`` is set."""
    return os.environ.get("GAMBA_OFFLINE", "0") in ("", "0")


def is_address(file: str | Path | None) -> bool:
    """Whether this is an address of the web, and not the name of a file."""
    return str(file).startswith(("https://", "http://"))


def published(address: str) -> Published | None:
    """The model whose file an address names; None for any other file, whose digest nobody knows."""
    name = urlsplit(address).path.rpartition("/")[2]
    return next((model for model in PUBLISHED if name == f"{model.name}.onnx"), None)


def fetch(model: Published, address: str) -> Path:
    """Fetches a model into rembg's folder, with its progress on stderr.

    The file has its name only when all of it is there and its digest is right.

    Args:
        model: which one.
        address: of the file; any copy will do, for its digest is compared.

    Raises:
        ModuleNotFoundError: pooch is not installed.
        NotFetched: there is no network, the file is not what it should be, or cannot be written.
    """
    import pooch

    pooch.get_logger().setLevel("ERROR")
    bar: Any = progress_bar(total=model.megabytes * 10**6, unit="B", unit_scale=True)
    # Any: pooch's own types know no such bar, and no arguments by name.
    downloader: Any = pooch.HTTPDownloader(progressbar=bar, timeout=_SECONDS)
    try:
        found = pooch.retrieve(
            address,
            known_hash=f"md5:{model.md5}",
            fname=f"{model.name}.onnx",
            path=_homes()[0] / "models" / model.name,
            downloader=downloader,
        )
    except Exception as error:  # of requests, of urllib3, of the disk, and a ValueError of pooch
        reason = first_line(error)[:200]
        # requests puts several errors into one another
        names = {type(error).__name__, type(error.__context__).__name__}
        if names & {"ConnectionError", "ConnectTimeout", "ReadTimeout", "ProxyError", "SSLError"}:
            reason = f"{urlsplit(address).hostname} cannot be reached"
        raise NotFetched(reason) from error
    return Path(found)
