"""``gamba stress files``: every reader with hostile files, and that the fuzzer sees what is bad."""

import itertools
import json
import re
from pathlib import Path

import numpy as np
import pytest
from helpers.hostile import add_faulty

from gamba_warp import cli
from gamba_warp.errors import MOST_LETTERS, UserError, one_line
from gamba_warp.hostile import sound
from gamba_warp.hostile.case import Case, Entry, read_case, sound_case, stored_case, write_case
from gamba_warp.hostile.counts import points_in
from gamba_warp.hostile.pool import Pool
from gamba_warp.hostile.readers import READERS, REFUSED
from gamba_warp.hostile.run import Cases, replay
from gamba_warp.hostile.seeds.shapes import clouds
from gamba_warp.hostile.shrink import shrink, signature
from gamba_warp.hostile.verdict import OUTCOMES

WANTED = {
    **dict.fromkeys(("raises", "exits"), "exception"),
    **dict.fromkeys(("opens", "starts", "writes"), "outside"),
    **{"lines": "line", "memory": "memory", "dies": "death", "wrong": "unsound"},
}


def faulty_case(what: str) -> Case:
    return sound_case("faulty", "text", "a.txt", {"a.txt": what.encode(), "b.txt": b"unused"})


@pytest.fixture(scope="module")
def pool():
    with Pool(1, prepare=add_faulty) as made:
        yield made


def test_each_fault_is_seen(pool):
    got = {name: pool.run_one(faulty_case(name)).outcome for name in WANTED}
    assert got == WANTED
    assert pool.run_one(faulty_case("nothing")).outcome == "sound"


def test_a_verdict_names_the_file_and_no_folder(pool):
    text = pool.run_one(faulty_case("tells")).text
    assert text.endswith(": a.txt and /outer/box/out are wrong")


def test_a_hang_is_seen(pool, monkeypatch):
    pool.run_one(faulty_case("nothing"))
    monkeypatch.setattr("gamba_warp.hostile.pool.SECONDS", 0.5)
    assert pool.run_one(faulty_case("hangs")).outcome == "hang"


def test_a_failure_is_made_small(pool):
    case = Case(
        "faulty",
        "text",
        "a.txt",
        {
            "a.txt": Entry(data=b"raises"),
            "b.txt": Entry(data=b"x" * 100),
            "c": Entry(kind="folder"),
        },
        ("a.txt: set_bytes", "b.txt: append"),
    )
    verdict = pool.run_one(case)
    small, found = shrink(case, verdict, {"a.txt": b"sound.", "b.txt": b"y"}, pool.run_one, 20)
    assert list(small.files) == ["a.txt"]
    assert small.files["a.txt"].data == b"raises"
    assert signature(small, found) == signature(case, verdict)


def test_every_sound_file_is_read(pool):
    """A seed that is refused would test nothing behind the first check."""
    cases = Cases(0)
    told = {}
    for (reader, seed), files in cases.sound.items():
        case = sound_case(reader, seed, cases.main(reader, seed), files)
        verdict = pool.run_one(case)
        if verdict.outcome != ("refused" if (reader, seed) in REFUSED else "sound"):
            told[reader, seed] = verdict
    assert not told


@pytest.mark.parametrize("kind", ["pipe", "folder", "link", "missing"])
def test_what_is_no_file_is_refused(pool, kind):
    """In each file's place, of every reader: a pipe has no end, nor has /dev/zero."""
    cases, told = Cases(0), {}
    firsts = {reader: seed for reader, seed in reversed(cases.sound)}
    for reader, seed in firsts.items():
        sound_files = cases.sound[reader, seed]
        for name in list(sound_files)[:3]:
            files = {other: Entry(data=data) for other, data in sound_files.items()}
            files[name] = Entry(kind=kind, data=b"/dev/zero") if kind != "missing" else None
            files = {other: entry for other, entry in files.items() if entry}
            verdict = pool.run_one(Case(reader, seed, cases.main(reader, seed), files))
            if verdict.bad:
                told[reader, name] = verdict
    assert not told


def test_hostile_files(fuzz):
    """Two minutes of all readers; the run goes on beside the other tests (``conftest.py``)."""
    code = fuzz.wait()
    assert code == 0, (fuzz.out / "log.txt").read_text()[-2000:]
    report = json.loads((fuzz.out / "stress.json").read_text())
    assert report["totals"]["cases"] > 100 and report["failures"] == []


def test_the_same_seed_gives_the_same_cases():
    def drawn(seed):
        names = ["picture", "shape", "config", "dataset"]
        return list(itertools.islice(Cases(seed, names).draw(), 60))

    first = drawn(3)
    assert first == drawn(3)
    assert first != drawn(4)
    assert all(case.mutations for case in first)


