import json
import shutil

import pytest
import torch
from helpers.micro import write_split
from helpers.views import around, cloud_of, eval_views, straight, write_views

from gamba_warp.cameras import Cameras, intrinsics, orbit, relative_to_reference
from gamba_warp.cli import run
from gamba_warp.data.dataset import open_dataset
from gamba_warp.eval.views import baselines
from gamba_warp.eval.views.baselines import Retrieval, billboard
from gamba_warp.eval.views.compare import GroundTruth, ViewsProtocol, load_gt
from gamba_warp.formats.ply import save_ply
from gamba_warp.images import load_rgba

WIDTH, HEIGHT = 45, 33


pytestmark = pytest.mark.usefixtures("one_thread")


def gt_at(azimuths, elevation=0.0, distance=1.5, image=None):
    """Return a ground truth whose input image is ``image``, with further cameras."""
    others = orbit(torch.tensor(azimuths), elevation, distance)
    viewmats = torch.cat([orbit(torch.zeros(1)), others])
    count = len(viewmats)
    image = torch.rand(HEIGHT, WIDTH, 4) if image is None else image
    cameras = Cameras(viewmats, intrinsics(WIDTH, HEIGHT, 40.0).expand(count, 3, 3), WIDTH, HEIGHT)
    images = torch.cat([image[None], torch.rand(count - 1, HEIGHT, WIDTH, 4)])
    return GroundTruth("a", images, cameras, list(range(count)))


def test_billboard_reproduces_the_input():
    """Also with an off-centre axis, and a camera that looks past the object."""
    gt = gt_at([30.0])
    gt.cameras.Ks = gt.cameras.Ks.clone()
    gt.cameras.Ks[:, 0, 2] += 3.3
    gt.cameras.viewmats[0, :2, 3] = torch.tensor([0.1, -0.07])
    rgb, alpha = billboard(gt)
    # float32 poses and images
    assert (rgb[0] - gt.rgb[0]).abs().max() < 2e-5
    assert (alpha[0] - gt.images[0, ..., 3]).abs().max() < 2e-5


def test_billboard_is_what_a_camera_sees_of_the_plane():
    """Each image against single ray-plane intersections, and an analytic image."""
    x = (torch.arange(WIDTH) + 0.5)[None, :].expand(HEIGHT, WIDTH)
    y = (torch.arange(HEIGHT) + 0.5)[:, None].expand(HEIGHT, WIDTH)
    image = torch.stack([x / WIDTH, y / HEIGHT, 0 * x, torch.ones_like(x)], -1)
    # the last camera is so near that some of its rays run away from the plane
    gt = gt_at([50.0, 200.0, 80.0], 20.0, torch.tensor([1.2, 1.2, 0.2]), image)
    rgb, mask = billboard(gt)
    focal, checked, away = gt.cameras.Ks[0, 0, 0].item(), 0, 0
    for view in (1, 2, 3):
        pose = torch.linalg.inv(gt.cameras.viewmats[view].double())
        for row, column in ((16, 22), (12, 18), (20, 25), (9, 27), (2, 1), (16, 3), (16, 41)):
            ray = torch.tensor([column + 0.5 - WIDTH / 2, row + 0.5 - HEIGHT / 2, focal])
            ray = pose[:3, :3] @ ray.double()
            depth = -pose[2, 3] / ray[2]
            point = pose[:3, 3] + depth * ray
            u = focal * point[0] / 1.5 + WIDTH / 2
            v = focal * point[1] / 1.5 + HEIGHT / 2
            if depth < 0:
                away += 1
                assert not mask[view, row, column]
            elif 1 < u < WIDTH - 1 and 1 < v < HEIGHT - 1:
                got, checked = rgb[view, row, column], checked + 1
                assert abs(got[0] * WIDTH - u) < 1e-3 and abs(got[1] * HEIGHT - v) < 1e-3
                assert mask[view, row, column]
            elif not (-1 < u < WIDTH + 1 and -1 < v < HEIGHT + 1):
                assert not mask[view, row, column] and (rgb[view, row, column] == 1).all()
    assert checked >= 9 and away >= 1


def test_billboard_from_behind_is_mirrored_and_edge_on_gone():
    rgb, alpha = billboard(gt := gt_at([180.0, 90.0]))
    assert (rgb[1] - gt.rgb[0].flip(1)).abs().max() < 1e-4
    assert (alpha[1] - gt.images[0, ..., 3].flip(1)).abs().max() < 1e-4
    assert not alpha[2].any() and (rgb[2] == 1).all()


