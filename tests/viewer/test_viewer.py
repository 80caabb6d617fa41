"""The viewer in a browser: images like our rasterizer's, controls, and no errors."""

import base64
import gzip
import io
import math

import numpy as np
import pytest
import torch
from helpers.gaussians import some
from helpers.meshes import glb, gltf
from helpers.views import cloud_of
from PIL import Image

from gamba_warp import render
from gamba_warp.cameras import Cameras, intrinsics, orbit
from gamba_warp.formats.gaussians.files import write_gaussians
from gamba_warp.formats.meshes import load_mesh
from gamba_warp.formats.names import splat_suffix
from gamba_warp.formats.ply import save_ply
from gamba_warp.formats.read import read_gaussians
from gamba_warp.gaussians import Gaussians
from gamba_warp.surfaces.extract import Surface
from gamba_warp.surfaces.files import save_mesh
from gamba_warp.surfaces.texture import Texture
from gamba_warp.viewer.pack import viewed_mesh
from gamba_warp.viewer.page import write_viewer

CAMERA = (1.5, 49.1, 0.0)
WIDE, HIGH = 201, 150
FOCAL = HIGH / 2 / math.tan(math.radians(CAMERA[1]) / 2)  # pixels


def colourful(n=400, coefficients=None):
    """Gaussians of all sizes and turns, most of them small, perhaps with harmonics."""
    found = some(n)
    found.scales = 0.005 + 0.06 * torch.rand(n, 3) ** 3
    if coefficients:
        found.harmonics = 0.15 * torch.randn(n, coefficients, 3)
    return found


def tetrahedron():
    vertices = 0.4 * np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1.0]])
    faces = np.array([[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]])
    return Surface(vertices, faces, np.eye(4, 3, dtype=np.float32))


@pytest.fixture
def viewer(browser_page, tmp_path):
    """Opens the page of some Gaussians, and waits for its first image."""

    def opened(gaussians, width=WIDE, height=HIGH, mesh=None, camera=CAMERA, image=None, **options):
        path = tmp_path / "view.html"
        write_viewer(path, "A chair", gaussians, mesh=mesh, camera=camera, image=image)
        options = {"color_scheme": "light", "reduced_motion": "reduce", **options}
        found = browser_page(path, width, height, **options)
        found.promised("gambaViewer.rest()")
        return found

    return opened


def canvas(opened) -> np.ndarray:
    """The canvas at rest, ``[H, W, 3]`` in [0, 1]."""
    address = opened.promised("gambaViewer.png()")
    with Image.open(io.BytesIO(base64.b64decode(address.partition(",")[2]))) as image:
        return np.asarray(image.convert("RGB")) / 255


def look_from(page, azimuth, elevation, distance):
    where = [math.radians(azimuth), math.radians(elevation), distance]
    page.evaluate(
        "([azimuth, elevation, distance]) => gambaViewer.setCamera({azimuth, elevation, distance})",
        where,
    )


def state(page) -> dict:
    return page.evaluate(
        "(({azimuth, elevation, distance, target}) => ({azimuth, elevation, distance, target}))"
        "(gambaViewer.camera)"
    )


def psnr(one, other) -> float:
    return -10 * math.log10(((one - other) ** 2).mean())


@pytest.mark.parametrize("coefficients", [None, 3, 8, 15])
def test_its_image_is_that_of_the_rasterizer(viewer, one_thread, coefficients):
    gaussians = colourful(coefficients=coefficients)
    opened = viewer(gaussians)
    for azimuth, elevation, distance in ((0, 0, 1.5), (40, 20, 1.2), (200, -35, 1.9)):
        look_from(opened.page, azimuth, elevation, distance)
        poses = orbit(torch.tensor([float(azimuth)]), elevation, distance)
        cameras = Cameras(poses, intrinsics(WIDE, HIGH, CAMERA[1])[None], WIDE, HIGH)
        wanted = render(gaussians, cameras, torch.ones(3)).rgb[0].clamp(0, 1).numpy()
        # 8 bits of colour between any two Gaussians leave 45 dB and more
        assert psnr(canvas(opened), wanted) > 40
    assert wanted.std() > 0.1 and not opened.messages


