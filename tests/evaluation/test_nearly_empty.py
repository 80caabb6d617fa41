"""Nearly empty views: counted in the means, and left out of a second set of means."""

import math

import pytest
import torch
from helpers.views import around, cloud_of, eval_views, write_views

from gamba_warp.eval.averages import bootstrap, median_of, minus, summary_of
from gamba_warp.eval.views.compare import NEARLY_EMPTY, GroundTruth, summary
from gamba_warp.eval.views.evaluate import count_nearly_empty
from gamba_warp.eval.views.table import differences_of, means, page, table_of, without_nearly_empty
from gamba_warp.formats.ply import save_ply
from gamba_warp.image_metrics import on_grounds

SIZE = 40  # 16 of its pixels are exactly 1 %


def values(psnr, ssim=0.5):
    measured = {"psnr": psnr, "ssim": ssim, "mask_iou": 0.5, "mse": 10 ** (-psnr / 10)}
    return {"lpips": None, **dict.fromkeys(on_grounds()), **measured}


def test_means_with_and_without():
    views = [values(30.0), values(20.0), values(50.0), values(22.0)]
    got = summary(views, [0.3, 0.2, NEARLY_EMPTY / 2, NEARLY_EMPTY])
    assert got["psnr"] == pytest.approx(92 / 3) and got["input"]["psnr"] == 30
    rest = got["without_nearly_empty"]
    assert rest["psnr"] == 21 and rest["input"] == got["input"]
    assert rest["lpips"] is None and got["mse"] == pytest.approx((1e-2 + 1e-5 + 10**-2.2) / 3)
    blank = summary(views, [0.0] * 4)["without_nearly_empty"]
    assert set(blank.pop("input").values()) == {None} == set(blank.values())
    alone = summary(views[:1], [0.5])
    assert alone["psnr"] is None and alone["input"]["psnr"] == 30


def test_coverage_is_the_mean_of_alpha():
    images = torch.zeros(2, SIZE, SIZE, 4)
    images[0, :4, :4, 3] = 1.0
    images[1, :20, :20, 3] = 0.5  # glass, in no mask
    assert GroundTruth("a", images, around([0, 0], size=SIZE), [0, 1]).coverage == [0.01, 0.125]


def records(*pairs):
    made = {}
    for name, views, coverage in pairs:
        made[name] = summary(views, coverage) | {
            "num_nearly_empty": sum(fraction < NEARLY_EMPTY for fraction in coverage),
            "views": list(range(len(views))),
        }
    return made


def test_tables():
    """PSNR of the mean error is that of the mean of errors, and its difference is paired."""
    full, thin = [0.3, 0.3], [0.3, 0.001]
    model = records(("a", [values(30.0), values(20.0)], full), ("b", [values(30.0)] * 2, thin))
    other = records(("a", [values(30.0), values(10.0)], full), ("b", [values(30.0)] * 2, thin))
    rows = table_of({"model": model, "other": other})
    assert [row["psnr"]["mean"] for row in rows] == [25, 20, 30, 30]
    error = rows[0]["psnr_of_mean_error"]
    assert error["value"] == pytest.approx(-10 * math.log10((1e-2 + 1e-3) / 2))
    assert error["interval"] == pytest.approx([20, 30])
    novel, _ = differences_of(model, {"other": other})
    gain = novel["psnr_of_mean_error"]
    assert gain["value"] == pytest.approx(10 * math.log10((0.1 + 1e-3) / (1e-2 + 1e-3)))
    assert gain["interval"] == pytest.approx([0, 10])  # all draws are b, or all are a
    rest = without_nearly_empty({"model": model, "other": other})
    assert [row["objects"] for row in table_of(rest)] == [1, 1, 2, 2]
    assert table_of(rest)[0]["psnr"]["mean"] == 20
    counts = count_nearly_empty(list(model.values()))
    assert counts == {"views": 1, "of_views": 4, "objects": 1, "of_objects": 2}
    report = {
        "table": rows,
        "differences": [novel],
        "nearly_empty": counts,
        "without_nearly_empty": {"table": table_of(rest), "differences": []},
        "protocol": {"lpips_reason": None},
    }
    text = page(report)
    assert "1 of 4 views, of 1 of 2 objects, are nearly empty" in text
    assert text.count("| novel | model | ") == 2 + 1 + 1  # means, medians, and means without
    blank = page(report | {"nearly_empty": counts | {"views": 0}})
    assert "None of the 4 views" in blank and blank.count("| novel | model | ") == 3


