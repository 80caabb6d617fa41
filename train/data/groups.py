"""Which objects belong on one side of a split: those that a model would know from one another.

Two objects are of one group if

- they are of one library and one kind, the last word of the name before any number ("Concept Sedan
  02" is a sedan), because libraries have variants of one model under such names;
- both are called by their kind alone, in whatever library ("Chair");
- they are of one library and one name begins with all words of the other, at least two ("Arrow turn
  right", "Arrow turn right and ahead");
- they show a picture file with the same content,

and so on from one to the next.
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


class Named(NamedTuple):
    """What is known of an object.

    Attributes:
        uid: its name in the dataset.
        library: where it comes from.
        name: what people call it.
        textures: SHA-256 of each picture file that its material shows.
    """

    uid: str
    library: str
    name: str
    textures: frozenset[str]


def split_groups(objects: Sequence[Named]) -> dict[str, str]:
    """The group of each object, by uid.

    A group has the name ``<library>-<kind>`` that most of its objects have, so that it lies where
    these would lie by themselves.
    """
    above = {item.uid: item.uid for item in objects}

    def top(uid: str) -> str:
        while above[uid] != uid:
            above[uid] = above[above[uid]]
            uid = above[uid]
        return uid

    # What belongs together by one of the rules.
    found: dict[tuple[str, ...], list[str]] = defaultdict(list)
    named: dict[tuple[str, ...], list[str]] = defaultdict(list)
    for item in objects:
        words = words_of(item.name)
        found["kind", item.library, words[-1]].append(item.uid)
        if len(words) == 1:
            found["alone", words[0]].append(item.uid)
        for texture in item.textures:
            found["texture", texture].append(item.uid)
        named[(item.library, *words)].append(item.uid)
    for whole in list(named):
        for count in range(3, len(whole)):  # the library, and two words at least
            if named.get(whole[:count]):
                found[("begins", *whole[:count])] += named[whole[:count]] + named[whole]
    for uids in found.values():
        for uid in uids:
            above[top(uid)] = top(uids[0])
    kinds: dict[str, Counter[str]] = defaultdict(Counter)
    for item in objects:
        kinds[top(item.uid)][f"{item.library}-{words_of(item.name)[-1]}"] += 1
    names = {
        first: min(found, key=lambda kind: (-found[kind], kind)) for first, found in kinds.items()
    }
    return {item.uid: names[top(item.uid)] for item in objects}


def textures_of(model: Path) -> frozenset[str]:
    """SHA-256 of each picture file that the materials of an unpacked ``.obj`` model name.

    What is missing, or has a name that leaves the model's folder, is passed over.
    """
    found = set()
    for library in _named_files(model, rb"(?m)^mtllib\s+(.+?)\s*$"):
        for picture in _named_files(library, rb"(?m)^\s*map_\w+\s+(?:.*\s)?(\S+)\s*$"):
            found.add(sha256(picture))
    return frozenset(found)


def _named_files(path: Path, line: bytes) -> Iterator[Path]:
    """The files beside ``path`` that its lines name."""
    if path.suffix.lower() not in (".obj", ".mtl"):
        return
    for match in re.finditer(line, path.read_bytes()):
        try:
            found = inside(path.parent, match[1].decode("latin-1"), str(path))
        except UserError:
            continue
        if found.is_file():
            yield found


def words_of(name: str) -> list[str]:
    """The words of a name before any number, in small letters; the name itself if it has none."""
    return [word.lower() for word in re.findall(r"[^\W\d_]+", re.split(r"\d", name)[0]) or [name]]
