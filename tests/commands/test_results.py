"""Results of a command: text, JSON, and one file on the standard output."""

import io
import json
from pathlib import Path

import pytest
from helpers.gaussians import some
from helpers.images import cut_out
from helpers.model import quick, run_reconstruct
from helpers.refusals import refused_command
from PIL import Image

from gamba_warp.cli import run
from gamba_warp.commands.results import Results
from gamba_warp.formats.ply import load_ply, save_ply

COARSE = ["--voxels", "24", "--views", "8", "--pixels", "48"]


@pytest.fixture
def splats(tmp_path):
    path = tmp_path / "thing.ply"
    save_ply(path, some(40))
    return str(path)


def test_the_text_counts_inputs_and_failures():
    def text(count, *failed):
        failures = [(Path(name), "empty") for name in failed]
        return Results("file", count, Path("out"), failures).text()

    assert text(2) == "2 files, 0 failures, results in out"
    assert text(2, "a.ply") == "2 files, 1 failure, results in out"
    assert text(1, "a.ply") == "1 file, 1 failure"
    assert text(1, ".") == "1 file, 1 failure, results in out"  # a folder is no counted input


def test_one_file_on_the_standard_output(tmp_path, checkpoint, splats, capfdbinary, monkeypatch):
    monkeypatch.chdir(tmp_path)
    image = cut_out(tmp_path / "thing.png")
    assert run_reconstruct(image, "--checkpoint", checkpoint, "-o", "-") == 0
    made = capfdbinary.readouterr()
    (tmp_path / "made.ply").write_bytes(made.out)
    assert load_ply(tmp_path / "made.ply").num == 64
    assert b"thing: 64 Gaussians." in made.err and made.err.endswith(b"1 image, 0 failures\n")
    assert run("export", [splats, "--mesh", "stl", *COARSE, "--out", "-"]) == 0
    made = capfdbinary.readouterr()
    assert len(made.out) == 84 + 50 * int.from_bytes(made.out[80:84], "little")
    assert b"Mesh: " in made.err
    assert run("render", [splats, "-o", "-", "--kind", "png", "--size", "24x16"]) == 0
    assert Image.open(io.BytesIO(capfdbinary.readouterr().out)).size == (24, 16)
    assert run("render", [str(tmp_path / "no.ply"), "-o", "-"]) == 2
    assert run("export", [splats, "-o", "-", "--mesh", "--splats", "ply", "spz"]) == 2
    made = capfdbinary.readouterr()
    assert not made.out
    assert made.err.endswith(b"--out - writes one file, but 2 were made: thing.ply, thing.spz\n")
    assert {path.name for path in tmp_path.iterdir()} == {"thing.ply", "thing.png", "made.ply"}


def test_a_terminal_gets_no_file(splats, monkeypatch, capsys):
    monkeypatch.setattr("sys.__stdout__", type("Terminal", (), {"isatty": lambda self: True})())
    refused_command(capsys, "render", [splats, "-o", "-"], "the standard output is a terminal")


def test_results_as_json(tmp_path, checkpoint, splats, capsys):
    image, missing, out = cut_out(tmp_path / "thing.png"), tmp_path / "no.png", tmp_path / "out"
    options = quick(checkpoint, out)
    assert run_reconstruct(image, missing, *options, "--save-inputs", "--json") == 1
    texts = capsys.readouterr()
    made = json.loads(texts.out)
    assert "thing: 64 Gaussians." in texts.err and "no such file" in texts.err
    assert made["out"] == str(out)
    assert made["failures"] == [{"input": str(missing), "reason": "no such file"}]
    (result,) = made["results"]
    assert sorted(result.pop("files")) == sorted(path.name for path in out.iterdir())
    doubt, elevation = result.pop("elevation_doubt"), result.pop("elevation")
    assert result.pop("cutout") and -20 <= elevation <= 65
    assert doubt is None or doubt[0] <= elevation <= doubt[1]
    want = {"input": str(image), "name": "thing", "warning": "", "gaussians": 64, "notes": []}
    assert result == want
    options = ["--mesh", "ply", *COARSE, "--json"]
    assert run("export", [splats, "--out", str(out), *options]) == 0
    (result,) = json.loads(capsys.readouterr().out)["results"]
    assert result["files"] == ["thing-mesh.ply"]
    assert set(result["mesh"]) == {"vertices", "faces", "closed"}
    refused_command(capsys, "export", [splats, "-o", "-", "--json"], "--json cannot, too")
    assert run("export", ["-q", splats, "--out", str(out), *options]) == 0
    texts = capsys.readouterr()
    assert json.loads(texts.out)["results"] and not texts.err
