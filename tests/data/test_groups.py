"""Similar objects lie on one side of a split."""

from gamba_warp.train.data.groups import ObjectInfo, split_groups, textures_of, words_of


def groups(*items):
    """Groups of objects "library/name/textures", as sets of their numbers."""
    named = [
        ObjectInfo(str(i), *item.split("/")[:2], frozenset(item.split("/")[2:]))
        for i, item in enumerate(items)
    ]
    found = split_groups(named)
    sides = {name: {uid for uid in found if found[uid] == name} for name in found.values()}
    return sorted("".join(sorted(uids)) for uids in sides.values()), found


def test_words_end_at_the_first_number():
    assert words_of("Concept Sedan 02 red") == ["concept", "sedan"]
    assert words_of("42") == ["42"]


def test_one_kind_of_one_library_is_a_group():
    sides, found = groups("A/Blue sedan 01", "A/Concept Sedan 02", "B/Fast sedan", "A/Van 3")
    assert sides == ["01", "2", "3"]
    assert found == {"0": "A-sedan", "1": "A-sedan", "2": "B-sedan", "3": "A-van"}


def test_kinds_alone_meet_across_libraries():
    assert groups("A/Chair", "B/Chair", "A/Red chair", "B/Bar stool")[0] == ["012", "3"]


def test_names_that_begin_alike_meet_in_one_library():
    names = ("A/Arrow turn right", "A/Arrow turn right and ahead", "B/Arrow turn right and back")
    assert groups(*names, "A/Arrow straight on")[0] == ["01", "2", "3"]
    # One word in common is no twin: "Glass table" and "Glass".
    assert groups("A/Glass", "A/Glass table top")[0] == ["0", "1"]


def test_shared_textures_meet_and_pass_it_on():
    sides, found = groups(
        "A/Oak desk/x", "B/Pine bed/x/y", "C/Small crate/y", "C/Wine crate", "D/Lamp/z"
    )
    assert sides == ["0123", "4"]
    assert found["0"] == "C-crate"  # the most frequent name


def test_textures_are_known_by_their_content(tmp_path):
    for name, content in {"a.jpg": b"wood", "b.png": b"wood", "c d.png": b"steel"}.items():
        (tmp_path / name).write_bytes(content)
    (tmp_path / "x.mtl").write_text("newmtl m\nmap_Kd -s 1 1 1 a.jpg\n map_d gone.png\n")
    (tmp_path / "y.mtl").write_text("newmtl m\nmap_Kd b.png\nmap_Ka ../../etc/passwd\n")
    (tmp_path / "x.obj").write_text("mtllib x.mtl\nmtllib lost.mtl\nv 0 0 0\n")
    (tmp_path / "y.obj").write_text("mtllib y.mtl\n")
    (tmp_path / "z.stl").write_bytes(b"mtllib y.mtl\n")
    assert textures_of(tmp_path / "x.obj") == textures_of(tmp_path / "y.obj")
    assert len(textures_of(tmp_path / "x.obj")) == 1
    assert not textures_of(tmp_path / "z.stl")
