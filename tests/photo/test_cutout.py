"""Methods of the cut-out, in order, with their messages and editable results."""

import functools
import shutil
import ssl
import subprocess
import threading
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer

import numpy as np
import pytest
from helpers.cutouts import iou
from helpers.images import disc_on_noise, post
from helpers.matting import matting_network
from helpers.refusals import refused
from PIL import Image

from gamba_warp import versions
from gamba_warp.data.preprocess import recenter
from gamba_warp.errors import UserError
from gamba_warp.files import sha256
from gamba_warp.images import load_rgba, save_image
from gamba_warp.photo import cutout, matte, models
from gamba_warp.photo.cutout import CutoutOptions, cut_out, fault_of

SIZE = (140, 211)


@pytest.fixture
def network(tmp_path):
    """A network that classifies red as the object."""
    pytest.importorskip("onnxruntime")
    path = tmp_path / "red.onnx"
    path.write_bytes(matting_network(size=352))
    return path


@pytest.fixture
def busy(tmp_path):
    rgb, alpha = disc_on_noise(SIZE)
    save_image(tmp_path / "busy.png", rgb)
    return tmp_path / "busy.png", alpha


def test_each_way_in_its_order(tmp_path, network, busy):
    path, alpha = busy
    rgb = load_rgba(path)[..., :3]
    transparent, plain, mask = (tmp_path / f"{n}.png" for n in ("alpha", "plain", "mask"))
    half = alpha * (np.arange(SIZE[1]) < SIZE[1] // 2)
    on_white = rgb * alpha[..., None] + 1 - alpha[..., None]
    save_image(transparent, np.dstack([on_white, alpha - half]))
    save_image(plain, on_white)
    save_image(mask, half)
    options = CutoutOptions(matte_model=network)
    for file, how, want in (
        (transparent, "alpha", alpha - half),
        (path, "matte", alpha),
        (plain, "matte", alpha),  # a given network comes before colours
        (plain, "plain", alpha),
    ):
        found = cut_out(file, CutoutOptions() if how == "plain" else options)
        assert found.method == how and iou(found.mask, want) > 0.93
        assert found.source_rgb.shape == (*SIZE, 3) and found.mask.shape == SIZE
        assert found.rgba.shape[0] == found.rgba.shape[1] and found.rgba.dtype == np.float32
        assert found.note.startswith(found.how) and "--save-inputs" in found.note
    assert "red.onnx" in cut_out(path, options).how
    said: list[str] = []  # conftest.py forbids the network; none is kept
    found = cut_out(path, CutoutOptions(notify=said.append))
    assert found.method == "grabcut" and iou(found.mask, alpha) > 0.85
    assert " (no matting model)." in found.how and len(said) == 1
    assert "no matting model is here" in said[0] and models.PUBLISHED[0].address in said[0]
    for file in (path, transparent, plain):  # a mask is somebody's word
        found = cut_out(file, CutoutOptions(mask=mask, matte_model=network))
        assert found.method == "mask" and iou(found.mask, half) > 0.99 and "mask.png" in found.how


def grey(values):
    return Image.fromarray(np.asarray(values).astype(np.uint8))


MASKS = {  # of an object, in the values of files
    "white": lambda inside: grey(255 * inside),
    "one": lambda inside: grey(inside),
    "label": lambda inside: grey(7 + 8 * inside),
    "color": lambda inside: grey([128, 0, 0] * inside[..., None]),
    "alpha": lambda inside: grey([0, 0, 0, 255] * inside[..., None]),
    "inverted": lambda inside: grey(255 * ~inside),
    "labels": lambda inside: grey(1 * inside + (np.arange(SIZE[1]) > 50)),
}


@pytest.mark.parametrize("name", MASKS)
def test_masks_of_any_two_values(tmp_path, busy, name):
    path, alpha = busy
    MASKS[name](alpha > 0.5).save(tmp_path / "mask.png")
    options = CutoutOptions(mask=tmp_path / "mask.png")
    if name == "labels":
        return refused("has 3 labels; a mask is bright on the object alone", cut_out, path, options)
    found = cut_out(path, options)
    if name == "inverted":
        assert "the image's border (is the mask inverted?)" in found.warning
    else:
        assert iou(found.mask, alpha > 0.5) == 1 and not found.warning


def test_the_chosen_method_is_used(tmp_path, network, busy):
    path, alpha = busy
    rgba = load_rgba(path)
    plain = np.where(alpha[..., None] > 0.5, 0.2, 1)
    for name, rgb in (("noise", rgba[..., :3]), ("plain", plain)):
        save_image(tmp_path / f"{name}.png", np.dstack([rgb * np.ones(3), alpha]))
    for name, method, way in (
        ("noise", "alpha", CutoutOptions(matte_model=network)),
        ("noise", "matte", CutoutOptions(cutout="matte", matte_model=network)),
        ("noise", "grabcut", CutoutOptions(cutout="grabcut")),
        ("plain", "plain", CutoutOptions(cutout="plain")),
        ("plain", "none", CutoutOptions(cutout="none")),
    ):
        found = cut_out(tmp_path / f"{name}.png", way.checked())
        assert found.method == method, name
        assert iou(found.mask, np.ones(SIZE) if method == "none" else alpha) > 0.85
    for only, reason in (
        ("alpha", "has no transparency"),
        ("plain", "its border is not plain"),
        ("matte", "no matting model"),
    ):
        refused(reason, cut_out, path, CutoutOptions(cutout=only, notify=lambda line: None))
    with pytest.raises(UserError, match="--matte-model is not used by --cutout plain"):
        CutoutOptions(cutout="plain", matte_model=network).checked()


def test_a_cached_network_comes_before_colours(tmp_path, monkeypatch, network, busy):
    path, alpha = busy
    save_image(tmp_path / "plain.png", np.where(alpha[..., None] > 0.5, [0.9, 0.1, 0.1], 1))
    (tmp_path / "u2net.onnx").write_bytes(network.read_bytes())
    monkeypatch.setenv("U2NET_HOME", str(tmp_path))
    assert cut_out(tmp_path / "plain.png").method == "matte"


def box(top, bottom, left, right, value=1.0, size=(100, 120)):
    alpha = np.zeros(size, np.float32)
    alpha[top:bottom, left:right] = value
    return alpha


@pytest.mark.parametrize(
    "alpha, color, reason",
    [
        (box(20, 80, 20, 100), 0.2, None),
        (box(0, 80, 20, 100), 0.2, "touches the image's border"),
        (box(20, 80, 20, 50) + box(20, 80, 70, 100), 0.2, "2 separate parts"),
        (box(20, 80, 20, 100), 0.77, "along 100% of its outline it looks like"),
        (box(20, 80, 20, 100) - box(30, 70, 30, 60, 0.4), 0.2, "half transparent"),
    ],
)
def test_doubts_are_said(alpha, color, reason):
    rgb = np.where(alpha[..., None] > 0, color, 0.8) * np.ones(3)
    found = cutout.doubts_of(rgb.astype(np.float32), alpha)
    assert not found if reason is None else len(found) == 1 and reason in found[0]


def test_a_doubt_names_the_way_to_a_network_unless_it_is_refused(tmp_path, monkeypatch):
    path, options = post(tmp_path), CutoutOptions(notify=lambda line: None)
    about = "isnet-general-use, 179 MB, Apache 2.0, fetched once"
    advice = f"Try a network: gamba reconstruct --cutout matte ({about})"  # not said in the app
    assert advice in cut_out(path, options).warning
    assert options.matte() is None
    found = cut_out(path, options)
    assert found.warning.endswith("it touches the image's border.") and found.warning in found.note


def test_a_matte_without_an_object_gives_way(tmp_path, busy):
    pytest.importorskip("onnxruntime")
    path, alpha = busy
    for name, network, reason in (
        ("none", dict(bias=-60.0), "nothing stands out"),
        ("all", dict(bias=60.0), "all of the image would be the object"),
        ("vague", dict(weights=(0.1, 0, 0), bias=0.05), "it has no clear border"),
    ):
        file = tmp_path / f"{name}.onnx"
        file.write_bytes(matting_network(size=352, **network))
        found = cut_out(path, CutoutOptions(matte_model=file))
        # vague is over one half everywhere
        assert found.method == "grabcut" and iou(found.mask, alpha) > 0.85, name
        assert reason in found.how or name == "vague"


def test_sam_comes_before_the_matte(network, busy, monkeypatch):
    path, alpha = busy
    options = CutoutOptions(matte_model=network, sam="sam.pth")
    square = box(40, 100, 60, 140, size=SIZE)
    monkeypatch.setattr(cutout, "SamSegmenter", lambda *_: lambda rgb: square)
    found = cut_out(path, options)
    assert found.method == "sam" and iou(found.mask, square) > 0.95  # less a boundary of background
    square[:] = 0
    assert cut_out(path, options).method == "matte"


@pytest.mark.parametrize("alpha", [0.35, 0.8])
def test_an_object_that_is_soft_everywhere_is_spoken_of(tmp_path, alpha):
    rgba = np.zeros((40, 50, 4))
    rgba[10:30, 8:40] = 0.9, 0.2, 0.1, alpha
    Image.fromarray((rgba * 255).astype(np.uint8)).save(tmp_path / "soft.png")
    said = "at most 35% opaque" in cut_out(tmp_path / "soft.png").how
    assert said == (alpha < 0.5)


def test_what_no_way_cuts_is_one_line(tmp_path):
    path = tmp_path / "noise.png"
    save_image(path, np.random.default_rng(0).random((40, 50, 3)))
    said = refused("cannot tell object", cut_out, path)
    for word in (str(path), "GrabCut", "--mask", "--matte-model", "--sam"):
        assert word in said


@pytest.mark.parametrize("height, width", [(60, 60), (40, 60)])
def test_an_object_may_stay_where_it_is(tmp_path, height, width):
    pixels = np.zeros((height, width, 4), np.uint8)
    pixels[5:15, 30:50] = 200, 90, 30, 255
    path = tmp_path / "off.png"
    Image.fromarray(pixels).save(path)
    kept = cut_out(path, CutoutOptions(recenter=False)).rgba
    top = (60 - height) // 2
    assert kept.shape == (60, 60, 4)
    np.testing.assert_array_equal(kept[top : top + height] * 255, pixels)
    assert not kept[:top].any() and not kept[top + height :].any()
    assert cut_out(path).rgba.shape == (25, 25, 4)
    Image.fromarray(np.zeros((60, 60, 4), np.uint8)).save(path)
    refused("no object found", cut_out, path, CutoutOptions(recenter=False))


def test_the_cut_out_can_be_mended_and_given_again(tmp_path, network, busy):
    path, _ = busy
    first = cut_out(path, CutoutOptions(matte_model=network))
    assert first.editable.shape == (*SIZE, 4)
    away = first.mask == 0
    np.testing.assert_array_equal(first.editable[away][:, :3], first.source_rgb[away])
    edited = tmp_path / "busy-input.png"
    save_image(edited, first.editable)
    again = cut_out(edited)
    assert again.method == "alpha"
    # 8 bits, also of the alpha from which the object's bounds are taken
    np.testing.assert_allclose(again.mask, first.mask, atol=0.51 / 255)
    pixels = load_rgba(edited)
    pixels[:, :20, 3] = 1  # brought back by hand: the colours are still there
    save_image(edited, pixels)
    mended = cut_out(edited)
    np.testing.assert_allclose(mended.rgba, recenter(pixels), atol=1e-6)
    source = load_rgba(path)[:, :20, :3]
    np.testing.assert_allclose(mended.source_rgb[:, :20], source, atol=0.51 / 255)


def soft(fraction):
    """A mask of 600 pixels, of which those of this fraction of alpha's sum have an alpha of 0.8."""
    full = round(600 * 0.8 * (1 - fraction) / (0.8 * (1 - fraction) + fraction))
    inner = np.where(np.arange(600) < full, 1.0, 0.8).reshape(20, 30)
    return np.pad(inner, 10).astype(np.float32)


@pytest.mark.parametrize(
    "alpha, fault",
    [
        (box(0, 0, 0, 0), "nothing stands out"),
        (box(0, 100, 0, 120), "all of the image"),
        (box(0, 100, 0, 112), "touch"),
        (box(0, 100, 0, 48), None),
        (box(40, 47, 40, 48), None),
        (soft(0.36), None),
        (soft(0.44), "it has no clear border"),
    ],
)
def test_masks_are_judged(alpha, fault):
    found = fault_of(alpha)
    assert found is None if fault is None else fault in found


def test_models_are_found_where_rembg_keeps_them(tmp_path, monkeypatch):
    for name in ("U2NET_HOME", "REMBG_HOME", "XDG_DATA_HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("HOME", str(tmp_path))
    assert models.cached() is None
    old = tmp_path / ".u2net" / "u2netp.onnx"
    new = tmp_path / ".rembg" / "models" / "u2net" / "u2net.onnx"
    for path in (old, new):
        path.parent.mkdir(parents=True)
        path.touch()
        assert models.cached() == path  # the second is the better one
    monkeypatch.setenv("U2NET_HOME", str(old.parent))
    assert models.cached() == old
    monkeypatch.delenv("U2NET_HOME")
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "data"))
    assert models.cached() is None


