"""``gamba gpu-check`` on a CPU: its steps, files and messages about missing parts."""

import json
import os
import signal
import subprocess
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path
from typing import get_args

import pytest
import torch
from helpers.kernels import Watch

from gamba_warp.cameras import Cameras
from gamba_warp.gpu_check import STEPS, StepName
from gamba_warp.gpu_check import check as gpu_check
from gamba_warp.gpu_check import checks as gpu_kernels
from gamba_warp.gpu_check.check import begin, in_a_process, main, run_gpu_check, run_step
from gamba_warp.kernels.bench.core.case import Settings
from gamba_warp.kernels.bench.static import dry_run
from gamba_warp.measure import inference as bench_inference
from gamba_warp.model.config import PRESETS
from gamba_warp.model.gamba import Gamba

ROOT = Path(__file__).resolve().parents[2]
GRAPH = "scan and convolution in a CUDA graph"


def settings(device, level):
    return Settings(torch.device(device), level)


@pytest.fixture
def on_paper():
    """Fake tensors on a missing GPU."""
    if not dry_run.can_dry_run():
        pytest.skip(f"torch {torch.__version__} needs a GPU for it")
    with dry_run.dry_run() as launches:
        yield launches


def autocast(monkeypatch):
    """Autocast for a fake GPU; otherwise it disables itself."""
    with monkeypatch.context() as patched:
        patched.setattr(torch.cuda, "is_available", lambda: True)
        patched.setattr(torch.cuda, "is_bf16_supported", lambda *_: True)
        return torch.autocast("cuda", torch.bfloat16)


def test_a_graph_can_hold_the_model(monkeypatch, on_paper):
    """No operator of the forward pass synchronises with the GPU, including our own."""
    config = replace(PRESETS["paper"], depth=2)
    with torch.device("cuda"):
        model = Gamba(config, "random").eval()
        cameras = Cameras(torch.empty(1, 4, 4), torch.empty(1, 3, 3), 512, 512)
        image = torch.empty(1, 512, 512, 3)
    with torch.no_grad(), autocast(monkeypatch), Watch() as watch:
        gaussians = model(image, cameras)
    assert watch.found == [] and "aten::_to_copy" in watch.names  # autocast is on
    assert gaussians.means.device.type == "cuda" and gaussians.num == 16384
    names = [launch.kernel.func.__name__ for launch in on_paper]
    # the states of the prefix, then two blocks, each scan cut into pieces
    assert [names.count(n) for n in ("conv_forward", "scan_forward", "carry")] == [3, 6, 3]


@pytest.mark.parametrize(
    "wait",
    [
        lambda x: x.new_tensor([1.0, 2.0]),
        lambda x: x.sum().item(),
        lambda x: torch.linalg.inv(x),
        lambda x: x.nonzero(),
        lambda x: x.cpu(),
    ],
    ids=["from numbers", "item", "inverse", "nonzero", "to the host"],
)
def test_the_watch_sees_what_waits(on_paper, wait):
    x = torch.empty(3, 3, device="cuda")
    with Watch() as watch:
        try:
            wait(x)
        except torch._subclasses.fake_tensor.DynamicOutputShapeException:
            watch.found.append("no shape without the values")
    assert watch.found


def test_inference_on_cuda_has_the_headline(monkeypatch, on_paper):
    monkeypatch.setattr(bench_inference, "_on", lambda model, settings: model.eval())
    (case,) = bench_inference.full_size(settings("cuda", "quick"))
    with torch.device("cuda"):
        variants = {variant.name: variant for variant in case.build()}
    assert variants[bench_inference.HEADLINE].dtype == "bfloat16"


HIDE = """
from importlib.machinery import PathFinder
find = PathFinder.find_spec
def hide(name, path=None, target=None):
    return None if name.split(".")[0] in {names!r} else find(name, path, target)
PathFinder.find_spec = hide
"""
OTHERS = (
    *("tyro", "tqdm", "timm", "kornia", "safetensors", "PIL", "skimage", "scipy", "trimesh"),
    *("imageio", "imageio_ffmpeg", "pytest", "open3d", "pymeshlab", "tensorboard", "torchvision"),
    *("msgspec", "filelock"),
)


