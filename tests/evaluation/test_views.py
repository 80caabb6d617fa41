import math
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from helpers.micro import write_split
from helpers.model import SMALLEST
from helpers.refusals import refused
from helpers.views import around, cloud_of, evaluated, straight, write_views

from gamba_warp.cameras import Cameras, relative_to_reference
from gamba_warp.eval.views import evaluate as module
from gamba_warp.eval.views.compare import Shown, choose_views
from gamba_warp.eval.views.options import ViewsOptions
from gamba_warp.formats.ply import save_ply

SIZE = 48
DISTANCE = 2.25  # of the dataset's cameras: not the model's 1.5
COLOR = torch.tensor([0.2, 0.6, 1.0])


def cameras():
    """An orbit in a z-up world."""
    turn = torch.tensor([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
    ring = around(torch.arange(4) * 77.0 + 20, 25.0, DISTANCE, SIZE, 40.0)
    return Cameras(ring.viewmats @ turn, ring.Ks, SIZE, SIZE)


def paint(gaussians, views):
    """Stands in for the rasterizer: a 9x9 square where the first mean is seen."""
    rgb = torch.ones(len(views.viewmats), views.height, views.width, 3)
    mask = torch.zeros(rgb.shape[:3], dtype=torch.bool)
    for v, (viewmat, K) in enumerate(zip(views.viewmats, views.Ks)):
        seen = K @ (viewmat[:3, :3] @ gaussians.means[0] + viewmat[:3, 3])
        x, y = (seen[:2] / seen[2]).floor().long().tolist()
        rgb[v, max(0, y - 4) : y + 5, max(0, x - 4) : x + 5] = gaussians.colors[0]
        mask[v, max(0, y - 4) : y + 5, max(0, x - 4) : x + 5] = True
    return Shown(rgb, mask.float())


def one(point):
    return cloud_of([point], 0.08, 0.95, COLOR)


def write_object(folder, point, drawer=paint):
    drawn = drawer(one(point), cameras())
    rgba = drawn if torch.is_tensor(drawn) else torch.cat([drawn.rgb, drawn.alpha[..., None]], -1)
    write_views(folder, rgba, cameras())


def in_reference_world(point, reference=0):
    viewmats = cameras().viewmats
    _, scale = relative_to_reference(viewmats, viewmats[reference])
    return (scale * viewmats[reference, :3, :3] @ torch.tensor(point)).tolist()


POINTS = {"a": [0.1, 0.05, -0.1], "group/b": [-0.15, 0.1, 0.2], "c": [0.0, 0.2, 0.1]}


pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture
def data(tmp_path):
    for uid, point in POINTS.items():
        write_object(tmp_path / "data" / uid, point)
        path = tmp_path / "pred" / f"{uid}.ply"
        path.parent.mkdir(parents=True, exist_ok=True)
        save_ply(path, one(in_reference_world(point)))
    return tmp_path


@pytest.fixture
def painted(monkeypatch):
    monkeypatch.setattr(module, "render_views", paint)


def evaluate(folder, *options, pred="pred", lpips="off"):
    split = [] if "--split" in options else ["--split", "all"]
    words = ["--checkpoint", folder / pred, "--data", folder / "data", "--device", "cpu"]
    words += ["--lpips", lpips]
    return evaluated("eval-views", folder / "out", *words, *split, *options)


def test_perfect_predictions(data, painted):
    """The dataset's own world, distance and reference view are undone exactly."""
    for reference in (0, 2):
        for uid, point in POINTS.items():
            save_ply(data / "pred" / f"{uid}.ply", one(in_reference_world(point, reference)))
        options = ["--no-baselines", "--reference", str(reference)]
        code, report = evaluate(data, *options)
        assert code == 0
        # 8-bit rounding of the files only
        assert report["mean"]["psnr"] > 55 and report["mean"]["mask_iou"] == 1
        assert report["mean"]["input"]["psnr"] > 55
        others = [v for v in range(4) if v != reference]
        assert report["objects"][0]["views"] == [reference, *others]
    assert [item["name"] for item in report["objects"]] == sorted(POINTS)
    assert report["mean"]["lpips"] is None
    assert report["protocol"]["lpips_reason"] == "not asked for"
    source = report["protocol"]["source"]
    assert (source["kind"], source["path"], len(source["sha256"])) == ("ply", "pred", 64)


def test_a_wrong_distance_shows(data, painted):
    _, report = evaluate(data, "--distance", "2.5")
    assert report["mean"]["mask_iou"] < 0.99


def test_baselines_have_known_values(data, painted):
    _, report = evaluate(data)
    empty, copy = report["baselines"]["background"], report["baselines"]["input_copy"]
    rounded = (COLOR * 255 + 0.5).floor() / 255
    mse = 81 / SIZE**2 * float((1 - rounded).square().mean())
    assert empty["psnr"] == pytest.approx(-10 * math.log10(mse), abs=1e-4)
    assert empty["mask_iou"] == 0
    assert copy["input"]["psnr"] == 100 and copy["input"]["mask_iou"] == 1
    assert copy["psnr"] < 30  # a mean with the input in it would be over 35
    options = ["--no-baselines", "--limit", "1"]
    assert evaluate(data, *options)[1]["baselines"] == {}


def test_failures_are_listed(data, painted, monkeypatch):
    (data / "pred" / "a.ply").unlink()
    (data / "data" / "group" / "b" / "002.png").write_bytes(b"")

    def nan_where_c(gaussians, views):
        rgb, alpha = paint(gaussians, views)
        return Shown(torch.full_like(rgb, torch.nan), alpha)

    monkeypatch.setattr(module, "render_views", nan_where_c)
    code, report = evaluate(data)
    assert code == 1
    reasons = {item["name"]: item["reason"] for item in report["failures"]}
    assert "No such file" in reasons["a"] and "2.png" in reasons["group/b"]
    assert "psnr is nan" in reasons["c"]
    assert report["mean"] == {} and report["num_ok"] == 0


def test_strips_and_views(data, painted):
    from PIL import Image

    _, report = evaluate(data, "--views", "3", "--size", "24", "--strips", "1")
    assert report["objects"][0]["views"] == [0, 1, 2]
    files = sorted((data / "out" / "strips").rglob("*.png"))
    assert [path.name for path in files] == ["a.png"]
    with Image.open(files[0]) as strip:
        assert strip.size == (3 * 24, 3 * 24)
    assert len((data / "out" / "objects.csv").read_text().splitlines()) == 4


def test_choose_views():
    assert choose_views(5, 2, None) == [2, 0, 1, 3, 4]
    assert choose_views(9, 0, 5) == [0, 1, 3, 5, 7]
    assert choose_views(3, 0, 1) == [0] and choose_views(3, 1, 9) == [1, 0, 2]
    refused("the input view 3", choose_views, 3, 3, None)


def test_lpips_without_weights(data, painted, monkeypatch):
    monkeypatch.setenv("GAMBA_CACHE", str(data / "cache"))
    code, report = evaluate(data, "--limit", "1", lpips="auto")
    assert code == 0 and report["mean"]["lpips"] is None
    assert "gamba weights lpips" in report["protocol"]["lpips_reason"]


def test_lpips_with_weights(data, painted):
    from gamba_warp.vision.weights import lpips_available

    if not lpips_available():
        pytest.skip("the LPIPS weights are not in the cache (gamba weights lpips)")
    _, report = evaluate(data, "--limit", "1", "--views", "2", lpips="auto")
    assert report["protocol"]["lpips"] == "VGG16, version 0.1"
    # a prediction that differs by rounding, against an empty image
    for key in ("lpips", "lpips_black", "lpips_grey"):
        assert report["mean"][key] < 1e-3 < report["baselines"]["background"][key]


@pytest.mark.parametrize(
    "case, options, said",
    [
        ("absent", [], "absent"),
        ("data", [], "no such folder"),
        ("empty", [], "neither"),
        ("split", ["--split", "test"], "test split"),
    ],
)
def test_what_cannot_start(data, case, options, said, capsys):
    if case == "data":
        (data / "data").rename(data / "moved")
    if case == "empty":
        (data / "empty").mkdir()
    if case == "split":
        write_split(data / "data", train=["a", "c", "group/b"])
    pred = case if case in ("absent", "empty") else "pred"
    assert evaluate(data, *options, pred=pred) == (2, None)
    error = capsys.readouterr().err
    assert error.startswith("gamba: ") and said in error


def test_module_entry():
    call = [sys.executable, "-m", "gamba_warp.eval"]
    wrong = subprocess.run([*call, "nothing"], capture_output=True, text=True)
    assert wrong.returncode == 2 and "views,geometry" in wrong.stderr
    helped = subprocess.run([*call, "views", "--help"], capture_output=True, text=True)
    assert helped.returncode == 0 and "--reference" in helped.stdout


def test_gaussians_rendered_and_rendered_again(tmp_path):
    write_object(tmp_path / "data" / "a", POINTS["a"], drawer=straight)
    (tmp_path / "pred").mkdir()
    viewmats = cameras().viewmats
    _, scale = relative_to_reference(viewmats, viewmats[0])
    moved = one(POINTS["a"]).transformed(viewmats[0, :3, :3], torch.zeros(3), float(scale))
    save_ply(tmp_path / "pred" / "a.ply", moved)
    code, report = evaluate(tmp_path)
    assert code == 0
    # 8-bit colour and alpha in the files; the mask's edge may fall on either side
    assert report["mean"]["psnr"] > 48 and report["mean"]["mask_iou"] > 0.95
    assert report["baselines"]["input_copy"]["psnr"] < 40


def test_checkpoint(data, capsys):
    from gamba_warp.model.checkpoint import save_model
    from gamba_warp.model.gamba import Gamba

    (data / "model").mkdir()
    save_model(data / "model" / "model.safetensors", Gamba(SMALLEST))
    code, report = evaluate(data, "--limit", "1", "--views", "2", pred="model")
    assert code == 0
    assert report["protocol"]["source"]["kind"] == "checkpoint"
    assert report["objects"][0]["gaussians"] == SMALLEST.num_gaussians
    few = [*"--limit 1 --views 2 --background-margin 0".split()]
    code, report = evaluate(data, *few, pred="model")
    assert code == 0 and 0 < report["objects"][0]["gaussians"] < SMALLEST.num_gaussians
    assert report["protocol"]["source"]["background_margin"] == "0"
    assert evaluate(data, *few)[0] == 2  # Gaussians that are there already
    assert "--background-margin: " in capsys.readouterr().err


def test_saved_gaussians_evaluate_to_the_same(data, painted):
    code, report = evaluate(data, "--save-gaussians")
    assert code == 0
    (data / "out" / "report.json").unlink()
    code, again = evaluate(data, pred="out/gaussians")
    assert code == 0 and len(list((data / "out" / "gaussians").rglob("*.ply"))) == len(POINTS)
    assert again["mean"]["psnr"] == report["mean"]["psnr"] > 30


def test_a_protocol_fills_in_what_is_not_given_and_names_what_is():
    """Also where the given is the default without a protocol."""

    def filled(**given):
        return ViewsOptions(checkpoint=Path("a"), data=Path("b"), **given).filled()

    default, splatter = filled(), filled(protocol="splatter-image")
    assert (default.reference, default.size, default.changed()) == (0, None, [])
    assert (splatter.reference, splatter.size, splatter.changed()) == (64, 128, [])
    changed = filled(protocol="splatter-image", reference=0, size=64)
    assert (changed.reference, changed.size) == (0, 64)
    assert changed.changed() == ["size", "reference"]
