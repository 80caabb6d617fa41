#!/usr/bin/env bash
# Trains the shipped model further on a GPU machine that has torch but no network and no packages.
# From the root of a checkout:
#
#   docs/lab/gpu_train.sh pack PACK DATA...                 here; PACK gets part.000, part.001, ...
#   docs/lab/gpu_train.sh train PACK MINUTES OUT [OPTION]   there, with the parts in PACK
#
# DATA are datasets of `gamba data render --depth`; the first is the one to train on, the others
# follow --extra. OUT gets weights (float16), log.jsonl and the lines of the run. OPTIONs go to
# `gamba train`; the last of each name counts. In the environment: PYTHON (of the machine, 3.12),
# PART (MiB of a part, 30), VIEWS and DEPTHS (kept of each object, 10 and 3), OBJECTS (of each
# dataset at most), BATCH (objects a step, 64).
set -euo pipefail
task=${1:-} pack=${2:-}
[ -n "$pack" ] && [ -f setup.cfg ] || { sed -n '2,13s/^# \{0,1\}//p' "$0" >&2; exit 2; }

make_pack() {
  local made=$pack/made version=${PYTHON:-3.12} python=.venv/bin/python
  rm -rf "$pack" && mkdir -p "$made/site" "$pack/wheels"
  local platforms=() name
  for name in _2_28 _2_27 _2_17 2014 1; do platforms+=(--platform "manylinux${name}_x86_64"); done
  for name in warp-lang msgspec tyro docstring-parser typeguard typing-extensions kornia kornia_rs packaging; do
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
            picture = Image.open(source / frame["file_path"])
            picture.save(folder / name, quality=80, alpha_quality=90, method=4)
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
  tar -C "$made" --sort=name -cf - . | xz -1 -T0 | split -b "${PART:-30}M" -d -a 3 - "$pack/part."
  rm -rf "$made"
  du -h "$pack"/part.* | sed 's/^/  /'
}

train() {
  local minutes=$1 out=$2
  shift 2
  room=$(mktemp -d)
  trap 'rm -rf "$room"' EXIT
  mkdir -p "$out"
  cat "$pack"/part.* | xz -d -T0 | tar -C "$room" -xf -
  export PYTHONPATH=$room/site:$PWD GAMBA_CACHE=$room PYTHONUNBUFFERED=1
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
  local code=0
  python3 -W ignore -m gamba_warp train "${order[0]}" "${extra[@]}" --preset rays \
    --init starter/rays.safetensors --minutes "$minutes" --batch-size "${BATCH:-64}" \
    --views-per-object 3 --schedule trapezoid --decay-share 0.5 --warmup-steps 30 --lr 1e-3 --ema 0.999 \
    --no-radial-mask --depth-weight 0.5 --ssim-weight 0.3 --novel-weight 3 --mask-l1-weight 0.25 \
    --translucency-weight 0.06 --lpips on --lpips-weight 0.3 --lpips-crop 64 --background random \
    --front-share 0.5 --mirror 0.5 --recolor 0.3 --precision bfloat16 --cache --val-every 0 \
    --save-every 100000 --out "$room/run" "$@" 2>&1 | tee "$out/lines.txt" || code=$?
  [ -d "$room/run/checkpoints" ] || return "$code"
  cp "$room/run/log.jsonl" "$room/run/config.json" "$out/"
  python3 - "$room/run" "$out" <<'END'
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
  train) train "${@:3}" ;;
  *) echo "gpu_train.sh: pack or train, not '$task'" >&2; exit 2 ;;
esac