SIZE = 32


def blob(seed, squash=1.0):
    generator = torch.Generator().manual_seed(seed)
    means = 0.25 * (2 * torch.rand(40, 3, generator=generator) - 1)
    hue = torch.rand(3, generator=generator)
    return cloud_of(means * torch.tensor([1.0, squash, 1.0]), 0.05, 0.95, hue)


def write_object(folder, gaussians, turn=0.0):
    cameras = around(torch.arange(6) * 60.0 + turn, 15.0, 1.8, SIZE, 45.0)
    write_views(folder, straight(gaussians, cameras), cameras)
    _, scale = relative_to_reference(cameras.viewmats, cameras.viewmats[0])
    moved = gaussians.transformed(cameras.viewmats[0, :3, :3], torch.zeros(3), scale.item())
    moved.colors = 0.8 * moved.colors  # so that the prediction is good, not perfect
    path = folder.parent.parent / "pred" / f"{folder.name}.ply"
    path.parent.mkdir(exist_ok=True)
    save_ply(path, moved)


PROTOCOL = ViewsProtocol("test", 0, None, None, None, "not asked for", 1.5)


@pytest.fixture
def data(tmp_path):
    """``twin`` is ``seen`` itself, its files beginning 120 degrees on."""
    root = tmp_path / "data"
    write_object(root / "seen", blob(0), 120.0)
    write_object(root / "twin", blob(0))
    write_object(root / "flat", blob(1, 0.3))
    write_object(root / "other", blob(2))
    write_split(root, train=["flat", "other", "seen"], test=["twin"])
    return root


def test_retrieval_finds_the_twin_and_its_views(data):
    """The twin's view 0 is view 4 of ``seen``; the other views follow by camera."""
    retrieval = Retrieval(open_dataset(data, "train"))
    gt = load_gt(open_dataset(data, "test"), "twin", PROTOCOL, "cpu")
    uid, view, distance = retrieval.nearest(gt.images[0], "twin")
    # the thumbnails are kept in 8 bits
    assert (uid, view) == ("seen", 4) and distance < 0.01
    shown = retrieval(gt)
    assert (shown.rgb - gt.rgb).abs().max() < 0.02 and (shown.mask() == gt.mask).all()


def test_retrieval_takes_the_objects_of_other_datasets(data, tmp_path):
    bare = tmp_path / "bare"
    shutil.copytree(data / "twin", bare / "twin")
    write_split(bare, train=[], test=["twin"])
    options = ["--strips", 0, "--sheet", 0]
    _, without = eval_views(data.parent / "pred", bare, tmp_path / "a", *options)
    assert "retrieval" in without["left_out_baselines"]
    chosen = ["--retrieval-data", data]
    _, report = eval_views(data.parent / "pred", bare, tmp_path / "b", *options, *chosen)
    (record,) = report["objects"]
    assert (record["retrieval"]["uid"], record["retrieval"]["view"]) == ("seen", 4)
    assert report["protocol"]["retrieval_data"] == ["data"]
    assert "retrieval_data" not in without["protocol"]
    words = ["--checkpoint", data.parent / "pred", "--data", bare, "--retrieval-data", bare]
    assert run("eval-views", [*map(str, words)]) == 2


def test_retrieval_leaves_out_the_object_itself(data):
    dataset = open_dataset(data, "train")
    retrieval = Retrieval(dataset)
    image = dataset.load("seen", [2]).images[0]
    assert retrieval.nearest(image, "twin")[:2] == ("seen", 2)
    assert retrieval.nearest(image, "seen")[0] in ("flat", "other")


def test_retrieval_is_by_both_terms_not_by_shape_alone(data, monkeypatch):
    """Exhaustive comparison, against the search that stops early."""
    monkeypatch.setattr(baselines, "_CHUNK", 1)
    dyed = blob(0)
    dyed.colors = 1 - dyed.colors
    write_object(data / "dyed", dyed, 125.0)  # nearly the twin's shape, not its colour
    write_split(data, train=["dyed", "other", "seen"], val=["flat"], test=["twin"])
    retrieval = Retrieval(open_dataset(data, "train"))
    images = torch.cat([retrieval.training.load(uid).images for uid in retrieval.training.uids])
    found = set()
    for made in load_gt(open_dataset(data, "test"), "twin", PROTOCOL, "cpu").images:
        for query in (made, torch.cat([1 - made[..., :3], made[..., 3:]], -1)):
            uid, _, best = retrieval.nearest(query, "")
            found.add(uid)
            distances = []
            for image in images:
                low = torch.minimum(image[..., 3], query[..., 3])
                high = torch.maximum(image[..., 3], query[..., 3])
                apart = (image[..., :3] - query[..., :3]).abs().mean(-1)
                distances.append(1 - low.sum() / high.sum() + (low * apart).sum() / low.sum())
            assert best == pytest.approx(min(distances).item(), abs=0.01)  # 8-bit thumbnails
    assert found == {"seen", "dyed"}


