"""The viewer in frames of other pages, and behind ``gamba view``."""

import webbrowser

import numpy as np
import pytest
import torch
from helpers.gaussians import some

from gamba_warp.cli import main
from gamba_warp.formats.ply import save_ply
from gamba_warp.pages.page import Section, write_page
from gamba_warp.surfaces.extract import Surface
from gamba_warp.surfaces.files import save_mesh
from gamba_warp.trajectories.paths import Viewpoint


def run(arguments) -> int:
    with pytest.raises(SystemExit) as ended:
        main(arguments)
    return ended.value.code


@pytest.fixture
def ball(tmp_path):
    save_ply(tmp_path / "ball.ply", some(30))
    return tmp_path / "ball.ply"


def shown(frame) -> float:
    """The spread of what a frame's canvas shows; 0 is blank."""
    return frame.evaluate("""async () => {
      await gambaViewer.rest();
      gambaViewer.renderer.present();
      const copy = document.createElement("canvas");
      copy.width = copy.height = 16;
      const ink = copy.getContext("2d");
      ink.drawImage(gambaViewer.canvas, 0, 0, 16, 16);
      const values = ink.getImageData(0, 0, 16, 16).data.filter((_, i) => i % 4 < 3);
      return Math.max(...values) - Math.min(...values);
    }""")


def frames(opened, count):
    opened.until(f"document.querySelectorAll('iframe').length === {count}")
    found = opened.page.frames[1:]
    for frame in found:
        frame.wait_for_load_state()
    return found


def test_the_viewer_of_a_reconstruction_starts_by_itself(browser_page, tmp_path):
    vertices = 0.4 * torch.eye(3).numpy()
    mesh = Surface(vertices, np.array([[0, 1, 2]]), None)
    image = np.ones((9, 9, 4), np.float32)
    section = Section("A chair", gaussians=some(40), image=image, mesh=mesh, view=Viewpoint(20.0))
    write_page(tmp_path / "a.html", section.title, [section])
    opened = browser_page(tmp_path / "a.html", 800, 600)
    (frame,) = frames(opened, 1)
    assert shown(frame) > 100
    assert frame.evaluate("gambaViewer.about.input.elevation") == pytest.approx(np.radians(20))
    assert frame.is_visible("[data-mode=mesh]") and not opened.messages
    assert frame.evaluate("document.fullscreenEnabled") and frame.is_visible("#do-full")


def test_view_shows_a_mesh_too(ball, tmp_path, capsys):
    save_mesh(tmp_path / "mesh.glb", Surface(np.eye(3), np.array([[0, 1, 2]])))
    page = tmp_path / "page.html"
    command = ["view", str(ball), "--mesh", str(tmp_path / "mesh.glb"), "--out", str(page)]
    assert run([*command, "--no-open-browser"]) == 0
    assert '"faces": 1' in page.read_text()
    warned = f"warning: {tmp_path / 'mesh.glb'}: a part has no material: grey"
    assert warned in capsys.readouterr().err.splitlines()
    save_mesh(tmp_path / "small.glb", Surface(np.eye(3) / 100, np.array([[0, 1, 2]])))
    assert run([*command[:3], str(tmp_path / "small.glb"), *command[4:], "--no-open-browser"]) == 0
    assert "small.glb: " in (err := capsys.readouterr().err) and "scaled by" in err
    (tmp_path / "bad.glb").write_bytes(b"no mesh")
    page.unlink()
    assert run([*command[:3], str(tmp_path / "bad.glb"), "--out", str(page)]) == 2
    assert run(["view", str(ball), "--out", str(tmp_path / "page.webm")]) == 2
    assert "page.webm: the page is an .html file" in capsys.readouterr().err
    assert not page.exists() and not (tmp_path / "page.webm").exists()


def test_view_shows_a_mesh_alone(browser_page, tmp_path, capsys):
    """As large as Gaussians would be, whatever its axes, and without their buttons."""
    surface = Surface(20 * np.eye(3), np.array([[0, 1, 2]]), np.eye(3, dtype=np.float32))
    page, pixels = tmp_path / "page.html", []
    for name, axes in (("a.glb", "opengl"), ("a.ply", "opencv"), ("a.stl", "opengl")):
        save_mesh(tmp_path / name, surface, axes)
        arguments = ["view", str(tmp_path / name), "--out", str(page), "--no-open-browser"]
        assert run(arguments) == 0
        opened = browser_page(page, 201, 150)
        opened.page.evaluate("gambaViewer.setCamera({azimuth: 0.3, elevation: 0.2, distance: 3})")
        pixels.append(opened.promised("gambaViewer.rest().then(() => gambaViewer.png())"))
        assert opened.page.inner_text("#about") == "1 faces" and not opened.messages
        visible = [opened.page.is_visible(f"[data-mode={x}]") for x in ("gaussians", "mesh")]
        assert visible == [False, True] and opened.page.evaluate("gambaViewer.mode") == "mesh"
    assert pixels[0] == pixels[1] != pixels[2]  # an .stl has no colours
    (tmp_path / "a.xyz").write_text("0 1 2\n")
    assert run(["view", str(tmp_path / "a.xyz"), "--no-open-browser"]) == 2
    assert "a.xyz: contains points; gamba view shows" in capsys.readouterr().err
    assert run(["view", str(tmp_path / "a.glb"), "--mesh", str(tmp_path / "a.stl")]) == 2
    assert "a.glb contains a mesh" in capsys.readouterr().err


def test_view_without_a_browser_says_so_in_one_line(ball, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(webbrowser, "open", lambda address: False)
    assert run(["view", str(ball), "--out", str(tmp_path / "page.html")]) == 0
    out, err = capsys.readouterr()
    assert out.strip() == str(tmp_path / "page.html")
    assert err.count("\n") == 1 and "no browser was found" in err
