"""A ``gamba`` whose commands write small reports at once, and plans for it."""

import json
import os
import signal
import sys
import time
from pathlib import Path

OBJECTS = {"apple": 20.0, "bench": 24.0, "chair": 22.0}  # PSNR at learning rate 0 and seed 0, dB


def plan(*rows, **more):
    """A plan of one base; rows are names or dictionaries."""
    rows = [{"name": row} if isinstance(row, str) else row for row in rows]
    base = {"preset": "tiny", "set": {"width": 16}, "options": {"steps": 4}}
    base |= more.pop("base", {})
    return {"name": "trial", "title": "A trial", "seeds": [0], "base": base, "rows": rows, **more}


def write_plan(folder, *rows, **more):
    path = folder / f"{more.get('name', 'trial')}.json"
    path.write_text(json.dumps(plan(*rows, **more)))
    return path


def option(words, name, default=None):
    return words[words.index(name) + 1] if name in words else default


def train(words, out):
    """``--novel-weight`` selects the outcome: 6 waits for a signal, 7 to 9 are failures."""
    kind = option(words, "--novel-weight", "").removesuffix(".0")
    lines = [{"event": "start", "step": 0, "parameters": 1234, "device": "cpu"}]
    for step in range(1, 5):
        loss = None if kind == "7" else 1.0 / step
        line = {"event": "train", "step": step, "minutes": step / 60, "loss": loss, "psnr": 10.0}
        lines.append({**line, "seconds": 0.1 * step, "skipped": 0})
    lines.append({"event": "val", "step": 4, "minutes": 4 / 60, "loss": 0.5, "psnr_novel": 15.0})
    (out / "log.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    if kind == "8":
        print("gamba: 20 steps in a row were not finite (step 20); lower --lr")
        return 2
    if kind == "9":
        os.kill(os.getpid(), signal.SIGSEGV)
    if kind == "6" and not (out / "saved").exists():

        def save(number, frame):
            (out / "saved").write_text("x")
            sys.exit(128 + number)

        signal.signal(signal.SIGTERM, save)
        (out / "waits").write_text("x")
        time.sleep(60)
        return 1
    rate, seed = float(option(words, "--lr", 0)), int(option(words, "--seed"))
    (out / "model.safetensors").write_text(json.dumps([rate, seed]))
    return 0


def views(words, out):
    """PSNR is that of ``OBJECTS``, 100 dB more for each unit of the learning rate, 1 by seed."""
    rate, seed = json.loads(Path(option(words, "--checkpoint")).read_text())
    more = {"status": "ok", "views": [0, 1, 2], "ssim": 0.5, "lpips": None, "mask_iou": 0.25}
    more |= {"psnr_black": 17.0}
    objects = [{"name": n, "psnr": p + 100 * rate + seed, **more} for n, p in OBJECTS.items()]
    report = {"protocol": {"size": None}, "objects": objects, "failures": []}
    (out / "report.json").write_text(json.dumps(report))
    return 0


def main(words):
    with open(os.environ["FAKE_CALLS"], "a") as file:
        file.write(" ".join(words) + "\n")
    out = Path(option(words, "--out"))
    out.mkdir(parents=True, exist_ok=True)
    return {"train": train, "eval-views": views}[words[0]](words, out)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
