"""From an image to files, without the page."""

import base64
import re
import zipfile
from dataclasses import replace
from unittest.mock import MagicMock, Mock

import numpy as np
import pytest
import torch
from helpers.images import bad_files, cut_out, post
from helpers.matting import matting_network
from helpers.model import quick, run_reconstruct
from helpers.refusals import refused
from PIL import Image

from gamba_warp.app import cutting, main_thread, work
from gamba_warp.batch import STAGES
from gamba_warp.cameras import orbit
from gamba_warp.errors import UserError
from gamba_warp.files import STARTER
from gamba_warp.formats.ply import load_ply
from gamba_warp.formats.read import read_gaussians
from gamba_warp.images import save_image
from gamba_warp.model.checkpoint import load_model
from gamba_warp.photo import models
from gamba_warp.photo.cutout import CutoutOptions
from gamba_warp.surfaces import extract
from gamba_warp.viewer.pack import visible

RED, GREEN = (0.8, 0.1, 0.1), (0.1, 0.6, 0.2)


@pytest.fixture(scope="module")
def two(tmp_path_factory):
    """An image of a red square and a green one beside it, on white."""
    image = np.ones((60, 100, 3))
    image[20:40, 15:35] = RED
    image[20:40, 60:80] = GREEN
    path = tmp_path_factory.mktemp("two") / "two.png"
    save_image(path, image)
    return path


@pytest.fixture(scope="module")
def edited(tmp_path_factory):
    image = cut_out(tmp_path_factory.mktemp("made") / "thing.png")
    cut = cutting.cut_image(image, "My  thing.v2.png", CutoutOptions())
    return work.run_model(load_model(STARTER / "tiny.safetensors"), cut)


def triangle():
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], np.float64)
    return extract.Surface(corners, np.array([[0, 1, 2]]))


