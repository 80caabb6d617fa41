"""``gamba ablate``: trains and evaluates the rows of a plan, one after the other, into one table.

Slow imports are inside functions, so that ``--help`` is quick.
"""

from __future__ import annotations

import shlex
import signal
from pathlib import Path

import tyro

from ..batch import counted, say
from ..conventions import DeviceChoice
from ..errors import UserError, one_line
from ..files import only_process, output_folder, write_json, write_text
from ..processes import run_gamba, stop_requests
from ..untrusted.documents import read_document
from ..untrusted.ranges import Seed, Threads, ranged

_TAIL = 1 << 14  # bytes of a log searched for the error


@ranged
def ablate_command(
    plan: tyro.conf.Positional[str],
    data: tyro.conf.Positional[Path],
    out: Path | None = None,
    rows: tuple[str, ...] = (),
    seeds: tuple[Seed, ...] = (),
    threads: Threads | None = None,
    device: DeviceChoice = "auto",
    dry_run: bool = False,
) -> int:
    """Train and evaluate the rows of a plan with the same data, seeds and budget; write one table.

    Writes table.json and table.md. Training and evaluation of a row are a process each, so a
    failed row stops no other. After Ctrl-C the same command resumes and skips finished work. Exit
    code 1 if a row failed.

    Args:
        plan: Name of a shipped plan (paper-table2, questions, ours), or a JSON file.
        data: Dataset of posed views.
        out: Folder of the results; by default out/ablation/NAME of the plan.
        rows: Only these rows; all by default.
        seeds: Seeds of every row, in place of the plan's.
        threads: CPU threads of the training; all cores by default.
        device: Device of every command; auto is the GPU if there is one.
        dry_run: Only print the commands.
    """
    from ..data.dataset import open_dataset
    from .plan import commands, open_plan

    chosen = open_plan(plan, data)
    wanted = [chosen.row(name) for name in dict.fromkeys(rows)] or chosen.rows
    out = Path("out/ablation") / chosen.name if out is None else out
    tasks = {}
    # All rows have one seed before one has two.
    for seed in dict.fromkeys(seeds or chosen.seeds):
        for row in wanted:
            folder = out / "rows" / row.name / f"seed-{seed}"
            more = ["--seed", str(seed), *(["--threads", str(threads)] if threads else [])]
            words = commands(chosen, row, data, folder, more)
            tasks[folder] = {file: [*w, "--device", device] for file, w in words.items()}
    if dry_run:
        for words in (words for task in tasks.values() for words in task.values()):
            print(f"gamba {shlex.join(words)}")
        return 0
    open_dataset(data)
    for folder, task in tasks.items():
        record = folder / "commands.json"
        begun = record.exists() and (folder / "run").exists()
        if begun and read_document(record, dict[str, list[str]]) != task:
            raise UserError(f"{folder}: was run with other options; give another --out")
    failed = False
    with only_process(output_folder(out), "runs an ablation"):
        for folder, task in tasks.items():
            write_json(output_folder(folder) / "commands.json", task)
            reason, stopped = _run(folder, task)
            name = f"{folder.parent.name}, {folder.name.replace('-', ' ')}"
            if stopped:
                print("stopped; the same command resumes from here")
                return 128 + stopped
            say(f"{name}: {reason or 'done'}")
            failed |= reason is not None
        from .table import make_table, markdown_table

        table = make_table(chosen, out)
        write_json(out / "table.json", table)
        write_text(out / "table.md", markdown_table(table))
    print(f"{counted(len(tasks), 'run')}; wrote {out / 'table.md'} and table.json")
    return int(failed)


def _run(folder: Path, task: dict[str, list[str]]) -> tuple[str | None, int]:
    """Run the unfinished commands of a row with one seed; training resumes automatically.

    Args:
        folder: of the row with one seed; has a log of each command.
        task: words of the commands, by the file that each makes.

    Returns:
        The reason of a failure, or None; and the signal that asked to stop, or 0.
    """
    for file, words in task.items():
        if (folder / file).exists():
            continue
        log = folder / f"{words[0]}.log"
        with stop_requests() as received, open(log, "ab") as output:
            code = run_gamba(words, output, received)
        if received:
            return None, received[0]
        if not (folder / file).exists():
            return f"failed: {words[0]}: {_reason(code, log)}", 0
    return None, 0


def _reason(code: int, log: Path) -> str:
    """Return why a command failed, in one line, from its exit code and the end of its log."""
    if code < 0:
        return f"died of {signal.Signals(-code).name}"
    with open(log, "rb") as file:
        file.seek(max(0, log.stat().st_size - _TAIL))
        lines = file.read().decode(errors="replace").split("\n")
    lines = [line.split("\r")[-1].strip() for line in lines if line.strip()]
    said = [line for line in lines if line.startswith("gamba: ")] or lines or [f"exit code {code}"]
    return one_line(said[-1].removeprefix("gamba: "), 300)
