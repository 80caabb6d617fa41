"""Names and texts of strangers' files in the output of commands: no byte that a terminal obeys."""

import sys
import unicodedata

import pytest
from helpers.images import cut_out
from helpers.meshes import glb, gltf
from helpers.micro import cloud, write_dataset

from gamba_warp import batch, cli
from gamba_warp.errors import PrintableStream, printable
from gamba_warp.formats.gaussians.files import write_gaussians

# Sets a terminal's title, rings, clears the screen, turns the direction of the text, and starts a
# line of its own.
ODD = "a\x1b]0;title\x07\x1b[2J\r\u202e\u2066b\x9b\nFORGED"


def obeyed(text):
    """Return the characters of a text that control a terminal or the direction of letters."""
    return {c for c in text if c not in "\n\t" and unicodedata.category(c) in ("Cc", "Cf", "Cs")}


@pytest.fixture
def folder(tmp_path):
    """A folder of good and bad files of many kinds, with odd names and contents."""
    (tmp_path / f"{ODD}.glb").write_bytes(glb(gltf(extensionsUsed=[ODD]), b""))
    (tmp_path / f"{ODD}-broken.obj").write_text(f"v 0 0 0\nf {ODD}\n")
    write_gaussians(tmp_path / f"{ODD}.ply", cloud(0), "ply")
    (tmp_path / f"{ODD}-broken.ply").write_text(f"ply\nformat {ODD}\n")
    cut_out(tmp_path / f"{ODD}.png")
    (tmp_path / f"{ODD}-broken.png").write_bytes(b"\x89PNG\r\n")
    write_dataset(tmp_path / "set", objects=2)
    (tmp_path / "set" / "clouda").rename(tmp_path / "set" / ODD)
    (tmp_path / "set" / ODD / "transforms.json").write_text("{}")
    (tmp_path / f"{ODD}.yaml").write_text(f'"{ODD}": 1\n')
    return tmp_path


COMMANDS = {
    "reconstruct": "reconstruct . --out out --checkpoint {model} --turntable none --no-page",
    "export": "export . --out out",
    "one export": "export {odd}.ply --out out --format spz",
    "render": "render {odd}.ply --out out/{odd}.png --size 16",
    "view": "view {odd}-broken.ply",
    "eval-geometry": "eval-geometry {odd}.glb {odd}.glb --out out --points 100",
    "folders": "eval-geometry . . --out out --points 100",
    "data render": "data render . --out out --views 1 --size 8 --workers 1",
    "data pack": "data pack set out",
    "data index": "data index set",
    "train": "train set --preset tiny --out out --steps 1 --lpips off --batch-size 1",
    "eval-views": "eval-views --checkpoint {model} --data set --split all --out out --lpips off",
    "compare": "compare {odd}.yaml {odd}.glb",
    "configuration": "train set --config {odd}",
    "unknown command": "{odd}",
    "unknown option": "render {odd}.ply --{odd}",
    "missing file": "export {odd}.missing.ply",
}


@pytest.mark.parametrize("name", COMMANDS)
def test_output_of_commands(name, folder, checkpoint, monkeypatch, capfd):
    monkeypatch.chdir(folder)
    words = [word.format(odd=ODD, model=checkpoint) for word in COMMANDS[name].split(" ")]
    with pytest.raises(SystemExit):
        cli.main(words)
    texts = capfd.readouterr()
    assert texts.out + texts.err
    assert not obeyed(texts.out) | obeyed(texts.err)
    assert not any(line.startswith("FORGED") for line in (texts.out + texts.err).splitlines())
    if name == "export":  # what must not be there is there with escapes
        assert "\\x1b]0;title\\x07" in texts.out and "\\u202e" in texts.out
        assert "\\x1b]0;title\\x07" in texts.err
        assert all(line.count("FORGED") < 2 for line in texts.err.splitlines())


def test_printable():
    assert printable("plain, ümlaut, 点\n\tand more") == "plain, ümlaut, 点\n\tand more"
    assert not obeyed(printable(ODD)) and "\\u202e" in printable(ODD)


def test_lines_stand_above_a_bar(monkeypatch, capsys):
    """A bar draws on the terminal itself, and is cleared before a line is printed."""
    terminal = sys.stderr
    monkeypatch.setattr(terminal, "isatty", lambda: True, raising=False)
    monkeypatch.setattr(sys, "stderr", PrintableStream(terminal))
    with batch.progress_bar(range(2), desc="items") as bar:
        for _ in bar:
            batch.say("\x1b[2Jline", sys.stderr)
    text = capsys.readouterr().err
    assert "items" in text and "\r\\x1b[2Jline\n" in text