def test_its_limits_are_those_of_the_rasterizer(viewer, one_thread):
    """An opaque Gaussian lets a hundredth through; one beside the image reaches into it."""
    gaussians = Gaussians(
        means=torch.tensor([[0.0, 0.0, 0.0], [1.0, 0.0, -1.1]]),
        quats=None,
        scales=torch.tensor([[0.1], [0.3]]).expand(2, 3).contiguous(),
        opacities=torch.tensor([1.0, 0.9]),
        colors=torch.tensor([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]]),
    )
    opened = viewer(gaussians)
    poses = orbit(torch.zeros(1), 0.0, CAMERA[0])
    cameras = Cameras(poses, intrinsics(WIDE, HIGH, CAMERA[1])[None], WIDE, HIGH)
    wanted = render(gaussians, cameras, torch.ones(3)).rgb[0].clamp(0, 1).numpy()
    assert wanted[HIGH // 2, WIDE // 2, 1] < 0.02 and wanted[HIGH // 2, -1, 1] < 0.98
    assert np.abs(canvas(opened) - wanted).max() < 1.5 / 255 and not opened.messages


def test_drags_pinches_and_keys_move_the_camera(viewer):
    opened = viewer(colourful(), has_touch=True)
    page, mouse = opened.page, opened.page.mouse
    first, before = canvas(opened), state(page)
    assert first.std() > 0.05  # it is not blank

    mouse.move(100, 70)
    mouse.down()
    mouse.move(130, 80, steps=3)
    mouse.up()
    turned = state(page)
    assert turned["azimuth"] < before["azimuth"] and turned["elevation"] > before["elevation"]
    assert np.abs(canvas(opened) - first).mean() > 0.02

    mouse.move(100, 70)
    mouse.down(button="right")
    mouse.move(120, 70, steps=2)
    mouse.up(button="right")
    panned = state(page)
    assert panned["azimuth"] == turned["azimuth"] and panned["target"] != turned["target"]

    opened.fingers("touchStart", (80, 70), (120, 70))
    opened.fingers("touchMove", (60, 70), (140, 70))
    opened.fingers("touchEnd")
    opened.until("gambaViewer.camera.distance < 0.76")  # twice as far apart: half as far
    pinched = state(page)
    assert pinched["distance"] == pytest.approx(before["distance"] / 2, rel=1e-3)
    opened.fingers("touchStart", (80, 70))
    opened.fingers("touchMove", (100, 70))
    opened.fingers("touchEnd")
    opened.until(f"gambaViewer.camera.azimuth < {pinched['azimuth']}")

    mouse.wheel(0, 120)
    opened.until(f"gambaViewer.camera.distance > {pinched['distance']}")
    for way in (1, -1):  # never over the pole, where left and right change sides
        page.evaluate(f"gambaViewer.act.turn(0, {way * 1e5})")
        assert state(page)["elevation"] == way * 1.55
    page.keyboard.press("r")
    opened.promised("gambaViewer.rest()")
    assert state(page) == before
    assert np.abs(canvas(opened) - first).max() < 0.01 and not opened.messages


def ball(x, y, z, colour):
    """One round, nearly opaque Gaussian."""
    return cloud_of([[x, y, z]], 0.03, 0.95, colour)


def double_click(opened, x, y):
    """Click with the camera at rest, and wait for the end of the motion."""
    opened.promised("gambaViewer.rest()")
    opened.page.mouse.dblclick(x, y)
    opened.until("gambaViewer.picks.size === 0")
    opened.promised("gambaViewer.rest()")


@pytest.mark.parametrize("mode", ["1", "2"])
def test_a_double_click_looks_at_the_point_below(viewer, mode):
    opened = viewer(ball(0.2, 0.1, -0.1, [0.0, 0.0, 1.0]))
    opened.page.keyboard.press(mode)
    x, y = (half + FOCAL * at / 1.4 for half, at in ((WIDE / 2, 0.2), (HIGH / 2, 0.1)))
    for away in (6, 3, 0):  # pixels; a centre is 4 wide, and so is half of the ball
        opened.page.keyboard.press("r")
        double_click(opened, x, y + away)
        assert (state(opened.page)["target"][0] > 0.1) == (away < 4)
    # Along the ray the ball is densest at its centre; half a pixel is 0.005 of the object.
    assert state(opened.page)["target"] == pytest.approx([0.2, 0.1, -0.1], abs=0.02)
    double_click(opened, 5, 5)  # nothing is below
    assert state(opened.page)["target"][0] > 0.1 and not opened.messages


def test_a_double_click_finds_the_rim_of_many(viewer):
    """200 Gaussians at 3.2 deviations: each blocks 1/176, over 1/255; together two thirds."""
    many = ball(0.0, 0.0, 0.0, [0.0, 0.0, 1.0])
    for name in ("means", "scales", "opacities", "colors"):
        value = getattr(many, name)
        setattr(many, name, value.repeat(200, *[1] * (value.ndim - 1)))
    many.scales[:] = 0.1
    opened = viewer(many)
    double_click(opened, WIDE / 2 + FOCAL * math.tan(math.asin(0.32 / 1.5)), HIGH / 2)
    assert state(opened.page)["target"][0] > 0.25


def test_what_it_shows(viewer):
    opened = viewer(colourful(), mesh=tetrahedron())
    page = opened.page
    splats = canvas(opened)
    page.click("[data-mode=centres]")
    points = canvas(opened)
    page.click("[data-mode=mesh]")
    mesh = canvas(opened)
    for one, other in ((splats, points), (points, mesh), (mesh, splats)):
        assert np.abs(one - other).mean() > 0.01
    covered = (mesh < 0.999).any(-1)
    assert 0.05 < covered.mean() < 0.6 and covered[HIGH // 2, WIDE // 2]
    page.keyboard.press("l")
    dark = canvas(opened)
    assert dark[0, 0].max() < 0.2 < 0.9 < mesh[0, 0].min()
    assert np.abs(dark - mesh)[covered].mean() < 0.02  # only the background is another
    assert not page.get_attribute("#lines path", "d")  # the camera is drawn when asked for
    page.click("#do-input")
    assert page.get_attribute("#do-input", "aria-pressed") == "true"
    opened.promised("gambaViewer.rest()")
    assert len(page.get_attribute("#lines path", "d")) > 50
    page.keyboard.press("?")
    assert page.is_visible("#help") and "Double-click" in page.inner_text("#help")
    page.keyboard.press("Escape")
    assert not page.is_visible("#help") and not opened.messages


def test_a_slider_compares_the_object_with_the_input_and_the_mesh(viewer):
    page = (opened := viewer(colourful())).page
    assert not page.is_visible("#wipe")
    splats = canvas(opened)
    image = np.zeros((40, 40, 4))
    image[10:30, 10:30] = 1, 0, 0, 1
    page = (opened := viewer(colourful(), 700, HIGH + 300, tetrahedron(), image=image)).page
    slide = "value => { const s = document.querySelector('#wipe input');"
    slide += "s.value = value; s.dispatchEvent(new Event('input', { bubbles: true })); }"
    splats = canvas(opened)
    page.click("[data-mode=mesh]")
    mesh = canvas(opened)
    page.click("[data-mode=gaussians]")
    page.evaluate(slide, 0.25)
    both, edge = canvas(opened), round(0.25 * 700)
    np.testing.assert_array_equal(both[:, :edge], mesh[:, :edge])
    np.testing.assert_array_equal(both[:, edge:], splats[:, edge:])
    assert np.abs(splats - mesh)[:, :edge].max() > 0.1 < np.abs(splats - mesh)[:, edge:].max()
    look_from(page, 80, 20, 2)
    page.evaluate(slide, -0.5)
    opened.promised("gambaViewer.rest()")
    assert state(page)["azimuth"] == 0  # the input's camera
    with Image.open(io.BytesIO(page.screenshot())) as seen:
        rgb = np.asarray(seen.convert("RGB")).astype(int)
    side = page.locator("#canvas").bounding_box()["height"]  # the image's, in the middle
    column, row = round(350 - side / 8), round(side / 2)
    assert rgb[row, column, 0] > 240 > 20 > rgb[row, column, 1]
    assert rgb[row, round(350 - 3 * side / 8)].min() > 250 < rgb[row, 20].min()
    page.keyboard.press("ArrowLeft")
    assert page.evaluate("gambaViewer.wipe") == 0 and not page.is_visible("#seen")
    assert not opened.messages


def test_a_image_is_saved(viewer, tmp_path):
    opened = viewer(colourful())
    shown = canvas(opened)
    with opened.page.expect_download() as download:
        opened.page.keyboard.press("s")
    download.value.save_as(tmp_path / "saved.png")
    assert download.value.suggested_filename == "A-chair.png"
    with Image.open(tmp_path / "saved.png") as image:
        np.testing.assert_array_equal(np.asarray(image.convert("RGB")) / 255, shown)


def test_a_image_has_the_asked_size_and_an_alpha(viewer, tmp_path):
    opened = viewer(colourful(), 600, 500)
    page = opened.page
    for _ in range(3):
        page.keyboard.press("l")
    assert page.evaluate("document.documentElement.dataset.ground") == "clear"
    page.evaluate("gambaViewer.about.title = 'chair.ply'")
    page.click("#do-image")
    with page.expect_download() as download:
        page.click("[data-side='1024']")
    assert download.value.suggested_filename == "chair.png" and not page.is_visible("#image")
    download.value.save_as(tmp_path / "saved.png")
    with Image.open(tmp_path / "saved.png") as image:
        assert max(image.size) == 1024 and image.mode == "RGBA"
        alpha = np.asarray(image)[..., 3]
    assert alpha[0, 0] == 0 and alpha.max() > 250 and not opened.messages


def test_the_tools_cover_no_part_of_the_image_and_can_be_left_out(viewer, tmp_path):
    opened = viewer(colourful(), 900, 600)
    page = opened.page
    image, bar = (page.query_selector(name).bounding_box() for name in ("#canvas", "#bar"))
    assert image["y"] + image["height"] <= bar["y"]
    page.goto((tmp_path / "view.html").as_uri() + "?controls=0&ground=grey")
    opened.promised("gambaViewer.rest()")
    assert not page.is_visible("#bar") and not page.is_visible("header")
    assert page.query_selector("#canvas").bounding_box()["height"] == 600
    assert page.evaluate("background()") == [140 / 255] * 3 + [1]


@pytest.mark.parametrize("slow", [False, True])
def test_it_turns_until_it_is_touched(viewer, slow):
    opened = viewer(colourful(40), reduced_motion="no-preference")
    page = opened.page
    page.reload()
    if slow:  # the coarsest image
        page.evaluate("Object.assign(gambaViewer, { adapt() {}, coarse: SIZES.length - 1 })")
    for _ in range(100):
        page.wait_for_timeout(100)
        if page.evaluate("gambaViewer.camera.azimuth < 0"):
            break
    page.mouse.click(100, 70)
    held = page.evaluate("[gambaViewer.turning, gambaViewer.camera.azimuth]")
    opened.promised("gambaViewer.rest()")
    assert held[1] < 0 and held == [False, page.evaluate("gambaViewer.camera.azimuth")]
    assert not opened.messages


def test_an_object_of_any_size_anywhere(viewer):
    gaussians = colourful()
    small = canvas(viewer(gaussians, camera=None))
    moved = gaussians.transformed(torch.eye(3), torch.tensor([3e4, -2e4, 1e4]), 2e3)
    # float32 centres at 3e4 are exact to 1e-3, a millionth of the object's size
    assert psnr(canvas(viewer(moved, camera=None)), small) > 45


def drop(opened, name, content):
    """Drop a file on the page."""
    opened.page.evaluate(
        """([name, text]) => {
          const dropped = new DataTransfer();
          const bytes = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
          dropped.items.add(new File([bytes], name));
          window.dispatchEvent(new DragEvent("drop", { dataTransfer: dropped, cancelable: true }));
        }""",
        [name, base64.b64encode(content).decode()],
    )


@pytest.mark.parametrize(
    "kind, coefficients",
    [
        *[("ply", None), ("ply", 8), ("splat", None), ("compressed-ply", None)],
        *[("compressed-ply", 15), ("spz", None), ("spz", 3), ("spz", 15), ("spz 2", 8)],
    ],
)
def test_a_dropped_file_is_shown_as_gamba_view_shows_it(viewer, tmp_path, kind, coefficients):
    """The page's reader in JavaScript and ours are two programs for the same pixels."""
    gaussians = colourful(coefficients=coefficients)
    gaussians.means += torch.tensor([30.0, -20.0, 7.0])
    gaussians.opacities[:5] = 0.003  # not seen
    path = tmp_path / f"chair{splat_suffix(kind.split()[0])}"
    write_gaussians(path, gaussians, kind.split()[0])
    if kind == "spz 2":  # rotations of three bytes
        body, end = gzip.decompress(path.read_bytes()), 16 + 16 * gaussians.num
        turns = np.random.default_rng(0).integers(55, 200, 3 * gaussians.num).astype(np.uint8)
        body = body[:4] + b"\2" + body[5:end] + turns.tobytes() + body[end + 4 * gaussians.num :]
        path.write_bytes(gzip.compress(body))
    wanted = canvas(viewer(read_gaussians(path), camera=None))

    opened = viewer(colourful(40), mesh=tetrahedron())
    opened.page.keyboard.press("3")
    before = canvas(opened)
    drop(opened, path.name, path.read_bytes())
    opened.until("gambaViewer.ready && gambaViewer.about.title.startsWith('chair')")
    # The last bit of a float16 may differ; over 400 Gaussians that is a level of colour.
    assert np.abs(canvas(opened) - wanted).max() <= 4 / 255 < np.abs(wanted - before).max()
    assert opened.page.inner_text("#about").endswith(" Gaussians")
    assert not opened.page.is_visible("[data-mode=mesh]") and not opened.messages
    opened.page.keyboard.press("3")  # the former object's mesh is gone
    assert np.abs(canvas(opened) - wanted).max() <= 4 / 255


@pytest.mark.parametrize("kind", ["glb", "textured glb", "bare glb", "obj", "bare obj", "stl"])
def test_a_dropped_mesh_is_shown_as_gamba_view_shows_it(viewer, tmp_path, kind):
    mesh = tetrahedron()
    if kind == "textured glb":
        image = np.random.default_rng(0).random((8, 8, 3), np.float32)
        uvs = np.array([[[0.1, 0.1], [0.9, 0.2], [0.4, 0.8]]] * 4, np.float32)
        mesh.texture = Texture(uvs, image)
    if kind.startswith("bare"):
        mesh.colors = None
    path = tmp_path / f"chair.{kind.split()[-1]}"
    save_mesh(path, mesh)
    gaussians = colourful(40)
    opened = viewer(gaussians, mesh=viewed_mesh(load_mesh(path)), camera=None)
    opened.page.keyboard.press("3")
    wanted = canvas(opened)
    opened = viewer(gaussians, camera=None)
    before = canvas(opened)
    drop(opened, path.name, path.read_bytes())
    opened.until("gambaViewer.mode === 'mesh'")
    assert np.abs(canvas(opened) - wanted).max() <= 2 / 255 < np.abs(wanted - before).max()
    assert "4 faces" in opened.page.inner_text("#about") and not opened.messages


def triangle(nodes=None, attributes=(), primitive=(), material=(), **top):
    """A .glb of a triangle with something else in it."""
    part = {"attributes": {"POSITION": 0, **dict(attributes)}, "material": 0, **dict(primitive)}
    tree = gltf(
        nodes=list(nodes or [{"mesh": 0}]),
        meshes=[{"primitives": [part]}],
        materials=[dict(material)],
        buffers=[{"byteLength": 36}],
        **top,
    )
    return glb(tree, np.eye(3, dtype="<f4").tobytes())


PARTS = [
    ({"extensionsUsed": ["KHR_texture_transform"]}, "extensions .KHR_texture_transform"),
    ({"animations": [{}]}, "animations or skins"),
    ({"nodes": [{"mesh": 0, "scale": [2, 2, 2]}]}, "moved or unused parts"),
    ({"nodes": [{}]}, "moved or unused parts"),
    ({"attributes": {"JOINTS_0": 0}}, "the attribute JOINTS_0"),
    ({"primitive": {"targets": [{}]}}, "morph targets"),
    ({"primitive": {"mode": 0}}, "points"),
    ({"material": {"emissiveFactor": [1, 0, 0]}}, "light of its own"),
    ({"material": {"normalTexture": {"index": 0}}}, "a normalTexture"),
    ({"material": {"alphaMode": "BLEND"}}, "transparent materials"),
]


def test_a_dropped_file_that_cannot_be_shown(viewer, tmp_path):
    save_ply(tmp_path / "chair.ply", colourful(40))
    good = (tmp_path / "chair.ply").read_bytes()
    write_gaussians(tmp_path / "small.ply", colourful(40), "compressed-ply")
    packed = (tmp_path / "small.ply").read_bytes()
    opened = viewer(colourful(40))
    before = canvas(opened)
    more = good.replace(b"end_header", b"element camera 0\nproperty float x\nend_header")
    for name, content, reason in (
        ("chair.ply", more, "Only Gaussians"),
        ("chair.ply", good[:-1], "cut short"),
        ("chair.ply", good + b"0", "more than its 40 Gaussians"),
        ("chair.ply", good.replace(b"float nx", b"float ny"), "Only Gaussians"),
        ("chair.ply", good[:-4] + b"\0\0\x80\x7f", "1 of 40 Gaussians are invalid"),
        ("chair.ply", good.replace(b"f_dc_1", b"trbf_scale"), "trbf_scale are not read here"),
        ("chair.ply", good.replace(b"binary_little_endian", b"ascii"), "Only Gaussians"),
        ("chair.ply", b"", "Only Gaussians"),
        ("chair.glb", b"glTF" + bytes(40), "is damaged"),
        ("chair.glb", b"glTF", "another form than .glb"),
        (
            "chair.stl",
            b"solid",
            "another form than binary .stl, .*gamba view GAUSSIANS --mesh FILE",
        ),
        ("chair.obj", b"usemtl red", "materials in other files"),
        ("chair.obj", b"v 0 0 0 2", "other than 3 or 6 numbers"),
        ("chair.obj", b"v 0 0 0 255 0 0", "outside of 0 to 1"),
        ("chair.obj", b"v 0 0 0\ncurv 1 2", "lines curv"),
        ("chair.obj", b"v 0 0 0\nf 0 1 1", "a vertex that is missing"),
        *(("chair.glb", triangle(**part), reason) for part, reason in PARTS),
        ("chair.obj", b"v 0 0 0", "no triangles"),
        ("chair.obj", b"v 0 0 0\nf 1 2 3", "a vertex that is missing"),
        ("chair.obj", b"v 0 0 x\nf 1 1 1", "not finite"),
        ("chair.SPZ", b"NGSP" + bytes(40), "gamba view FILE"),
        ("chair.spz", b"\x1f\x8b" + bytes(40), "is damaged"),
        ("chair.spz", gzip.compress(b"NGSP\3\0\0\0\1\0\0\0" + bytes(8)), "is damaged"),
        ("chair.spz", gzip.compress(b"NGSP\7\0\0\0" + bytes(8)), "gamba view FILE"),
        ("chair.ply", packed.replace(b"chunk 1", b"chunk 0"), "cut short|more than|do not match"),
        ("chair.ply", packed[:-1], "cut short"),
        ("chair.ply", b"ply\nformat ascii 1.0\n", "gamba view FILE"),
        ("chair.txt", b"", "open here[.]$"),
        ("chair.splat", b"0" * 33, "cut short"),
        ("chair.splat", b"", "No Gaussian"),
        ("chair.splat", b"\0" * 32, "No Gaussian"),
        ("chair.splat", b"\0" * 24 + b"\xff" * 8, "at one point"),
    ):
        drop(opened, name, content)
        opened.until(f"byId('message-text').textContent.match(/{reason}/)")
        assert name in opened.page.inner_text("#message-title")
        opened.page.evaluate("say('')")
    assert opened.page.evaluate("gambaViewer.about.title") == "A chair" and not opened.messages
    np.testing.assert_array_equal(canvas(opened), before)


def test_a_phone_and_a_small_frame_hold_all_buttons(viewer):
    for width, height in ((390, 700), (345, 700), (820, 700), (300, 300), (640, 300)):
        page = viewer(colourful(), width, height, mesh=tetrahedron()).page
        if min(width, height) > 300:
            area = page.locator("#canvas").bounding_box()
            assert page.locator("#bar").bounding_box()["y"] >= area["height"] - 1
            assert page.locator("#wipe input").is_visible()
        boxes = [button.bounding_box() for button in page.query_selector_all("#bar button")]
        boxes = [box for box in boxes if box]
        assert len(boxes) >= 8
        wide = "button => button.offsetParent && button.scrollWidth - button.clientWidth"
        assert not any(page.locator("#bar button").evaluate_all(f"all => all.map({wide})"))
        for box in boxes:
            assert box["x"] >= 0 and box["x"] + box["width"] <= width
            assert box["y"] + box["height"] <= height
            assert box["width"] >= 28 and box["height"] >= 24
        rows = sorted({round(box["y"]) for box in boxes})
        for y in rows:  # none lies over its neighbour
            row = sorted(box["x"] for box in boxes if round(box["y"]) == y)
            assert all(b - a >= 28 for a, b in zip(row, row[1:]))


def test_a_slow_machine_gets_coarser_images_and_a_fast_one_sharper(viewer):
    opened = viewer(colourful(50))
    found = opened.page.evaluate("""() => {
      const v = Object.assign(gambaViewer, { coarse: 0, quick: 0, some: 1e6 }), seen = [];
      v.about = { ...v.about, count: 1e6 };
      const after = (cost, times) => {
        for (let i = 0; i < times; i++) v.adapt(cost);
        seen.push([v.coarse, v.some]);
      };
      after(30, 50);
      after(60, 1);
      after(60, 20);
      after(10000, 20);
      after(16, 1000);
      after(2000, 1);
      v.about.count = 50;
      return seen;
    }""")
    steady, once, slow, stopped, fast, jammed = found
    assert steady == [0, 1e6] and once == [1, 1e6] and fast == [0, 1e6]
    assert slow[0] == 5 and 40_000 <= slow[1] < 1e6 and stopped == [5, 40_000]
    assert jammed[0] == 5 and jammed[1] == 1e5


def test_a_million_do_not_stop_the_page(browser_page, tmp_path):
    n = 1_000_000
    gaussians = cloud_of(torch.rand(n, 3) - 0.5, 0.001, 0.5, torch.rand(n, 3))
    write_viewer(tmp_path / "million.html", "Many", gaussians, camera=CAMERA)
    opened = browser_page(tmp_path / "million.html", 160, 120)
    opened.until("gambaViewer.ready")
    longest = opened.promised("""new Promise((done) => {
      let last = performance.now(), longest = 0, sorts = gambaViewer.stats.sorts;
      const tick = () => {
        const now = performance.now();
        longest = Math.max(longest, now - last);
        last = now;
        if (gambaViewer.stats.sorts > sorts + 2) return done(longest);
        gambaViewer.act.turn(3, 0);
        setTimeout(tick, 5);
      };
      tick();
    })""")
    # The page's own thread is never held for long, also on a machine that is busy with others.
    assert longest < 400 and not opened.messages