def test_the_network_is_asked_only_once_and_never_in_silence(tmp_path, monkeypatch, busy):
    pytest.importorskip("onnxruntime")
    pooch = pytest.importorskip("pooch")
    path, _ = busy
    said, asked = [], []

    def retrieve(address, **options):
        asked.append((address, options["known_hash"], list(said)))
        raise ConnectionError("no route")

    monkeypatch.setattr(pooch, "retrieve", retrieve)
    assert cut_out(path, CutoutOptions(notify=said.append)).method == "grabcut"
    assert not asked and "no matting model is here" in said.pop()  # GAMBA_OFFLINE
    monkeypatch.setenv("GAMBA_OFFLINE", "0")
    assert cut_out(path, CutoutOptions(fetch=False, notify=said.append)).method == "grabcut"
    assert "no matting model is here" in said.pop() and not said and not asked
    options = CutoutOptions(notify=said.append)
    for _ in range(2):
        found = cut_out(path, options)
        assert found.method == "grabcut" and " (no matting model)." in found.how
    ((address, digest, before),) = asked
    first = models.PUBLISHED[0]
    assert (address, digest) == (first.address, f"sha256:{first.sha256}")
    assert len(before) == 1 and address in before[0] and "179 MB" in before[0]
    assert len(said) == 2 and "github.com cannot be reached" in said[1]  # once, of two images


