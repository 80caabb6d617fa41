"""``gamba gpu-check``: all that only a CUDA machine can tell, in one run of a few minutes.

Needs torch, numpy and warp-lang, nothing else, and no installation: in a bare checkout
``python -m gamba_warp.gpu_check`` is the same command. Each step runs in a process of its own,
within its time; both files are written after every item, and say what was not done.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import torch

from ..errors import UserError
from ..files import CHECKOUT, atomic_path, output_folder, write_json
from ..kernels.bench import Settings
from ..kernels.bench.peers import PACKAGES, versions
from . import MINUTES, STEPS, Step
from .report import headline, machine_facts, page

FORMAT = "gamba_warp.gpu_check.1"
_GRACE = 15.0  # seconds that the last item of a step may take
_LEAST = 5.0  # seconds below which no step begins


def run_gpu_check(
    device: str = "cuda",
    quick: bool = False,
    out: Path = Path("out/gpu-check"),
    minutes: float = MINUTES,
    steps: Sequence[str] = (),
) -> int:
    """Runs kernel checks, full-size inference and the benchmark on this machine.

    Args:
        device: "cuda"; or "cpu", which tries the command itself.
        quick: tiny sizes.
        out: folder for gpu-check.json and gpu-check.md.
        minutes: time limit of the whole run.
        steps: names of ``STEPS``, or none for all.

    Returns:
        The exit code: 0 all that could be run passed, 1 something failed, 130 Ctrl-C.

    Raises:
        UserError: there is no CUDA device, or an option is out of range.
    """
    if device == "cuda" and not torch.cuda.is_available():
        raise UserError("no CUDA device here; --device cpu --quick tries the command itself")
    if not 0 < minutes < float("inf"):
        raise UserError(f"--minutes is {minutes}, it must be positive")
    run = Run(make_settings(device, quick), output_folder(out), 60 * minutes)
    try:
        for step in STEPS:
            if not steps or step.name in steps:
                run.do(step, step.seconds * minutes / MINUTES)
    except KeyboardInterrupt:
        run.finish("interrupted; what was done is here")
        return 130
    failures = len(run.document()["failures"])
    run.finish(f"{failures} failed" if failures else "all that could be run passed")
    return 1 if failures else 0


def make_settings(device: str, quick: bool) -> Settings:
    """The settings of the benchmark's cases, by the options of the command."""
    level = "quick" if quick else "normal"
    return Settings(torch.device(device), level, False, torch.get_num_threads())


class Run:
    """A run under way; its files are written whenever something is added."""

    def __init__(self, settings: Settings, folder: Path, seconds: float) -> None:
        self.settings, self.folder = settings, folder
        self.ends = time.time() + seconds
        self.verdict = "not finished"
        self.machine = machine_facts(settings)
        self.steps: list[dict] = []
        self.parts: dict[str, dict] = {"packages": new_part()}
        for package in sorted(set(PACKAGES) - versions().keys()):
            self._leave_out("packages", f"comparison with {package}", "not installed")
        self.write()

    def _leave_out(self, name: str, what: str, reason: str) -> None:
        self.parts[name]["not_done"].append({"what": what, "reason": reason})

    def document(self) -> dict:
        """Everything that is known so far, ready for JSON.

        It is ``{format, verdict, machine, settings, steps, results, failures, not_done, bench}``;
        the last is one document as ``gamba bench`` writes it, inference included.
        """
        parts = self.parts.values()
        results = {name: dict(part["result"]) for name, part in self.parts.items()}
        benches = [found.pop("bench") for found in results.values() if "bench" in found]
        return {
            "format": FORMAT,
            "verdict": self.verdict,
            "machine": self.machine,
            "settings": {"device": self.settings.device.type, "level": self.settings.level},
            "steps": self.steps,
            "results": {name: found for name, found in results.items() if found},
            "failures": [failure for part in parts for failure in part["failures"]],
            "not_done": [row for part in parts for row in part["not_done"]],
            "bench": join_benches(benches),
        }

    def write(self) -> None:
        """Replaces both files."""
        document = self.document()
        write_json(self.folder / "gpu-check.json", document)
        with atomic_path(self.folder / "gpu-check.md") as temporary:
            temporary.write_text(page(document), encoding="utf-8")

    def finish(self, verdict: str) -> None:
        """Writes the files for the last time, and prints the table."""
        self.verdict = verdict
        self.write()
        document = self.document()
        rows = headline(document)
        width = min(60, max(len(name) for name, _ in rows))
        lines = [f"{name:<{width}}  {value}" for name, value in rows]
        lines += [f"failed: {text}" for text in document["failures"]]
        lines += [f"not done: {row['what']}: {row['reason']}" for row in document["not_done"]]
        print("\n".join(lines))
        print(f"{verdict}; wrote {self.folder / 'gpu-check.json'} and gpu-check.md")

    def do(self, step: Step, seconds: float) -> None:
        """Runs a step in a process of its own, for ``seconds`` at most or the rest of the run."""
        started = time.time()
        seconds = min(seconds, self.ends - started - 1)
        row = {"name": step.name, "status": "not done", "reason": "", "seconds": 0.0}
        self.steps.append(row)
        self.parts[step.name] = new_part()
        if step.cuda and self.settings.device.type != "cuda":
            row["reason"] = "needs CUDA"
        elif step.packages and not versions().keys() & set(step.packages):
            row["reason"] = f"not installed: {', '.join(step.packages)}"
        elif seconds < _LEAST:
            row["reason"] = "time was up"
        else:
            code, said = self._child(step.name, seconds)
            part = self.parts[step.name]
            row["status"] = "passed"
            if code is None:
                row.update(status="stopped", reason=f"its {seconds:.0f} s were up")
            elif not part["whole"]:
                row["reason"] = f"ended with code {code}: {said}"
                part["failures"].append(f"step {step.name} {row['reason']}")
            if part["failures"]:
                row["status"] = "failed"
        row["seconds"] = time.time() - started
        if row["status"] in ("not done", "stopped"):
            rest = "the rest of " if row["status"] == "stopped" else ""
            self._leave_out(step.name, f"{rest}step {step.name}", row["reason"])
        self.write()
        reason = f" ({row['reason']})" if row["reason"] else ""
        print(f"{step.name:<10} {row['status']}{reason}, {row['seconds']:.0f} s", flush=True)

    def _child(self, name: str, seconds: float) -> tuple[int | None, str]:
        """Runs a step of ``steps``; what it writes is taken over while it runs."""
        until = time.time() + max(seconds - _GRACE, seconds / 2)
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "part.json"

            def look() -> None:
                if path.exists():
                    part = json.loads(path.read_bytes())
                    if part != self.parts[name]:
                        self.parts[name] = part
                        self.write()

            command = ["-m", "gamba_warp.gpu_check", "--child", name, "--out", str(path)]
            command += ["--device", self.settings.device.type, "--until", str(until)]
            command += ["--quick"] * (self.settings.level == "quick")
            return run_python(command, seconds, look)