def evaluate(data, out, *options):
    return eval_views(data.parent / "pred", data, out, "--strips", 0, "--sheet", 1, *options)


def test_a_whole_report(data, tmp_path, capsys):
    code, report = evaluate(data, tmp_path / "out")
    assert code == 0 and report["interrupted"] is False
    names = ["background", "input_copy", "billboard", "retrieval"]
    assert list(report["baselines"]) == list(report["protocol"]["baselines"]) == names
    assert report["baselines"]["retrieval"]["psnr"] > 40 > report["baselines"]["billboard"]["psnr"]
    assert report["protocol"]["uids"] == ["twin"] and report["protocol"]["split_version"] == 1
    shown = (tmp_path / "out" / "table.md").read_text()
    assert shown in capsys.readouterr().out
    # means, on other grounds, and medians beside the PSNR of the mean error; no view nearly empty
    assert shown.count("| novel |") == 3 * (5 + 4) and shown.count("| input |") == 5 + 4
    assert "None of the 6 views is nearly empty" in shown
    header, row = (tmp_path / "out" / "objects.csv").read_text().splitlines()
    assert "baselines.billboard.input.psnr" in header and row.startswith("twin,ok,")
    sheet = load_rgba(tmp_path / "out" / "contact_sheet.png")
    assert sheet.shape[0] > 128 and sheet.shape[1] > 9 * 128


def test_what_cannot_be_had_is_listed(data, tmp_path, capsys):
    """A bad training image: the retrieval goes on. No training split: it is left out."""
    (data / "flat" / "003.png").write_bytes(b"nothing")
    code, report = evaluate(data, tmp_path / "out")
    assert code == 1 and report["num_failed"] == 0
    assert [item["name"] for item in report["failures"]] == ["flat (retrieval)"]
    printed = capsys.readouterr()
    assert "retrieval" in report["baselines"] and "flat (retrieval)" in printed.err
    assert "1 evaluated, 0 failed, 1 of baselines failed;" in printed.out
    write_split(data, val=["flat"], test=["twin", "seen", "other"])
    code, report = evaluate(data, tmp_path / "out", "--limit", "2")
    assert code == 0 and "retrieval" not in report["baselines"]
    assert "train split" in report["left_out_baselines"]["retrieval"]
    assert report["num_ok"] == 2


def test_no_output_folder(data, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    before = sorted(tmp_path.iterdir())
    places = ["--checkpoint", "pred", "--data", "data", "--lpips", "off", "--device", "cpu"]
    capsys.readouterr()
    assert run("eval-views", [*places, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["num_ok"] == 1
    assert sorted(tmp_path.iterdir()) == before
    assert run("eval-views", [*places, "--save-gaussians"]) == 2


def test_single_view_objects_have_no_novel_views(data, tmp_path):
    code, report = evaluate(data, tmp_path / "out", "--views", "1")
    assert code == 0 and report["mean"]["psnr"] is None and report["mean"]["input"]["psnr"] > 15
    assert {row["views"] for row in report["table"]} == {"input"}
    assert (tmp_path / "out" / "contact_sheet.png").exists()


def test_interrupted(data, tmp_path, monkeypatch, capsys):
    from gamba_warp.eval.views import evaluate as views

    original, seen = views.evaluate_object, []

    def second_time(job, uid, *rest):
        seen.append(uid)
        if len(seen) == 2:
            raise KeyboardInterrupt
        return original(job, uid, *rest)

    monkeypatch.setattr(views, "evaluate_object", second_time)
    code, report = evaluate(data, tmp_path / "out", "--split", "all")
    assert code == 130 and report["interrupted"] is True
    assert report["num_ok"] == 1 and len(report["protocol"]["uids"]) == 4
    assert "interrupted" in capsys.readouterr().err