class _Host(SimpleHTTPRequestHandler):
    """Copies of files; what is asked below /plain/ is sent on to an address of http."""

    def do_GET(self):
        if not self.path.startswith("/plain/"):
            return super().do_GET()
        self.send_response(302)
        self.send_header("Location", "http://127.0.0.1:9/u2netp.onnx")
        self.end_headers()

    def log_message(self, *words):
        pass


@pytest.fixture
def mirror(tmp_path, monkeypatch):
    """A host of one's own with copies, of which one is right; and rembg's folder, empty."""
    pytest.importorskip("onnxruntime")
    pytest.importorskip("pooch")
    if shutil.which("openssl") is None:
        pytest.skip("no openssl, which makes the host's certificate")
    folder = tmp_path / "mirror"
    folder.mkdir()
    (folder / "u2netp.onnx").write_bytes(matting_network(size=352))
    (folder / "silueta.onnx").write_bytes(b"another file")
    right = sha256(folder / "u2netp.onnx")
    known = [m._replace(sha256=right) if m.name == "u2netp" else m for m in models.PUBLISHED]
    monkeypatch.setattr(models, "PUBLISHED", tuple(known))
    monkeypatch.setenv("U2NET_HOME", str(tmp_path / "rembg"))
    monkeypatch.setenv("GAMBA_OFFLINE", "0")
    key, certificate = tmp_path / "key.pem", tmp_path / "certificate.pem"
    names = ["-subj", "/CN=127.0.0.1", "-addext", "subjectAltName=IP:127.0.0.1", "-days", "2"]
    kind = ["-x509", "-nodes", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1"]
    files = ["-keyout", str(key), "-out", str(certificate)]
    subprocess.run(["openssl", "req", *kind, *names, *files], check=True, capture_output=True)
    monkeypatch.setenv("REQUESTS_CA_BUNDLE", str(certificate))
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(certificate, key)
    handler = functools.partial(_Host, directory=folder)
    with ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        server.socket = context.wrap_socket(server.socket, server_side=True)
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"https://127.0.0.1:{server.server_port}"
        server.shutdown()


def test_a_model_comes_from_the_address_of_a_copy(tmp_path, monkeypatch, busy, mirror):
    said = []
    options = CutoutOptions(matte_model=f"{mirror}/u2netp.onnx?download=true", notify=said.append)
    how = cut_out(busy[0], options.checked()).how
    assert how.startswith("The matting model u2netp.onnx cut the object out.")
    assert len(said) == 1 and f"from {mirror}" in said[0] and models.cached() is not None
    (tmp_path / "rembg" / "models" / "u2netp" / "u2netp.onnx").unlink()
    http = mirror.replace("https", "http")
    for address, reason in (
        (f"{mirror}/silueta.onnx", "hash"),  # another content
        (f"{mirror}/isnet-general-use.onnx", "404"),
        (f"{mirror}/own.onnx", "must end in one of isnet-general-use.onnx, u2net.onnx"),
        (f"{http}/u2netp.onnx", "only addresses of https are fetched"),
        (f"{mirror}/plain/u2netp.onnx", "redirected to http://127.0.0.1:9/u2netp.onnx, which is"),
    ):
        options = CutoutOptions(matte_model=address, notify=said.append)
        assert f"--matte-model {address}: " in refused(reason, options.checked)
    assert not list((tmp_path / "rembg").rglob("*.*"))
    monkeypatch.setenv("GAMBA_OFFLINE", "1")
    refused("GAMBA_OFFLINE", CutoutOptions(matte_model=f"{mirror}/u2netp.onnx").checked)


def test_a_kept_model_that_is_damaged_gives_way(tmp_path, monkeypatch, busy):
    pytest.importorskip("onnxruntime")
    monkeypatch.setenv("U2NET_HOME", str(tmp_path))
    (tmp_path / "u2net.onnx").write_bytes(b"half of a fi")
    found = cut_out(busy[0])
    assert found.method == "grabcut" and "not a model in ONNX" in found.how


def test_without_the_extra_colours_alone_cut(monkeypatch, busy):
    for module in (cutout, matte, versions):
        monkeypatch.setattr(module, "find_spec", lambda name: None)
    said = []
    found = cut_out(busy[0], CutoutOptions(notify=said.append))
    assert found.method == "grabcut" and len(said) == 1 and "pip install '.[photo]'" in said[0]
    with pytest.raises(ModuleNotFoundError, match="onnxruntime"):
        CutoutOptions(matte_model="model.onnx").checked()


@pytest.mark.parametrize("kind", ["rounded corners", "faint corner pixels"])
def test_a_few_transparent_pixels_are_no_cut_out(tmp_path, kind):
    """A screenshot with rounded corners; a photograph with twelve faint pixels in its corners."""
    y, x = np.mgrid[:120, :160]
    inside = (x - 80) ** 2 + (y - 60) ** 2 < 30**2
    rgba = np.full((120, 160, 4), 255, np.uint8)
    rgba[inside, :3] = (200, 30, 40)
    if kind == "rounded corners":
        for top, left in ((0, 0), (0, 152), (112, 0), (112, 152)):
            down, right = np.mgrid[:8, :8]
            far = np.hypot(down - 7 * (top == 0), right - 7 * (left == 0)) > 7
            rgba[top : top + 8, left : left + 8, 3][far] = 0
    else:
        rgba[:2, :3, 3] = rgba[-2:, -3:, 3] = 0
    Image.fromarray(rgba).save(tmp_path / "a.png")
    said = []
    found = cut_out(tmp_path / "a.png", CutoutOptions(fetch=False, notify=said.append))
    assert found.method != "alpha"
    kept = found.mask > 0.5
    assert (kept & inside).sum() > 0.95 * (kept | inside).sum()
    assert any("no cut-out" in line for line in said)
    assert cut_out(tmp_path / "a.png", CutoutOptions(cutout="alpha")).method == "alpha"


@pytest.mark.parametrize("spread", [0, 1], ids=["one colour", "noise"])
def test_with_a_few_transparent_pixels_the_object_may_be_all(tmp_path, spread):
    rgba = np.random.default_rng(0).random((40, 50, 4)) * spread
    rgba[..., 3] = 1
    rgba[0, :3, 3] = 0
    save_image(tmp_path / "a.png", rgba)
    found = cut_out(tmp_path / "a.png", CutoutOptions(fetch=False, notify=lambda line: None))
    assert found.method == "alpha" and (found.mask == rgba[..., 3]).all()


@pytest.mark.parametrize("second", [0.0, 1.0, "elsewhere"])
def test_a_small_object_stays_the_one_that_was_found(tmp_path, monkeypatch, second):
    """If a method finds nothing, or another thing, among the object's own pixels."""
    monkeypatch.setattr(cutout, "WORKING_SIZE", 128)
    save_image(tmp_path / "noise.png", np.random.default_rng(0).random((160, 160, 3)))

    def segmenter(rgb):
        alpha = np.zeros(rgb.shape[:2], np.float32)
        if len(rgb) == 128:
            alpha[40:56, 32:64] = 1
        elif second == "elsewhere":
            alpha[:, :20] = 1
        else:
            alpha[:] = second
        return alpha

    monkeypatch.setattr(cutout, "SamSegmenter", lambda *_: segmenter)
    found = cut_out(tmp_path / "noise.png", CutoutOptions(sam="sam.pth"))
    rows, columns = (np.ptp(np.nonzero(found.rgba[..., 3] > 0.5)[axis]) + 1 for axis in (0, 1))
    assert found.method == "sam" and (rows, columns) == (20, 40)  # 1.25 as many


@pytest.mark.parametrize("way", ["plain", "alpha", "mask", "matte"])
def test_a_small_object_of_a_large_image_keeps_its_pixels(tmp_path, network, way):
    """As sharp as in a part of the same image."""
    y, x = np.mgrid[:960, :1280]
    inside = ((x - 800) / 90) ** 2 + ((y - 500) / 60) ** 2 < 1
    stripes = np.where((x // 4 + y // 4) % 2, 250, 170).astype(np.uint8)
    rgb = np.full((960, 1280, 3), 235, np.uint8)
    rgb[inside] = np.stack([stripes, stripes // 8, stripes // 9], -1)[inside]
    alpha = (255 * inside).astype(np.uint8)
    image = np.dstack([rgb, alpha]) if way == "alpha" else rgb
    mask, found = tmp_path / "mask.png", []
    for rows, columns in ((slice(960), slice(1280)), (slice(400, 600), slice(650, 950))):
        Image.fromarray(image[rows, columns].copy()).save(tmp_path / "a.png")
        Image.fromarray(alpha[rows, columns].copy()).save(mask)
        chosen = {"matte": dict(matte_model=network, cutout=way), "mask": dict(mask=mask)}
        options = CutoutOptions(fetch=False, **chosen.get(way, {}))
        found.append(cut_out(tmp_path / "a.png", options))
    whole, close = found
    assert whole.method == close.method == way
    assert abs(len(whole.rgba) - len(close.rgba)) <= 4 and len(whole.rgba) >= 200
    assert whole.mask.shape == (768, 1024)  # for an editor
    save_image(tmp_path / "whole-input.png", whole.editable)  # may be edited, and used again
    found.append(cut_out(tmp_path / "whole-input.png"))
    contrast = [f.rgba[..., 0][f.rgba[..., 3] > 0.9].std() for f in found]
    assert contrast == pytest.approx([contrast[1]] * 3, rel=0.05) and contrast[0] > 0.1
    assert "the result is blurred" not in whole.how


def test_an_object_of_few_pixels_is_named(tmp_path):
    y, x = np.mgrid[:300, :300]
    rgb = np.full((300, 300, 3), 255, np.uint8)
    rgb[(x - 150) ** 2 + (y - 150) ** 2 < 40**2] = (30, 60, 200)
    Image.fromarray(rgb).save(tmp_path / "a.png")
    found = cut_out(tmp_path / "a.png", CutoutOptions(fetch=False))
    assert " pixels, so the result is blurred." in found.how
