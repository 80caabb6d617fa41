"""A training loop of your own in place of ``gamba train`` (docs/train-your-own.md).

python docs/examples/own_loop.py starter/data --steps 200 --out runs/own
"""

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from gamba_warp import Gamba, load_model
from gamba_warp.data.dataset import open_dataset
from gamba_warp.model.checkpoint import save_model
from gamba_warp.model.config import PRESETS
from gamba_warp.train.batches import FixedObjects, fixed_batches
from gamba_warp.train.data.samples import choose_views, join, load_sample
from gamba_warp.train.step import Objective, compute_gradients
from gamba_warp.train.validation import validate

parser = argparse.ArgumentParser()
parser.add_argument("data", nargs="+", type=Path)
parser.add_argument("--weights", nargs="+", type=float, help="sampling weight of each DATA")
parser.add_argument("--init", type=Path, help="model whose tensors of equal shape are loaded")
parser.add_argument("--steps", type=int, default=200)
parser.add_argument("--out", type=Path, default=Path("runs/own"))
options = parser.parse_args()
device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
sets = [open_dataset(folder, "train") for folder in options.data]
fractions = np.array(options.weights or [len(each) for each in sets], float)
held_out = FixedObjects(open_dataset(options.data[0], "val"), [0])  # its first object
config = replace(PRESETS["tiny"], image_size=64, depth=2)
model, rng, best = Gamba(config).to(device).train(), np.random.default_rng(0), -np.inf
if options.init:
    ours, theirs = model.state_dict(), load_model(options.init).state_dict()
    same = {name: v for name, v in theirs.items() if name in ours and ours[name].shape == v.shape}
    model.load_state_dict(same, strict=False)
heads = [*model.decoder.parameters()]  # learn twice as fast
rest = [p for name, p in model.named_parameters() if not name.startswith("decoder")]
optimizer = torch.optim.RAdam([{"params": heads, "lr": 2e-3}, {"params": rest}], lr=1e-3)
options.out.mkdir(parents=True, exist_ok=True)
objective = Objective({"rgb": 1.0, "mask": 1.0, "ssim": 0.2})  # the weights of losses.TERMS
for step in range(1, options.steps + 1):
    samples = []
    for number in rng.choice(len(sets), 4, p=fractions / fractions.sum()):
        index = int(rng.integers(len(dataset := sets[number])))
        views = choose_views(dataset.num_views(index), 3, None, rng)
        samples.append(load_sample(dataset, index, views, config.image_size, config, torch.ones(3)))
    grads = compute_gradients(model, optimizer, [join(samples, config).to(device)], objective)
    optimizer.step()
    if step % 100 == 0 or step == options.steps:
        batches = fixed_batches(held_out, config, config.image_size, {})
        figures, _ = validate(model, batches, objective, device)
        print(step, grads.loss.item(), figures["psnr_novel"], figures["ssim_novel"])
        if (score := figures["ssim_novel"]) > best:  # the best by another figure than PSNR
            best = score
            save_model(options.out / "model.safetensors", model)
