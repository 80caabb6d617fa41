#!/usr/bin/env bash
# Trains the shipped model further on a GPU machine that has torch but no network and no packages.
# From the root of a checkout:
#
#   docs/lab/gpu_train.sh pack PACK DATA...                 here; PACK gets part.000, part.001, ...
#   docs/lab/gpu_train.sh check PACK                        here: imports from the pack and torch alone
#   docs/lab/gpu_train.sh train PACK MINUTES OUT [OPTION]   there, with the parts in PACK
#
# DATA are datasets of `gamba data render --depth`; the first is the one to train on, the others
# follow --extra. OUT gets weights (float16), log.jsonl and the lines of the run; its run folder is
# PACK/run, with a checkpoint every two minutes: after a kill the same line goes on. OPTIONs go to
# `gamba train` and replace the script's. In the environment: PYTHON (of the machine, 3.12),
# PART (MiB of a part, 30), VIEWS and DEPTHS (kept of each object, 10 and 3), OBJECTS (of
# each dataset at most), BATCH (objects a step, 64), ARCH (of the GPU, 90).
set -euo pipefail
task=${1:-} pack=${2:-}
[ -n "$pack" ] && [ -f setup.cfg ] || { sed -n '2,16s/^# \{0,1\}//p' "$0" >&2; exit 2; }

make_pack() {
  local made=$pack/made version=${PYTHON:-3.12} python=.venv/bin/python
  rm -rf "$pack" && mkdir -p "$made/site" "$pack/wheels"
  local platforms=() name
  for name in _2_28 _2_27 _2_17 2014 1; do platforms+=(--platform "manylinux${name}_x86_64"); done
  for name in warp-lang msgspec tyro docstring-parser typeguard typing-extensions kornia kornia_rs packaging \
    safetensors pillow tqdm filelock; do
    $python -m pip download -q --no-deps --only-binary=:all: "${platforms[@]}" \
      --python-version "$version" --implementation cp -d "$pack/wheels" \
      "$name==$($python -m pip show "$name" 2>/dev/null | sed -n 's/^Version: //p')"
  done
  for name in "$pack"/wheels/*.whl; do $python -m zipfile -e "$name" "$made/site"; done
  rm -rf "$made"/site/warp/{tests,examples} "$pack/wheels"
  $python - "$made" "$@" <<'END'
import json, os, shutil, sys
from pathlib import Path

import numpy as np
from PIL import Image
from safetensors.torch import load_file, save_file

from gamba_warp.data.dataset import evenly
from gamba_warp.train.data.poses import front_views
from gamba_warp.vision.weights import cache_folder

made = Path(sys.argv[1])
views, depths = (int(os.environ.get(name, n)) for name, n in (("VIEWS", 10), ("DEPTHS", 3)))
lpips = load_file(cache_folder() / "lpips_vgg16.safetensors")
save_file({name: x.half() for name, x in lpips.items()}, made / "lpips.safetensors")
for root in map(Path, sys.argv[2:]):
    split = json.loads((root / "split.json").read_text())
    uids = evenly(split["train"], int(os.environ.get("OBJECTS", 10**9)))
    for uid in uids:
        source, folder = root / uid, made / "data" / root.name / uid
        if not (source / "transforms.json").is_file():
            continue
        folder.mkdir(parents=True)
        about = json.loads((source / "transforms.json").read_text())
        frames = about["frames"]
        fronts = front_views(np.array([f["transform_matrix"] for f in frames]))[: views // 3]
        others = [i for i in range(len(frames)) if i not in fronts]
        about["frames"] = [frames[i] for i in (*fronts, *evenly(others, views - len(fronts)))]
        for number, frame in enumerate(about["frames"]):
            name = f"{number}.webp"
            image = Image.open(source / frame["file_path"])
            image.save(folder / name, quality=80, alpha_quality=90, method=4)
            frame["file_path"] = name
            for key in ("depth_file_path", "back_file_path"):
                if key not in frame:
                    continue
                near = source / frame[key]
                frame[key] = f"{number}{key[0]}.png"
                if number < min(depths, len(fronts)):
                    shutil.copy(near, folder / frame[key])
                else:  # a depth of 0 is unknown
                    empty = np.zeros((about["h"], about["w"]), np.uint16)
                    Image.fromarray(empty).save(folder / frame[key])
        (folder / "transforms.json").write_text(json.dumps(about))
    parts = {"version": split["version"], "train": uids}
    (made / "data" / root.name / "split.json").write_text(json.dumps(parts))
    print(root.name, len(uids), "objects")
END
  printf '%s\n' "${@##*/}" >"$made/data/order"
  compile_kernels "$made/kernels"
  tar -C "$made" --sort=name -czf - . | split -b "${PART:-30}M" -d -a 3 - "$pack/part."
  rm -rf "$made"
  du -h "$pack"/part.* | sed 's/^/  /'
}

