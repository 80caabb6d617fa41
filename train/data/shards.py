"""Shards: the views of many objects in tar files, which the package ``webdataset`` reads.

A folder of shards, here or on a server, has an index of each split, ``shards-train.json``: names
of tars and numbers of their objects. An object is one sample: ``KEY.json`` with the content of
``transforms.json``, and its images, ``KEY.000.webp``, by their names without ``KEY.``. ``KEY`` is
the quoted uid; as WebDataset ends a key at the first dot, a dot is written as ``%2E``.
"""

from __future__ import annotations

import io
import re
import warnings
from collections.abc import Iterator
from contextlib import suppress
from functools import partial
from http.client import HTTPException
from itertools import repeat
from pathlib import Path
from typing import Annotated, Any
from urllib.parse import unquote
from urllib.request import urlopen

import msgspec
from msgspec import Meta

from gamba_warp.data.dataset import ViewDataset
from gamba_warp.data.gso import scanned
from gamba_warp.data.layouts import MemoryImage, ObjectFiles, object_of
from gamba_warp.errors import FileWarning, UserError, first_line
from gamba_warp.untrusted.documents import MAX_BYTES, parse_document, read_bytes

INDEX = "shards-{}.json"  # of a split
BUFFER = 100  # objects mixed at a time, with the bytes of their images
SILENCE = 60.0  # seconds without a byte that end a transfer
_ADDRESS = re.compile("https?://[A-Za-z0-9][A-Za-z0-9_.:/@%~+-]{0,999}")


class Unreachable(UserError):
    """A shard cannot be read: its objects are not at fault, so the training stops."""


class _Shard(msgspec.Struct):
    url: Annotated[str, Meta(pattern=r"^[A-Za-z0-9_][A-Za-z0-9_.-]{0,99}\Z")]
    nsamples: Annotated[int, Meta(ge=1, le=10**9)]


class _Index(msgspec.Struct):
    shardlist: Annotated[list[_Shard], Meta(min_length=1)]


def shards_at(source: Path) -> str | None:
    """Return a folder of shards, or their address on a server; None for any other path.

    Raises:
        UserError: an address of another kind.
    """
    address = re.sub("^([a-z0-9]+):/+", r"\1://", str(source))  # a path has lost one slash
    if _ADDRESS.fullmatch(address):
        return address
    if "://" in address and not source.is_dir():
        raise UserError(f"{address}: only http:// and https:// addresses can be read")
    folder = source.absolute()  # no name of a folder is then an address to the library
    return str(folder) if (folder / INDEX.format("train")).is_file() else None


class Shards:
    """Shards of one split.

    Attributes:
        urls: of the tars.
        count: number of their objects.
    """

    def __init__(self, source: str, split: str) -> None:
        """Read the index.

        Args:
            source: a folder, or an address.
            split: train, val or test.

        Raises:
            UserError: the index cannot be read, or is invalid.
            ModuleNotFoundError: ``webdataset`` is not installed.
        """
        from webdataset.gopen import gopen_schemes

        gopen_schemes.update(http=_open, https=_open)  # its own, by curl, tries for 16 minutes
        name, there = f"{source}/{INDEX.format(split)}", "://" in source
        try:
            with _open(name) if there else io.BytesIO(read_bytes(name)) as stream:
                data = stream.read(MAX_BYTES)
        except (OSError, ValueError, HTTPException) as error:
            reason = first_line(getattr(error, "reason", error))
            raise UserError(f"{name}: cannot be read ({reason})") from error
        index = parse_document(data, _Index, name).shardlist
        self.urls = [f"{source}/{shard.url}" for shard in index]
        for url in self.urls:
            if not there and not Path(url).is_file():  # the library would wait for a pipe
                raise UserError(f"{url}: no such file")
        self.count = sum(shard.nsamples for shard in index)

    def first(self, count: int) -> ViewDataset:
        """Read the first objects into memory; damaged ones are left out.

        Raises:
            Unreachable: a tar cannot be read.
        """
        from webdataset.compat import WebDataset

        samples: list[dict[str, Any]] = []
        for sample in _read(WebDataset(self.urls, shardshuffle=False, nodesplitter=None)):
            if isinstance(sample, Unreachable):
                raise sample
            if len(samples) == count:
                break
            with suppress(UserError):
                dataset_of(sample).files(0)
                samples.append(sample)
        return dataset_of(*samples)

    def stream(self, seed: int) -> Iterator[dict[str, Any] | Unreachable]:
        """Yield samples for ``dataset_of`` without end, shuffled.

        Each process of a group reads its own shards. Once a tar cannot be read, or if there are
        fewer shards than processes, each further item is the error.

        Args:
            seed: of the order.
        """
        from webdataset.compat import WebDataset
        from webdataset.filters import detshuffle
        from webdataset.shardlists import split_by_node

        options = {"shardshuffle": len(self.urls), "detshuffle": True, "seed": seed}
        dataset = WebDataset(self.urls, nodesplitter=split_by_node, **options)
        yield from _read(dataset.compose(detshuffle(BUFFER, BUFFER, seed)).repeat())


def _open(url: str, *_: object) -> Any:
    return urlopen(url, timeout=SILENCE)


def _read(dataset: Any) -> Iterator[dict[str, Any] | Unreachable]:
    try:
        yield from dataset
    except Exception as error:  # of webdataset, tarfile or a transfer; the last argument is the tar
        texts = (
            text.partition(" @ <")[0] for text in reversed(error.args) if isinstance(text, str)
        )
        words = ": ".join(texts)
        of_system = isinstance(error, OSError) and isinstance(error.errno, int)
        reason = first_line(error if of_system else words or error)
        yield from repeat(Unreachable(f"the shards cannot be read: {reason}"))


def dataset_of(*samples: dict[str, Any]) -> ViewDataset:
    """Make a dataset of samples; reading a damaged object raises UserError."""
    readers = {unquote(sample["__key__"]): partial(_read_object, sample) for sample in samples}
    return ViewDataset(readers, "shards", cache=False)


def _read_object(sample: dict[str, Any], uid: str) -> ObjectFiles:
    source = f"{sample['__url__']}: {uid}"
    if scanned({uid}):
        raise UserError(f"{source}: one of Google Scanned Objects, which are for evaluation")
    contents = {name: value for name, value in sample.items() if isinstance(value, bytes)}
    document = parse_document(contents.pop("json", b""), object, source)
    images = {name: MemoryImage(f"{source}.{name}", c) for name, c in contents.items()}

    def find(name: object, where: str) -> MemoryImage:
        if not isinstance(name, str) or name not in images:
            raise UserError(f"{where}: the shard has no {repr(name)[:80]} of this object")
        contents.pop(name, None)
        return images[name]

    files = object_of([(source, document, find)])
    if contents:
        line = f"{sample['__url__']}: files that no .json of their object names are not read"
        warnings.warn(line, FileWarning, stacklevel=2)
    return files
