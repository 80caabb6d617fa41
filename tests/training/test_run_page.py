"""Page of a run and its curves, from a log in any state."""

import html
import json
import math
import re
import xml.etree.ElementTree as ET

import pytest
from helpers.micro import run
from helpers.refusals import refused

from gamba_warp import cli
from gamba_warp.pages.curves import curves_section
from gamba_warp.pages.run import write_run_page
from gamba_warp.pages.run_log import read_run_log


def write(path, *lines):
    """Write a log of dictionaries or of raw bytes."""
    made = [line if isinstance(line, bytes) else json.dumps(line).encode() for line in lines]
    path.write_bytes(b"\n".join(made) + b"\n")
    return path


def line(event, step, seconds=0.0, **values):
    return {"event": event, "step": step, "time": 1e9 + seconds, **values}


def curves(path):
    return curves_section("Curves", "", read_run_log(path))


def svgs(text):
    """The charts of a page or of a section by title, parsed."""
    text = text if isinstance(text, str) else "".join(text.charts)
    found = re.findall(r"<svg.*?</svg>", text, re.DOTALL)
    return {svg.get("aria-label"): svg for svg in map(ET.fromstring, found)}


def tooltips(svg):
    return [title.text for title in svg.iter("title")]


def test_training_writes_its_page(data, tmp_path, capsys):
    out = tmp_path / "run"
    groups = {"length": {"steps": 4}, "run": {"val_every": 2}, "views": {"views_per_object": 2}}
    assert run(data, out, **groups) == 0
    text = (out / "index.html").read_text()
    assert "Step 4 of 4" in text and "finished" in text
    charts = svgs(text)
    assert {"Loss", "PSNR, dB", "SSIM, held out", "Mask IoU, held out"} <= charts.keys()
    (last,) = [t for t in tooltips(charts["Loss"]) if t.startswith("step 4,")]
    assert re.search(r"\ntraining 0\.\d+\nheld out 0\.\d+$", last)
    for part in ("Last validation", "data:image/webp", "gamba train", "--steps 4", "Held out: 1"):
        assert part in text, part
    assert '"novel_weight"' in html.unescape(text)
    assert not re.search(r"(src|href)=\"(?!data:)", text), "it loads nothing"
    page = tmp_path / "seen.html"
    assert cli.run("view", [str(out), "--out", str(page), "--no-open-browser"]) == 0
    assert page.read_text() == text
    # A finished run that is resumed writes its page again.
    (out / "index.html").unlink()
    assert run(data, out, **groups) == 0
    assert (out / "index.html").exists()


def test_a_page_that_cannot_be_written_stops_nothing_and_is_said_once(data, tmp_path, capsys):
    (tmp_path / "index.html").mkdir()
    assert run(data, tmp_path, length={"steps": 3}, run={"val_every": 1}) == 0
    assert capsys.readouterr().out.count("index.html cannot be written, the run goes on") == 1
    assert [p.name for p in tmp_path.iterdir() if p.name.startswith(".gamba")] == []


def test_a_page_in_the_middle_says_so(tmp_path):
    out = tmp_path / "a <b> run"
    out.mkdir()
    config = {"data": "<script>", "length": {"steps": 900}}
    log = [line("start", 0, config=config, command="gamba train '<i>'")]
    log += [line("train", 10, 60, loss=0.5), line("warning", 10, 61, message="<img> odd")]
    write(out / "log.jsonl", *log)
    text = write_run_page(out).read_text()
    name = "/".join(out.resolve().parts[-2:])  # "Training run run" it was in many a folder
    assert f"<title>Training of {html.escape(name)}</title>" in text
    assert "Step 10 of 900, 1.0 minutes of training: in training, or cut off." in text
    assert "&lt;img&gt; odd" in text and "<img" not in text
    assert "<script>" not in text and "<i>" not in text and "a <b>" not in text


@pytest.mark.parametrize("content", [b"", b"\n\n", b'{"event": "start", "step": 0}', b"\xff\x00{"])
def test_a_log_without_figures_gives_a_sentence(tmp_path, content):
    path = tmp_path / "log.jsonl"
    path.write_bytes(content)
    assert not curves(path).charts
    assert "<p>The log holds no figures yet.</p>" in write_run_page(tmp_path).read_text()


def test_no_log_is_one_line(tmp_path):
    refused(r"log\.jsonl: no such file", read_run_log, tmp_path / "log.jsonl")
    (tmp_path / "log.jsonl").mkdir()
    refused("not a plain file", write_run_page, tmp_path)
    assert not (tmp_path / "index.html").exists()