def test_objects_are_paired_by_name_and_without_novel_views_left_out():
    def of(*pairs):
        return records(*((uid, [values(p) for p in psnrs], [0.3] * 2) for uid, *psnrs in pairs))

    model = of(("a", 21.0, 20.0), ("b", 25.0, 24.0), ("c", 32.0))
    other = of(("b", 22.0, 21.0), ("a", 20.0, 19.0))
    rows = table_of({"model": model, "other": other})
    counts = {(row["views"], row["name"]): row["objects"] for row in rows}
    order = [(views, name) for views in ("novel", "input") for name in ("model", "other")]
    assert [*counts] == order and [*counts.values()] == [2, 2, 3, 2]
    assert rows[0]["psnr"]["mean"] == 22 and rows[0]["psnr"]["interval"] == [20, 24]
    difference, _ = differences_of(model, {"other": other})
    paired = {"mean": 2.0, "interval": [1.0, 3.0]}  # 1 and 3
    assert difference["psnr"] == paired | {"median": 2.0, "median_interval": [1.0, 3.0]}
    assert set(difference["lpips"].values()) == {None}
    text = means([difference], signed=True).splitlines()
    assert len({len(line) for line in text}) == 1
    assert "+2.00 [1.00, 3.00]" in text[2] and "absent" in text[2]


def test_a_report_has_both(tmp_path, capsys):
    """A speck in one of three views, through the command."""
    cameras = around(torch.arange(3) * 90.0, size=SIZE)
    (tmp_path / "pred").mkdir()
    for uid in ("speck", "whole"):
        rgba = torch.zeros(3, SIZE, SIZE, 4)
        rgba[:, :12, :12, 3] = 1.0
        if uid == "speck":
            rgba[1, 3:, :, 3] = rgba[1, :, 3:, 3] = 0.0
        write_views(tmp_path / "data" / uid, rgba, cameras)
        ball = cloud_of(torch.zeros(1, 3), 0.05, 0.9, torch.zeros(3))
        save_ply(tmp_path / "pred" / f"{uid}.ply", ball)
    folders = [tmp_path / name for name in ("pred", "data", "out")]
    code, report = eval_views(*folders, "--split", "all", "--sheet", 0)
    assert code == 0
    assert report["nearly_empty"] == {"views": 1, "of_views": 6, "objects": 1, "of_objects": 2}
    assert report["protocol"]["nearly_empty"] == 0.01
    speck, whole = report["objects"]
    assert speck["num_nearly_empty"] == 1 and speck["coverage"][1] == 9 / SIZE**2
    assert "num_nearly_empty" not in report["mean"]
    assert speck["psnr"] > speck["without_nearly_empty"]["psnr"] + 2  # the speck's view is easy
    assert whole["psnr"] == whole["without_nearly_empty"]["psnr"]
    names = {row["name"] for row in report["without_nearly_empty"]["table"]}
    assert names >= {"model", "background", "input_copy", "billboard"}
    for row in report["differences"] + report["without_nearly_empty"]["differences"]:
        for key in ("psnr", "ssim", "mask_iou"):
            assert len(row[key]["interval"]) == len(row[key]["median_interval"]) == 2
    assert "Means as above, without the views that are nearly empty:" in capsys.readouterr().out


def test_statistics():
    assert median_of([{"x": 1.0, "t": "a"}, {"x": 5.0}, {"x": 2.0}]) == {"x": 2.0}
    got = summary_of([1.0, None, 3.0])
    assert got == {"mean": 2, "interval": [1, 3], "median": 2, "median_interval": [1, 3]}
    assert set(summary_of([None]).values()) == {None}
    pairs = torch.tensor([[1.0, 2.0, 3.0, 4.0], [0.0, 1.0, 2.0, 3.0]]).numpy()
    # both rows are drawn together: their difference does not depend on the draw
    assert bootstrap(pairs, lambda drawn: (drawn[0] - drawn[1]).mean(-1)) == [1, 1]
    a = {"x": 3.0, "nest": {"y": None, "z": 1}, "kind": "mesh", "closed": True}
    b = {"x": 1.0, "nest": {"y": 2.0, "z": 4}, "kind": "mesh", "closed": False}
    assert minus(a, b) == {"x": 2.0, "nest": {"y": None, "z": -3}}
