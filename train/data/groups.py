"""Groups of similar objects, which must be on one side of a split.

Two objects belong to one group if

- they are of one library and one kind, the last word of the name before any number ("Concept Sedan
  02" is a sedan), because libraries name variants of one model so;
- both names are only the kind, in any library ("Chair");
- they are of one library and one name begins with all words of the other, at least two ("Arrow turn
  right", "Arrow turn right and ahead");
- they use an image file with the same content.

The relation is transitive.
"""

from __future__ import annotations

import re
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

from gamba_warp.errors import UserError
from gamba_warp.files import sha256
from gamba_warp.untrusted.names import inside


class ObjectInfo(NamedTuple):
    """Names and textures of an object.

    Attributes:
        uid: its name in the dataset.
        library: its library.
        name: its readable name.
        textures: SHA-256 of each image file of its material.
    """

    uid: str
    library: str
    name: str
    textures: frozenset[str]


def split_groups(objects: Sequence[ObjectInfo]) -> dict[str, str]:
    """Return the group of each object, by uid.

    A group is named by the most frequent ``<library>-<kind>`` of its objects, so it falls into the
    part of the split where most of them would be on their own.
    """
    parent = {item.uid: item.uid for item in objects}

    def root(uid: str) -> str:
        while parent[uid] != uid:
            parent[uid] = parent[parent[uid]]
            uid = parent[uid]
        return uid

    # Objects to join, by the rule and its key.
    joined: dict[tuple[str, ...], list[str]] = defaultdict(list)
    named: dict[tuple[str, ...], list[str]] = defaultdict(list)
    for item in objects:
        words = words_of(item.name)
        joined["kind", item.library, words[-1]].append(item.uid)
        if len(words) == 1:
            joined["alone", words[0]].append(item.uid)
        for texture in item.textures:
            joined["texture", texture].append(item.uid)
        named[(item.library, *words)].append(item.uid)
    for whole in list(named):
        for count in range(3, len(whole)):  # the library, and two words at least
            if named.get(whole[:count]):
                joined[("begins", *whole[:count])] += named[whole[:count]] + named[whole]
    for uids in joined.values():
        for uid in uids:
            parent[root(uid)] = root(uids[0])
    kinds: dict[str, Counter[str]] = defaultdict(Counter)
    for item in objects:
        kinds[root(item.uid)][f"{item.library}-{words_of(item.name)[-1]}"] += 1
    names = {
        first: min(tally, key=lambda kind: (-tally[kind], kind)) for first, tally in kinds.items()
    }
    return {item.uid: names[root(item.uid)] for item in objects}


def textures_of(model: Path) -> frozenset[str]:
    """SHA-256 of each image file named by the materials of an unpacked ``.obj`` model.

    Missing files, and names that leave the model's folder, are skipped.
    """
    digests = set()
    for library in _named_files(model, rb"(?m)^mtllib\s+(.+?)\s*$"):
        for image in _named_files(library, rb"(?m)^\s*map_\w+\s+(?:.*\s)?(\S+)\s*$"):
            digests.add(sha256(image))
    return frozenset(digests)


def _named_files(path: Path, line: bytes) -> Iterator[Path]:
    """Yield the files beside ``path`` that its lines name."""
    if path.suffix.lower() not in (".obj", ".mtl"):
        return
    for match in re.finditer(line, path.read_bytes()):
        try:
            file = inside(path.parent, match[1].decode("latin-1"), str(path))
        except UserError:
            continue
        if file.is_file():
            yield file


def words_of(name: str) -> list[str]:
    """Words of a name before any number, in lower case; the name itself if it has none."""
    return [word.lower() for word in re.findall(r"[^\W\d_]+", re.split(r"\d", name)[0]) or [name]]