def test_lines_that_are_no_lines_of_a_log_are_passed_over(tmp_path):
    good = [line("train", step, loss=1.0 / step) for step in (10, 20)]
    bad = [
        b'{"event": "train", "step": 15, "loss": 3',
        b"[" * 100_000,
        b'{"a": "' + b"x" * (3 << 20) + b'"}',
        b"\xff\xfe",
        b"3",
        b'{"event": "train", "step": 16, "loss": NaN}',
        *(line("train", step, loss=5.0) for step in (-1, 2.5, 10**400, True)),
        *(line("train", 17, loss=loss) for loss in ("5", True, None, [1.0], 10**400)),
        {"step": 17, "loss": 5.0},
        line(["train"], 17, loss=5.0),
        line("train", 18, **{"loss_<b>": 5.0}),
        line("warning", 18, message=4),
        line("start", 0, config=[1], command=7, steps="9", held_out=[]),
    ]
    record = read_run_log(write(tmp_path / "log.jsonl", *bad, *good))
    assert set(record.series) == {"train.loss"}
    assert list(record.series["train.loss"].values) == [0.1, 0.05]
    assert "Loss" in svgs(curves(tmp_path / "log.jsonl"))
    assert "<b>" not in write_run_page(tmp_path).read_text()


def test_steps_that_were_made_again_count_once(tmp_path):
    """A run is killed at step 30 and resumed an hour later from its checkpoint at step 10."""
    log = [line("start", 0)]
    log += [line("train", step, 6 * step, loss=step) for step in (10, 20, 30)]
    log += [line("start", 10, 4000)]
    log += [line("train", step, 4000 + 6 * (step - 10), loss=100 + step) for step in (20, 30, 40)]
    log.append(line("end", 40, skipped=3, device_memory=5))
    record = read_run_log(write(tmp_path / "log.jsonl", *log))
    loss = record.series["train.loss"]
    assert list(loss.steps) == [10, 20, 30, 40] and list(loss.values) == [10, 120, 130, 140]
    assert list(loss.minutes) == pytest.approx([1, 2, 3, 4]), "the hour between does not count"
    assert record.losses == {"train": 140} and record.most == {"skipped": 3, "device_memory": 5}


def long_log(path, every=25, total=40_000):
    """Write a log of forty thousand steps at 1.2 seconds each."""
    log = [line("start", 0, config={"length": {"steps": total}})]
    for step in range(every, total + 1, every):
        noise = 1 + 0.3 * math.sin(step * 1.7)
        loss = noise * (0.05 + math.exp(-step / 3000))
        terms = {f"loss_{n}": loss for n in ("rgb", "mask", "ssim", "lpips")}
        figures = {"lr": 1.5e-3 * (1 - step / total), "views_per_second": 20 * noise}
        figures |= {"loss": loss, "psnr": 20 + noise, "grad_norm": noise, **terms}
        log.append(line("train", step, 1.2 * step, **figures))
        if step % 500 == 0:
            views = {f"{m}_{v}": noise for m in ("psnr", "ssim") for v in ("input", "novel")}
            log.append(line("val", step, minutes=0.02 * step, loss=loss, **views))
    return write(path, *log)


def test_a_long_run_stays_small_and_its_values_are_right(tmp_path):
    section = curves(long_log(tmp_path / "log.jsonl"))
    assert len("".join(section.charts)) < 200_000
    charts = svgs(section)
    assert len(charts["Loss"].findall(".//circle")) == 0  # eighty validations, thinned
    assert "logarithmic" in charts["Loss"][0].text
    rows = tooltips(charts["Learning rate"])
    assert len(rows) == 100 and rows[-1] == "step 40,000, 13.33 h\n0"
    near = min(tooltips(charts["Loss"]), key=lambda t: abs(_step(t) - 20_000))
    assert re.search(r"6\.\d+ h", near) and "training 0.05" in near
    labels = [element.text for element in charts["Loss"].iter("text")]
    assert {"steps", "hours", "10,000", "40,000", "5", "10"} <= set(labels)


def _step(text):
    return int(re.match(r"step ([\d,]+)", text)[1].replace(",", ""))


def test_one_point_and_equal_values_are_drawn(tmp_path):
    path = write(tmp_path / "log.jsonl", line("train", 0, loss=0.0, psnr=-5.0))
    charts = svgs(curves(path))
    for name, y in (("Loss", "0"), ("PSNR, dB", "-5")):
        (circle,) = charts[name].iter("circle")
        assert float(circle.get("cx")) >= 0 and y in [t.text for t in charts[name].iter("text")]