def join_benches(documents: list[dict]) -> dict:
    """Joins documents to one; a case or a measured target of a later one replaces an earlier."""
    records: list[dict] = []
    targets: dict[tuple, dict] = {}
    for document in documents:
        new = {(r["op"], r["case"]) for r in document["records"]}
        records = [r for r in records if (r["op"], r["case"]) not in new] + document["records"]
        for target in document.get("targets", []):
            key = target["op"], target["text"]
            if key not in targets or target["value"] is not None:
                targets[key] = target
    joined = documents[0] if documents else {}
    return joined | {"records": records, "targets": list(targets.values())}


def new_part() -> dict:
    """What ``Part.write`` writes of a step that has done nothing."""
    return {"result": {}, "not_done": [], "failures": [], "whole": False}


def run_python(
    arguments: list[str], seconds: float, look: Callable[[], None]
) -> tuple[int | None, str]:
    """Runs Python, and ends it with all that it started when its time is up.

    Args:
        arguments: of Python.
        seconds: time limit.
        look: called every tenth of a second, and at the end.

    Returns:
        The exit code, None if it was ended, and the last line that it printed.
    """
    paths = [str(CHECKOUT), os.environ.get("PYTHONPATH", "")]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, paths))}
    ends = time.time() + seconds
    with tempfile.TemporaryFile() as said:
        process = subprocess.Popen(
            [sys.executable, *arguments],
            **{"stdout": said, "stderr": subprocess.STDOUT, "stdin": subprocess.DEVNULL},
            **{"env": environment, "start_new_session": True},
        )
        try:
            while process.poll() is None and time.time() < ends:
                time.sleep(0.1)
                look()
            code = process.poll()
        finally:
            if process.poll() is None:
                end_tree(process)
        look()
        said.seek(0)
        lines = said.read().decode(errors="replace").strip().splitlines()
    return code, lines[-1] if lines else "nothing was printed"


def end_tree(process: subprocess.Popen) -> None:
    """Ends a process, and what it started itself; waits until the process is gone.

    Args:
        process: made with ``start_new_session``, which makes it a group where there are groups.
    """
    if hasattr(os, "killpg"):
        os.killpg(process.pid, signal.SIGKILL)
    elif sys.platform == "win32":
        # By its whole path: Windows would look in the working directory before its own folders.
        root = os.environ.get("SystemRoot", "C:\\Windows")
        taskkill = os.path.join(root, "System32", "taskkill.exe")
        with contextlib.suppress(OSError, subprocess.TimeoutExpired):
            subprocess.run(
                [taskkill, "/F", "/T", "/PID", str(process.pid)], capture_output=True, timeout=30
            )
    process.kill()  # does nothing if it is gone; else at least the process itself ends
    process.wait()


def main(arguments: list[str] | None = None) -> int:
    """``python -m gamba_warp.gpu_check``: the command without tyro; with --child, one step."""
    parser = argparse.ArgumentParser(
        prog="gamba gpu-check", description=(run_gpu_check.__doc__ or "").split("\n\n")[0]
    )
    parser.add_argument("--device", choices=("cuda", "cpu"), default="cuda")
    parser.add_argument("--quick", action="store_true", help="tiny sizes")
    parser.add_argument("--out", type=Path, default=Path("out/gpu-check"), help="folder")
    parser.add_argument("--minutes", type=float, default=MINUTES, help="the run takes no longer")
    names = [step.name for step in STEPS]
    parser.add_argument("--steps", nargs="+", choices=names, default=(), help="only these")
    parser.add_argument("--child", help=argparse.SUPPRESS)
    parser.add_argument("--until", type=float, help=argparse.SUPPRESS)
    o = parser.parse_args(arguments)
    if o.child:
        # Imported here, because an import may be what breaks a step, and must end that step alone.
        from .steps import Part, run_step

        run_step(o.child, Part(o.out, o.until), make_settings(o.device, o.quick))
        return 0
    try:
        return run_gpu_check(o.device, o.quick, o.out, o.minutes, o.steps)
    except UserError as error:
        print(f"gamba: {error}", file=sys.stderr)
        return 2