def test_a_case_goes_through_its_file(tmp_path):
    files = {"a/b.png": Entry(data=bytes(range(256))), "c": Entry(kind="link", data=b"a")}
    case = Case("picture", "png", "a/b.png", files, ("a/b.png: truncate",))
    path = tmp_path / "case.json"
    path.write_text(json.dumps(stored_case(case, "hang", "text", {})))
    assert read_case(path, READERS) == case
    place = tmp_path / "place"
    place.mkdir()
    assert write_case(case, place).read_bytes() == bytes(range(256))
    assert (place / "c").is_symlink()


@pytest.mark.parametrize("name", ["../x", "/etc/x", "a/../../x", ""])
def test_a_case_stays_in_its_folder(tmp_path, name):
    case = Case("picture", "png", "", {name: Entry(data=b"x")})
    with pytest.raises(UserError):
        write_case(case, tmp_path)
    path = tmp_path / "case.json"
    path.write_text(json.dumps(stored_case(case, "", "", {})))
    with pytest.raises(UserError):
        read_case(path, READERS)


def test_replay(tmp_path):
    case = sound_case("config", "text", "config.json", {"config.json": b"{"})
    path = tmp_path / "case.json"
    path.write_text(json.dumps(stored_case(case, "", "", {})))
    [(passes, text)] = replay([path])
    assert passes
    assert "refused" in text


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        (["files", "nonsense"], "unknown reader"),
        (["--replay", "none.json"], "No such file"),
        (["files", "--minutes", "inf"], "--minutes"),
        (["files", "--cases", "0"], "--cases"),
    ],
)
def test_bad_options(arguments, reason, capsys):
    with pytest.raises(SystemExit) as caught:
        cli.main(["stress", *arguments])
    assert caught.value.code == 2
    assert reason in capsys.readouterr().err


@pytest.mark.parametrize("name", [n for n in clouds() if n not in ("pcd-compressed",)])
def test_the_second_reader_of_clouds(name):
    [(file, data)] = clouds()[name].items()
    points = points_in(data, Path(file).suffix)
    assert points is None if "binary" in name or name == "pcd-normals" else len(points) == 24


@pytest.mark.parametrize("garbage", [b"abc def ghi\n", b"1 2\n", b"nan 0 0\n"])
@pytest.mark.parametrize("name", ["xyz", "pts", "pcd-ascii", "ply-cloud"])
def test_the_second_reader_takes_no_garbage(name, garbage):
    [(file, data)] = clouds()[name].items()
    lines = data.splitlines(keepends=True)
    assert isinstance(points_in(b"".join([*lines[:-1], garbage]), Path(file).suffix), str)
    if name != "xyz":  # which states no count
        assert isinstance(points_in(b"".join(lines[:-1]), Path(file).suffix), str)


def test_the_check_of_pictures_can_fail():
    good = np.zeros((2, 3, 4), np.float32)
    assert sound.picture(good, Path(), Path()) is None
    for bad in (good[..., :3], good.astype(np.float64), good + 2, good * np.nan):
        assert sound.picture(bad, Path(), Path())


@pytest.mark.parametrize("text", ["a\nb", "a\x1b[31mb", "\ud800", "x" * 10**6, "\r\n", "a\u2028b"])
def test_an_error_is_one_line(text):
    line = str(UserError(f"file.png: {text} end"))
    assert line.startswith("file.png: ") and line.endswith("end")
    assert line.isprintable()
    assert len(line) <= MOST_LETTERS


def test_an_error_keeps_what_is_sound():
    assert one_line("café.png: ungültig") == "café.png: ungültig"


def test_the_page_states_the_limits_of_the_code():
    root = Path(__file__).resolve().parents[2]
    page = (root / "docs" / "security.md").read_text()
    stated = re.findall(r"^\| .* \| `(\S+\.py)` `(\w+)` \|$", page, re.MULTILINE)
    assert len(stated) > 20
    for file, name in stated:
        assert re.search(rf"^{name} = ", (root / file).read_text(), re.MULTILINE), f"{file} {name}"
    assert f"{MOST_LETTERS} letters" in page
    for outcome in OUTCOMES:
        assert f"| {outcome} |" in page


def test_what_was_found_once_stays_mended(pool):
    """``corpus/`` holds cases that failed, as they were written; each is judged again."""
    paths = sorted((Path(__file__).parent / "corpus").glob("*.json"))
    assert len(paths) >= 5
    bad = {}
    for path in paths:
        verdict = pool.run_one(read_case(path, READERS))
        if verdict.outcome not in ("sound", "refused"):
            bad[path.stem] = f"{verdict.outcome}: {verdict.text}"
    assert not bad