# The kernels of a step of BATCH objects, compiled for the GPU: a step on torch's fake tensors tells
# which. Other shapes are compiled there when they occur.
compile_kernels() {
  PYTHONPATH=$PWD:$PWD/tests WARP_CACHE_PATH=$1 .venv/bin/python -W ignore - "${BATCH:-64}" "${ARCH:-90}" <<'END'
import sys

import torch
import warp as wp
from graphs.test_training_step import TERMS, batch_of
from ptx import dry_run

from gamba_warp.model.config import PRESETS
from gamba_warp.model.gamba import Gamba
from gamba_warp.train.step import Objective, forward

batch, architecture = map(int, sys.argv[1:])
weights = TERMS["rays"][0] | {"mask_l1": 0.25}
objective = Objective(weights, lambda got, want: (got - want).abs().mean((-3, -2, -1)), 64)
config, done = PRESETS["rays"], set()
with dry_run.dry_run() as launches:
    with torch.device("cuda"):
        model, inputs = Gamba(config), batch_of(config, batch, 4, 128)
    dry_run.run_backward([forward(model, inputs, objective).loss])
for launch in launches:
    module = launch.kernel.module
    if (module, launch.block) not in done:
        done.add((module, launch.block))
        module.options["block_dim"] = launch.block
        wp.compile_aot_module(module, arch=architecture, use_ptx=False)
print(len(done), "modules of kernels compiled")
END
}

# Import what the training needs from the pack, this checkout, and torch and numpy with what they need.
check() {
  local name folder
  room=$(mktemp -d)
  trap 'rm -rf "$room"' EXIT
  cat "$pack"/part.* | tar -C "$room" -xzf -
  folder=$(.venv/bin/python -c "import torch; print(torch.__path__[0])")
  mkdir "$room/image"
  for name in torch torchgen functorch numpy numpy.libs sympy mpmath networkx jinja2 markupsafe fsspec; do
    ln -s "${folder%/*}/$name" "$room/image"
  done
  PYTHONPATH=$room/site:$PWD:$room/image GAMBA_CACHE=$room .venv/bin/python -S -W ignore - "$room" <<'END'
import sys
from importlib import import_module
from pathlib import Path

for name in ("gamba_warp.cli", "gamba_warp.train.loop", "gamba_warp.train.command"):
    import_module(name)
for name in ("warp", "msgspec", "tyro", "kornia", "safetensors.torch", "PIL.Image", "tqdm", "filelock"):
    where = Path(import_module(name).__file__)
    assert where.is_relative_to(Path(sys.argv[1]) / "site"), f"{name} is from {where}"
print("everything is imported from the pack; torch and numpy are the machine's")
END
}

train() {
  local minutes=$1 out=$2
  shift 2
  room=$(mktemp -d)
  trap 'rm -rf "$room"' EXIT
  mkdir -p "$out"
  cat "$pack"/part.* | tar -C "$room" -xzf -
  export PYTHONPATH=$room/site:$PWD GAMBA_CACHE=$room WARP_CACHE_PATH=$room/kernels PYTHONUNBUFFERED=1
  python3 - "$room" <<'END'
import sys
from safetensors.torch import load_file, save_file

half = load_file(f"{sys.argv[1]}/lpips.safetensors")
save_file({name: x.float() for name, x in half.items()}, f"{sys.argv[1]}/lpips_vgg16.safetensors")
END
  local order=() name
  while read -r name; do order+=("$room/data/$name"); done <"$room/data/order"
  local extra=()
  [ "${#order[@]}" -gt 1 ] && extra=(--extra "${order[@]:1}")
  local code=0 given=" $* " words=()
  default() { [[ $given == *" $1 "* ]] || words+=("$@"); }
  default --preset rays && default --init starter/rays.safetensors && default --minutes "$minutes"
  default --batch-size "${BATCH:-64}" && default --views-per-object 3 && default --schedule trapezoid
  default --decay-fraction 0.5 && default --warmup-steps 30 && default --lr 1e-3 && default --ema 0.999
  default --no-radial-mask && default --depth-weight 0.5 && default --ssim-weight 0.3
  default --novel-weight 3 && default --mask-l1-weight 0.25 && default --translucency-weight 0.06
  default --lpips on && default --lpips-weight 0.3 && default --lpips-crop 64
  default --background random && default --front-fraction 0.5 && default --flip 0.5
  default --color-jitter 0.3 && default --precision bfloat16 && default --cache && default --val-every 0
  default --save-every 100000 && default --save-minutes 2 && default --out "$pack/run"
  python3 -W ignore -m gamba_warp train "${order[0]}" "${extra[@]}" "${words[@]}" "$@" 2>&1 |
    tee "$out/lines.txt" || code=$?
  [ -d "$pack/run/checkpoints" ] || return "$code"
  cp "$pack/run/log.jsonl" "$pack/run/config.json" "$out/"
  python3 - "$pack/run" "$out" <<'END'
import sys
from pathlib import Path
from safetensors import safe_open
from safetensors.torch import save_file

run, out = map(Path, sys.argv[1:])
whole = run / "model.safetensors"
found = [whole] if whole.exists() else sorted(run.glob("checkpoints/*/ema.safetensors"))
with safe_open(found[-1], "pt") as file:
    about, state = file.metadata(), {name: file.get_tensor(name) for name in file.keys()}
save_file({k: x.half() if x.dim() > 1 else x for k, x in state.items()}, out / "model.safetensors", about)
END
  return "$code"
}

case $task in
  pack) make_pack "${@:3}" ;;
  check) check ;;
  train) train "${@:3}" ;;
  *) echo "gpu_train.sh: pack, check or train, not '$task'" >&2; exit 2 ;;
esac