def test_torch_and_warp_are_enough(tmp_path):
    """A real run with all other packages hidden."""
    (tmp_path / "sitecustomize.py").write_text(HIDE.format(names=OTHERS))
    environment = os.environ | {"PYTHONPATH": str(tmp_path), "OMP_NUM_THREADS": "1"}
    out = tmp_path / "out"
    command = "-m gamba_warp.gpu_check --device cpu --quick --steps inference peers-conv".split()
    done = subprocess.run(
        [sys.executable, *command, "--out", out],
        cwd=ROOT,
        env=environment,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr + done.stdout
    document = json.loads((out / "gpu-check.json").read_text())
    assert document["verdict"] == "all that could be run passed" and document["failures"] == []
    assert [(s["name"], s["status"]) for s in document["steps"]] == [
        ("inference", "passed"),
        ("peers-conv", "not done"),
    ]
    records = {record["variant"]: record for record in document["bench"]["records"]}
    assert {r["status"] for r in records.values()} == {"ok"}
    assert 0 < records["eager, bfloat16"]["rel_rms_error"] < 0.03
    assert "given tokens" in records["eager, bfloat16"]["parameters"]["encoder"]
    reasons = {row["what"]: row["reason"] for row in document["not_done"]}
    assert reasons["inference from a CUDA graph"] == reasons["step peers-conv"] == "needs CUDA"
    page = (out / "gpu-check.md").read_text()
    assert "| inference, eager, bfloat16 |" in page and "## Not done" in page
    assert "inference, eager, float32" in done.stdout and "not done: step peers-conv" in done.stdout


@pytest.mark.parametrize(
    "arguments, reason",
    [([], "no CUDA device here"), (["--device", "cpu", "--minutes", "0"], "--minutes is 0")],
)
def test_nothing_to_start_is_one_line_and_code_2(monkeypatch, tmp_path, capsys, arguments, reason):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert main([*arguments, "--out", str(tmp_path / "new")]) == 2
    said = capsys.readouterr().err
    assert said.startswith("gamba: ") and reason in said and said.count("\n") == 1
    assert not (tmp_path / "new").exists()


def part_of(folder, name, until=float("inf")):
    begin("cpu", True, folder).write()
    run_step(folder, name, until)
    return json.loads((folder / "gpu-check.json").read_text())


def test_the_checks_of_the_kernels(tmp_path):
    document = part_of(tmp_path, "checks")
    found = document["checks"]
    assert document["failures"] == [] and len(found) == 10
    assert all(check["status"] == "passed" for check in found)
    needs = {row["what"] for row in document["not_done"] if row["reason"] == "needs CUDA"}
    assert GRAPH in needs and len(needs) == 11


def test_a_wrong_kernel_fails_its_check(monkeypatch, tmp_path):
    call = gpu_kernels.Operator.call
    monkeypatch.setattr(gpu_kernels.Operator, "call", lambda *a, **k: call(*a, **k) * 1.0001)
    names = (
        "scan (2, 139, 37, 3, 1)",
        "convolution (2, 300, 19, 4)",
        "scan: two runs, the same bits",
    )
    found = [check for check in gpu_kernels.checks(quick=True) if check.name in names]
    monkeypatch.setattr(gpu_check, "checks", lambda quick: found)
    document = part_of(tmp_path, "checks")
    states = {c["name"]: c["status"] for c in document["checks"]}
    assert states == dict(zip(names, ("failed", "failed", "passed")))
    assert len(document["failures"]) == 2 and "relative rms error" in document["failures"][0]


def test_the_options_name_the_steps_of_the_plan():
    assert get_args(StepName) == tuple(step.name for step in STEPS)


def test_no_item_begins_when_time_is_up(tmp_path):
    for name in ("checks", "bench"):
        document = part_of(tmp_path, name, until=time.time() - 1)
        rows = [r for r in document["not_done"] if not r["what"].startswith("comparison")]
        assert {row["reason"] for row in rows} - {"needs CUDA"} == {"time was up"}


def test_the_benchmark_step(tmp_path):
    document = part_of(tmp_path, "bench")
    records = document["bench"]["records"]
    assert {record["op"] for record in records} == {"conv"} and document["failures"] == []
    assert all(record["ms_p50"] > 0 for record in records)


@pytest.fixture
def children(monkeypatch):
    """Stand-in of the processes: ``child(name, seconds)`` returns additions and the exit."""

    def switch(child):
        def run(words, seconds):
            folder, name = Path(words[2]), words[3]
            changes, end = child(name, seconds)
            document = json.loads((folder / "gpu-check.json").read_text())
            for key, value in changes.items():
                document[key] += value
            (folder / "gpu-check.json").write_text(json.dumps(document))
            return end

        monkeypatch.setattr(gpu_check, "in_a_process", run)
        monkeypatch.setattr(gpu_check, "machine_facts", lambda settings: {"packages": {}})
        monkeypatch.setattr(torch.cuda, "is_available", lambda: True)

    return switch


def result(failures=()):
    row = {"name": "scan", "status": "passed", "found": "1e-7", "seconds": 1.0}
    not_done = [{"what": "a", "reason": "b"}]
    return {
        "checks": [row],
        "not_done": not_done,
        "failures": list(failures),
    }


LATE, CORE = "its 160 s were up", "its process died of signal 11"


@pytest.mark.parametrize(
    "part, end, status, exit_code, words",
    [
        (result(), "", "passed", 0, ""),
        (result(["scan: wrong"]), "", "failed", 1, "scan: wrong"),
        (result(), CORE, "failed", 1, "step checks: its process died of signal 11"),
        (result(), LATE, "stopped", 0, "the rest of step checks: its 160 s were up"),
        (result(["scan: wrong"]), LATE, "failed", 1, "scan: wrong"),
    ],
)
def test_what_a_step_left_is_kept(children, tmp_path, part, end, status, exit_code, words):
    children(lambda name, seconds: (part, end))
    run = run_gpu_check(device="cpu", out=tmp_path, steps=("checks",))
    document = json.loads((tmp_path / "gpu-check.json").read_text())
    assert run == exit_code and document["steps"][0]["status"] == status
    assert document["checks"] == part["checks"]
    assert {"what": "a", "reason": "b"} in document["not_done"]
    page = (tmp_path / "gpu-check.md").read_text()
    assert words in page and "1 passed" in page
    assert document["verdict"] == ("1 failed" if exit_code else "all that could be run passed")


def test_an_interrupt_keeps_what_was_done(children, tmp_path):
    def child(name, seconds):
        if name == "inference":
            raise KeyboardInterrupt
        return result(), ""

    children(child)
    assert run_gpu_check(device="cpu", out=tmp_path) == 130
    document = json.loads((tmp_path / "gpu-check.json").read_text())
    assert document["verdict"].startswith("interrupted")
    assert document["checks"] and document["bench"]["records"] == []


def test_the_whole_run_ends_in_its_time(monkeypatch, children, tmp_path):
    """Steps that use their whole time leave none for the last ones, which are reported."""
    now, given = [0.0], []

    def child(name, seconds):
        now[0] += seconds
        given.append(seconds)
        return {}, f"its {seconds:.0f} s were up"

    children(child)
    monkeypatch.setattr(gpu_check.time, "time", lambda: now[0])
    monkeypatch.setattr(gpu_check, "versions", lambda: dict.fromkeys(gpu_check.PACKAGES, "1"))
    assert run_gpu_check(out=tmp_path) == 0
    assert given[:3] == [step.seconds for step in gpu_check.STEPS[:3]] and len(given) == 4
    assert 8 * 60 - 5 < now[0] < 8 * 60
    document = json.loads((tmp_path / "gpu-check.json").read_text())
    assert [step["status"] for step in document["steps"]] == 4 * ["stopped"] + 2 * ["not done"]
    assert {step["reason"] for step in document["steps"][4:]} == {"time was up"}
    now[0], given[:] = 0.0, []
    assert run_gpu_check(out=tmp_path, minutes=0.2) == 0
    assert sum(given) == now[0] <= 12


def test_peers_have_steps_of_their_own(monkeypatch, children, tmp_path):
    """A crash there affects nothing else, and missing packages are skipped."""
    runs = []

    def child(name, seconds):
        runs.append(name)
        return {}, CORE if name == "peers-scan" else ""

    children(child)
    found = {"causal-conv1d": "1", "mamba-ssm": "2"}
    monkeypatch.setattr(gpu_check, "versions", lambda: found)
    steps = "bench", "peers-conv", "peers-scan", "peers-raster"
    assert run_gpu_check(out=tmp_path, steps=steps) == 1
    assert runs == ["bench", "peers-conv", "peers-scan"]
    document = json.loads((tmp_path / "gpu-check.json").read_text())
    assert [step["status"] for step in document["steps"]] == [
        *("passed", "passed", "failed", "not done")
    ]
    assert "not installed: gsplat, gswarp" in (tmp_path / "gpu-check.md").read_text()


def test_a_later_measurement_replaces_an_earlier_one():
    before = document_of(("conv", "operator", "default", 1.0))
    new = (("conv", "operator", "default", 2.0), ("conv", "operator", "theirs", 3.0))
    found = gpu_check.joined(before, document_of(*new))
    times = [(r["variant"], r["ms_p50"]) for r in found["records"]]
    assert times == [("default", 2.0), ("theirs", 3.0)]
    assert gpu_check.joined(found, document_of()) == found


def document_of(*records):
    """A benchmark's document with records of an op, a case, a variant and a time."""
    return {"records": [dict(zip(("op", "case", "variant", "ms_p50"), r)) for r in records]}


ANOTHER = """
import pathlib, subprocess, sys, time
child = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"])
pathlib.Path(sys.argv[1]).write_text(str(child.pid))
time.sleep(60)
"""


def is_gone(number):
    stat = Path("/proc") / number / "stat"
    return not stat.exists() or stat.read_text().rsplit(")", 1)[1].split()[0] == "Z"


@pytest.mark.parametrize("how", ["interrupted", "late"])
def test_a_process_is_ended_with_what_it_started(tmp_path, how):
    place = tmp_path / "number"

    def interrupt():
        while not (place.exists() and place.read_text()):
            time.sleep(0.1)
        os.kill(os.getpid(), signal.SIGINT)

    if how == "interrupted":
        threading.Thread(target=interrupt, daemon=True).start()
        with pytest.raises(KeyboardInterrupt):
            in_a_process(("-c", ANOTHER, str(place)), 60)
    else:
        started = time.time()
        assert in_a_process(("-c", ANOTHER, str(place)), 3) == "its 3 s were up"
        assert time.time() - started < 30
    time.sleep(0.5)
    assert is_gone(place.read_text())


@pytest.mark.parametrize(
    "code, reason",
    [
        ("import os; os.write(1, b'first\\nlast\\n'); os.kill(os.getpid(), 11)",
         "its process died of signal 11 (SIGSEGV): last"),
        ("1 / 0", "its process ended with code 1: ZeroDivisionError: division by zero"),
        ("print('noise')", ""),
        ("import multiprocessing as m; m.get_context('fork').Process().start()", ""),
    ],
    ids=["a crash", "an exception", "nothing", "processes of its own"],
)  # fmt: skip
def test_how_a_process_ended(code, reason):
    assert in_a_process(("-c", code), 30) == reason