def test_a_image_from_above_stands_upright(tmp_path, edited):
    """Rotation like ``reconstruct --elevation``, in the viewer's camera and in every file."""
    image = cut_out(tmp_path / "thing.png")
    cut = cutting.cut_image(image, "thing.png", CutoutOptions())
    above = work.run_model(load_model(STARTER / "tiny.safetensors"), cut, 30.0)
    turn = orbit(torch.zeros(1), 30.0)[0, :3, :3]
    torch.testing.assert_close(above.left.means @ turn.T, edited.left.means)
    assert above.view == edited.view.changed(30.0) and edited.view.elevation == 0
    edited = replace(edited, name="thing", surface=triangle())
    corners = edited.surface.vertices
    nothing = bytes(-(-visible(edited.gaussians, "").num // 8))
    for elevation in (10.0, 30.0):  # rotations add up
        work.edit(edited, elevation, nothing)
    torch.testing.assert_close(edited.left.means, above.left.means, atol=1e-6, rtol=0)
    np.testing.assert_allclose(edited.surface.vertices, corners @ turn.double().numpy(), atol=1e-6)
    assert edited.view == above.view and edited.chosen == above.chosen == 30
    path, _ = work.write(above, "ply", tmp_path)
    options = quick(STARTER / "tiny.safetensors", tmp_path / "out", 30)
    assert run_reconstruct(image, *options) == 0
    theirs = load_ply(tmp_path / "out" / "thing.ply")
    torch.testing.assert_close(load_ply(path).means, theirs.means)


def stroke(shape, box, color):
    """A layer with one painted box: top, left, bottom, right as fractions."""
    layer = np.zeros((*shape, 4), np.uint8)
    top, left, bottom, right = (round(s * shape[i % 2]) for i, s in enumerate(box))
    value = [int(color[i : i + 2], 16) for i in (1, 3, 5)]
    layer[top:bottom, left:right] = [*value, round(255 * cutting.STROKE)]
    return layer


def test_a_plain_image_is_cut_out(two):
    cut = cutting.cut_image(two, "two.png", CutoutOptions())
    assert cut.mask.shape == (60, 100) and cut.name == "two"
    assert cut.mask[30, 25] == 1 and cut.mask[30, 70] == 1 and cut.mask[5, 5] == 0
    assert "plain background" in cut.note
    assert cutting.model_image(cut) is cut.found


@pytest.mark.parametrize("size", [(60, 100), (432, 720), (31, 57)])
def test_strokes_keep_and_remove(two, size):
    cut = cutting.cut_image(two, "two.png", CutoutOptions())
    without = cutting.apply_strokes(cut, [stroke(size, (0.2, 0.5, 0.8, 1.0), cutting.REMOVE)])
    assert without.mask[30, 25] == 1 and without.mask[30, 70] == 0
    assert "2 separate parts" in cut.note == cutting.note_of(cut)
    assert "edited" in cutting.note_of(without) and "parts" not in cutting.note_of(without)
    side = cutting.model_image(without).shape[0]
    assert side == 25  # 20 pixels are four fifths of it
    assert cut.mask[30, 70] == 1, "the first one is as it was"
    again = cutting.apply_strokes(without, [stroke(size, (0.2, 0.5, 0.8, 0.9), cutting.KEEP)])
    assert again.mask[30, 70] == 1 and again.mask[5, 70] == 0
    assert "2 separate parts" in cutting.note_of(again)
    np.testing.assert_array_equal(cutting.reset_mask(again).mask, cut.mask)
    assert cutting.note_of(cutting.reset_mask(again)) == cut.note
    assert cutting.apply_strokes(cut, [np.zeros((*size, 4), np.uint8)]) is cut


def test_a_doubted_cut_out_has_no_command_but_a_network(tmp_path, monkeypatch):
    pytest.importorskip("onnxruntime", reason="needs onnxruntime: pip install '.[photo]'")
    options = CutoutOptions(notify=lambda line: None)
    home = tmp_path / "models"
    home.mkdir()
    monkeypatch.setenv("U2NET_HOME", str(home))

    def cut():
        found = cutting.cut_image(post(tmp_path), "post.png", options)
        assert "may be wrong: it touches" in found.note and "Paint what to keep" in found.note
        assert "gamba" not in found.note and "--" not in found.note
        return found

    assert cut().network == "" and "network" not in cut().note  # GAMBA_OFFLINE
    monkeypatch.setenv("GAMBA_OFFLINE", "0")
    first = cut()
    assert first.network == "Cut out with a network (isnet-general-use, 179 MB, fetched once)"
    assert "or use a network" in first.note

    unreachable = UserError("github.com cannot be reached")
    monkeypatch.setattr(models, "fetch", Mock(side_effect=unreachable))
    refused("network cannot be fetched: github.com cannot", cutting.cut_by_network, first, options)
    other, file = home / "silueta.onnx", home / "isnet-general-use.onnx"
    other.write_bytes(matting_network(bias=-400.0))
    said = refused("network does not help", cutting.cut_by_network, first, options)
    assert "nothing stands out" in said and "--" not in said
    other.unlink()
    monkeypatch.setattr(models, "fetch", lambda *_: file.write_bytes(matting_network()))
    again = cutting.cut_by_network(first, options)
    assert "The matting model isnet-general-use.onnx" in again.note and again.key == first.key
    assert again.network == "" and again.mask[50, 40] > 0.9 and again.mask[5, 5] < 0.1
    mended = cutting.apply_strokes(first, [stroke((60, 80), (0, 0, 1, 1), cutting.REMOVE)])
    assert cutting.cut_by_network(mended, options).mask[50, 40] > 0.9


def ring(folder):
    """An image of a red ring on white."""
    rgb = np.ones((60, 80, 3))
    rgb[10:50, 20:60] = 0.8, 0.2, 0.1
    rgb[20:40, 30:50] = 1  # a hole
    rgb[42:46, 30:50] = 0.95  # of another white: matter
    save_image(folder / "ring.png", rgb)
    return folder / "ring.png"


def test_words_of_the_command_line_are_not_for_the_page(tmp_path):
    options = CutoutOptions(notify=lambda line: None)
    save_image(tmp_path / "even.png", np.full((40, 50, 3), 0.5))
    assert "--" not in cutting.cut_image(tmp_path / "even.png", "even.png", options).note
    note = cutting.cut_image(ring(tmp_path), "ring.png", options).note
    assert "with 1 enclosed area of it" in note and "--" not in note


def test_enclosed_areas_are_cleared_and_filled(tmp_path):
    cut = cutting.cut_image(ring(tmp_path), "ring.png", CutoutOptions())
    assert cut.mask[30, 40] == 0 and cut.mask[44, 40] == 1 and "1 enclosed area" in cut.note
    cleared = cutting.switch_areas(cut)
    assert cleared.mask[30, 40] == 0 and cleared.mask[44, 40] == 0 and cleared.mask[15, 40] == 1
    filled = cutting.switch_areas(cleared)
    assert filled.mask[30, 40] == 1 and filled.mask[44, 40] == 1 and filled.mask[5, 5] == 0
    np.testing.assert_array_equal(cutting.reset_mask(filled).mask, cut.mask)


def test_a_mended_object_has_no_fringe(tmp_path):
    """Along a smoothed edge the image mixes object and background; the found colours do not."""
    image = Image.new("RGB", (400, 400), "white")
    image.paste((200, 20, 20), (100, 120, 300, 280))
    image = image.rotate(20, Image.Resampling.BICUBIC, fillcolor="white")
    image.resize((100, 100), Image.Resampling.LANCZOS).save(tmp_path / "a.png")
    cut = cutting.cut_image(tmp_path / "a.png", "a.png", CutoutOptions())
    mended = cutting.apply_strokes(cut, [stroke((50, 50), (0.4, 0.4, 0.6, 0.6), cutting.REMOVE)])
    rgba = cutting.model_image(mended)
    edge = rgba[(rgba[..., 3] > 0.3) & (rgba[..., 3] < 0.95)]
    # White would have a green of 1; what the flood leaves of it is within its tolerance.
    assert len(edge) > 20 and np.quantile(edge[:, 1], 0.9) < 0.4


def test_what_is_painted_on(two):
    cut = cutting.cut_image(two, "two.png", CutoutOptions())
    shown = cutting.editor_image(cut)
    assert shown.shape == (432, 720, 3) and shown.dtype == np.uint8
    np.testing.assert_allclose(shown[216, 180], np.multiply(RED, 255), atol=2)
    corner = {tuple(shown[y, x]) for y in (5, 17) for x in (5, 17)}
    assert len(corner) == 2, "a checkerboard"
    gone = replace(cut, mask=np.zeros_like(cut.mask))
    faint = cutting.editor_image(gone)[216, 180].astype(int)
    assert faint[0] > faint[1] + 20, "what is cut away still shows, faintly"
    bare = cutting.editor_image(replace(gone, ghost=False))[216, 180]
    assert len(set(bare.tolist())) == 1


def test_without_an_object_it_can_be_painted(tmp_path):
    """A uniform image has no object; the painted area is cut out."""
    save_image(tmp_path / "even.png", np.full((40, 50, 3), 0.5))
    cut = cutting.cut_image(tmp_path / "even.png", "even.png", CutoutOptions())
    assert not cut.mask.any() and cut.note.startswith("No object was found (")
    assert str(tmp_path) not in cut.note
    refused("no object found.*paint over the object", cutting.model_image, cut)
    painted = cutting.apply_strokes(cut, [stroke((80, 100), (0.25, 0.2, 0.75, 0.8), cutting.KEEP)])
    assert cutting.model_image(painted).shape == (38, 38, 4)  # 30 pixels over 0.8
    removed = cutting.apply_strokes(painted, [stroke((8, 10), (0, 0, 1, 1), cutting.REMOVE)])
    refused("no object found", cutting.model_image, removed)
    assert "may be wrong" not in cutting.note_of(removed)


def test_no_images(tmp_path):
    for name, path, reason in bad_files(tmp_path):
        given = path, "given.png", CutoutOptions()
        said = refused(re.escape(reason) or None, cutting.cut_image, *given)
        assert said.startswith("given.png: ") and str(tmp_path) not in said, name


@pytest.mark.parametrize(
    "name, stem",
    [
        ("chair.png", "chair"),
        ("my old chair (2).JPG", "my-old-chair-2"),
        ("../../etc/passwd", "passwd"),
        ("<img src=x>.png", "img-src-x"),
        ("Stühle.webp", "Stühle"),
        ("...", "object"),
        ("", "object"),
        ("x" * 300 + ".png", "x" * 60),
    ],
)
def test_names_of_strangers(name, stem):
    assert cutting.stem(name) == stem


def test_every_kind_of_file(edited, tmp_path):
    suffixes = {kind: suffix for kind, (_, suffix) in work.KINDS.items()}
    assert len(set(suffixes.values())) == len(suffixes), "no two files have one name"
    assert {"ply", "splat", "spz", "compressed-ply", "gif", "html"} < set(suffixes)
    for kind in work.GAUSSIANS:
        path, note = work.write(edited, kind, tmp_path)
        assert path.name == "My-thing-v2" + suffixes[kind]
        assert read_gaussians(path).num == edited.left.drawn().num > 0
        assert f"{edited.left.drawn().num:,} Gaussians" in note
    path, _ = work.write(edited, "html", tmp_path)
    assert "<canvas" in path.read_text(encoding="utf-8")
    refused("no such kind of file: exe", work.write, edited, "exe", tmp_path)
    assert not [p for p in tmp_path.iterdir() if p.name.startswith(".")]


def test_the_turntable(edited, tmp_path, monkeypatch):
    monkeypatch.setattr(work, "FRAMES", 3)
    path, _ = work.write(edited, "gif", tmp_path)
    with Image.open(path) as image:
        assert image.n_frames == 3 and image.size == (work.SIZE, work.SIZE)


def test_a_mesh(edited, tmp_path, monkeypatch):
    """The surface is faked: it takes half a minute and has its own tests."""
    trimesh = pytest.importorskip("trimesh")
    asked = []

    def surface_of(gaussians, options, device, texture):
        asked.append((gaussians.num, options.faces, options.watertight, texture, str(device)))
        faces = np.array([[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]])
        return extract.Surface(np.eye(4, 3, -1), faces, np.full((4, 3), 0.5, np.float32))

    monkeypatch.setattr(extract, "surface_of", surface_of)
    for kind, suffix in (("mesh-stl", ".stl"), ("mesh-glb", ".glb")):
        mesh = work.MeshChoice.of("50,000 faces", "Texture 512", True)
        path, _ = work.write(edited, kind, tmp_path, mesh=mesh)
        assert path.name == f"My-thing-v2-mesh{suffix}"
        mesh = trimesh.load(path, force="mesh")
        assert len(mesh.faces) == 4 and mesh.bounds[:, 1].tolist() == [-1, 0]  # y up
    assert asked == [(edited.left.num, 50_000, True, side, "cpu") for side in (0, 512)]
    refused("no such mesh", work.MeshChoice.of, "50,000 faces", "10,000 faces", True)
    asked.clear()
    monkeypatch.setattr(work, "FRAMES", 2)
    path, _ = work.write(edited, "zip", tmp_path)
    with zipfile.ZipFile(path) as archive:
        names = {f"My-thing-v2{work.KINDS[kind][1]}" for kind in work.IN_ZIP}
        assert {*archive.namelist()} == names and archive.testzip() is None
    assert [p for p in tmp_path.iterdir() if p.is_dir()] == []
    assert len(asked) == 1  # both of its meshes are of one surface


def test_what_is_removed_is_in_no_file(edited, tmp_path, monkeypatch):
    edited = replace(edited, name="thing", surface=None)
    seen = visible(edited.gaussians, "thing")
    bits = np.zeros(seen.num, bool)
    bits[[0, 3, seen.num - 1]] = True
    edited.surface = Mock()
    removed = np.packbits(bits, bitorder="little").tobytes()
    work.edit(edited, 0, removed)
    assert edited.surface is None and edited.left.num == edited.gaussians.num - 3
    left = visible(edited.left, "thing")
    torch.testing.assert_close(left.means, seen.means[~torch.from_numpy(bits)])
    for kind in ("ply", "splat"):
        path, note = work.write(edited, kind, tmp_path)
        assert read_gaussians(path).num == edited.left.drawn().num == seen.num - 3
    surface_of, turntable_frames = Mock(return_value=None), Mock()
    monkeypatch.setattr(extract, "surface_of", surface_of)
    monkeypatch.setattr(work, "turntable_frames", turntable_frames)
    monkeypatch.setattr(work, "save_turntable", Mock())
    work.surface_of(edited, work.MESH)
    work.write(edited, "gif", tmp_path)
    asked = [function.call_args.args[0].num for function in (surface_of, turntable_frames)]
    assert asked == [edited.left.num] * 2
    again = work.viewer(edited)
    assert f'"count": {seen.num},' in again and base64.b64encode(removed).decode() in again
    work.edit(edited, 0, bytes(-(-seen.num // 8)))
    assert edited.left.num == edited.gaussians.num


def test_a_mesh_of_an_object_that_is_edited_meanwhile(page, edited, monkeypatch):
    """The file is written, but the surface, of the object before, is not kept."""
    edited = replace(edited, name="thing", surface=None)
    size = -(-visible(edited.gaussians, "").num // 8)

    def write(one, kind, folder, *_):
        if kind == "mesh-stl":
            work.edit(edited, 0, bytes([1]) + bytes(size - 1))
        one.surface = surface
        path = folder / "mesh"
        path.touch()
        return path, None

    monkeypatch.setattr(work, "write", write)
    for kind, kept in (("mesh-stl", False), ("mesh-glb", True)):
        surface, choices = Mock(), ("10,000 faces", "No texture", False)
        _, frame = page.writer(kind)((edited, []), *choices, MagicMock(), lambda *_: None)
        assert (edited.surface is surface) == kept == isinstance(frame, str)


@pytest.fixture
def page(edited, tmp_path, monkeypatch):
    """Handlers of the page; computations and the server are stand-ins."""
    pytest.importorskip("gradio", reason="needs gradio: pip install '.[app]'")
    from gamba_warp.app import actions

    monkeypatch.setattr(actions, "cut_image", lambda path, name, _: Mock(title=name, warning=""))
    monkeypatch.setattr(work, "run_model", lambda _, cut: replace(edited, name=cut.title))
    monkeypatch.setattr(work, "viewer", lambda edited: edited.name)
    monkeypatch.setattr(work, "thumbnail", lambda *_: None)
    thread = Mock(call=lambda function, wanted: function())
    return actions.Actions(None, None, Mock(new_folder=lambda: tmp_path), "cpu", thread)


def results_of(page, names, results):
    """Yield the results, and the strip, after each image."""
    given = [{"path": "a", "orig_name": name} for name in names]
    for _, kept, strip, *_ in page.take_all(given, results, MagicMock(), lambda *_: None):
        yield kept, strip["value"]


def test_the_strip_keeps_the_last_results(page, monkeypatch):
    said = []
    monkeypatch.setattr("gradio.Info", said.append)
    results, most = [], 12
    for count in (most - 1, 1, 1):
        assert not said
        names = map(str, range(len(results), most + 1)[:count])
        *_, (results, strip) = results_of(page, names, results)
    names = [str(number) for number in range(1, most + 1)]
    assert [each.edited.name for each in results] == [name for _, name in strip] == names
    assert said == ["The strip keeps the last 12 results."]


def test_each_of_several_images_is_shown_once_it_is_done(page, edited, monkeypatch):
    run = []
    monkeypatch.setattr(work, "run_model", lambda _, cut: run.append(cut.title) or edited)
    shown = results_of(page, "abc", [])
    for count in (1, 2):
        results, strip = next(shown)
        assert len(results) == len(strip) == len(run) == count

    def cancelled(*_):
        run.append("cancelled")
        raise main_thread.Cancelled("it was cancelled")

    monkeypatch.setattr(work, "run_model", cancelled)
    gradio = pytest.importorskip("gradio")
    with pytest.raises(gradio.Error, match="it was cancelled"):
        [*results_of(page, "de", [])]
    assert run == ["a", "b", "cancelled"], "the next one is not begun"


def test_an_elevation_set_by_hand_stays_with_its_image(page, edited, monkeypatch):
    asked = []

    def run_model(_, cut, angle):
        asked.append(angle)
        return replace(edited, name="a", image_key=cut.key)

    monkeypatch.setattr(work, "run_model", run_model)
    one, other = (Mock(key=key) for key in "ab")
    monkeypatch.setattr("gamba_warp.app.actions.apply_strokes", lambda cut, _: cut)
    results = []
    for cut in (one, one, other, one):
        results = page.reconstruct(cut, None, results, MagicMock(), lambda *_: None)[4]
        if len(results) == 2:
            work.edit(results[1].edited, 35, bytes(-(-visible(edited.gaussians, "").num // 8)))
            results[1].edited.chosen = 35
    assert asked[:3] == [None, None, None] and asked[3] == 35


def test_what_waits_for_the_device(page, edited, tmp_path):
    """Files that render nothing are written while a mesh or a movie is edited."""
    from gamba_warp.app.interface import build

    page._main_thread.call = Mock(side_effect=AssertionError("it waits"))
    blocks = build(page)
    called = [each for each in blocks.fns.values() if each.fn and each.targets[0][1] != "unload"]
    events = {each.targets[0][0]: each for each in called}
    events = {blocks.blocks[number].elem_id: each for number, each in events.items()}
    for kind in work.KINDS:
        waits = events[f"file-{kind}"].concurrency_id == events["make"].concurrency_id
        assert waits == (kind in {"gif", "zip", *work.MESHES})
        if not waits:
            state, inputs = (edited, []), ("10,000 faces", "No texture", False, MagicMock(), Mock())
            listed, _ = page.writer(kind)(state, *inputs)
            assert listed["value"] == [str(path) for path in state[1]] and state[1][0].is_file()
    assert events["cancel"].concurrency_id != events["make"].concurrency_id
    for name in ("image", "examples", "make", "several", "results", "file-ply", "file-gif"):
        assert [each.elem_id for each in events[name].show_progress_on] == ["status"]


def test_the_stages_of_a_mesh_are_shown(page, edited, monkeypatch):
    def surface_of(*_):
        STAGES.begin("mesh texture")
        raise main_thread.Cancelled("that is enough")

    monkeypatch.setattr(extract, "surface_of", surface_of)
    said, choices = [], ("10,000 faces", "No texture", False)
    gradio = pytest.importorskip("gradio")
    state = replace(edited, surface=None), []
    with pytest.raises(gradio.Error, match="that is enough"):
        page.writer("mesh-stl")(state, *choices, MagicMock(), lambda *step: said.append(step))
    assert said == [(0.1, "Writing -mesh.stl"), (0.7, "mesh texture")]
    assert STAGES.show is None


def test_the_viewer_has_the_input_and_the_last_mesh(edited):
    edited = replace(edited, surface=None)
    bare = work.viewer(edited)
    assert '"faces": 0' in bare and '"image": "data:image/webp;base64,' in bare
    edited.surface = triangle()
    assert '"faces": 1,' in work.viewer(edited)
