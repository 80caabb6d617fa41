"""The table of scanned objects in the model card is what the reports hold."""

from lab import scanned


def figures_of(psnr):
    return {"psnr": psnr, "ssim": 0.8, "lpips": None, "mask_iou": 0.5}


def row(name, psnr, views="novel"):
    cells = {key: None if v is None else {"mean": v} for key, v in figures_of(psnr).items()}
    return {"views": views, "name": name, **cells}


VIEWS = {
    "protocol": {"source": {"path": "m.safetensors", "sha256": "0123456789abcdef77"}},
    "num_ok": 2,
    "table": [row("model", 20.5), row("retrieval", 99.0), row("billboard", 17.0)]
    + [row("model", 38.0, "input")],
}
SHAPES = {"mean": {"chamfer": 0.04321, "normal_consistency": 0.7, "iou": 0.5}}


def cells(table):
    return [[cell.strip() for cell in line.strip("| ").split("|")] for line in table.splitlines()]


def test_the_means_are_of_new_views_and_the_shapes_stand_with_the_model():
    head, _, *rows = cells(scanned.figures(VIEWS, SHAPES).partition("\n\n")[0])
    assert head[0] == "2 objects" and head[-3:] == ["Chamfer", "normals", "Volume IoU"]
    assert rows == [
        ["**this project**", "20.50", "0.800", "–", "0.500", "0.0432", "0.700", "0.500"],
        ["billboard", "17.00", "0.800", "–", "0.500", "–", "–", "–"],
    ]
    assert scanned.figures(VIEWS, SHAPES).endswith("`m.safetensors`, SHA-256 0123456789abcdef.")
