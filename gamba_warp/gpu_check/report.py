"""The page of ``gamba gpu-check``: a table of findings, what was not done, and the benchmark."""

from __future__ import annotations

import torch
import warp as wp

from ..kernels.bench.core.case import Settings
from ..kernels.bench.core.measure import machine
from ..kernels.bench.core.report import case_parts, work_text
from ..kernels.bench.peers import versions
from ..kernels.runtime.tables import markdown
from ..versions import installed

_OTHERS = ("timm", "pytest", "triton", "tyro", "safetensors")


def machine_facts(settings: Settings) -> dict:
    """Returns the facts of ``gamba bench``, with more on the GPU and on the other packages."""
    facts = machine(settings)
    if settings.device.type == "cuda":
        gpu = torch.cuda.get_device_properties(settings.device)
        free, total = torch.cuda.mem_get_info(settings.device)
        facts |= {
            "architecture": f"sm_{gpu.major}{gpu.minor}",
            "multiprocessors": gpu.multi_processor_count,
            "memory_gib": round(total / 2**30, 1),
            "free_gib": round(free / 2**30, 1),
            "driver": ".".join(map(str, wp.get_cuda_driver_version() or ())),
        }
    return facts | {"packages": installed(*_OTHERS) | versions()}


def headline(document: dict) -> list[tuple[str, str]]:
    """Returns what was found, in rows of a name and a value."""
    packages = ", ".join(f"{k} {v}" for k, v in document["machine"]["packages"].items())
    facts = document["machine"] | {"packages": packages}
    rows = [(name.replace("_", " "), str(value)) for name, value in facts.items() if value]
    for step in document["steps"]:
        reason = f": {step['reason']}" if step["reason"] else ""
        rows.append((f"step {step['name']}", f"{step['status']}, {step['seconds']:.0f} s{reason}"))
    if words := [check["status"] for check in document["checks"]]:
        counts = (f"{words.count(word)} {word}" for word in dict.fromkeys(words))
        rows.append(("checks of the kernels", ", ".join(counts)))
    for r in document["bench"]["records"]:
        if r["op"] == "inference":
            value = r["status"]
            if value == "ok":
                value = f"{r['ms_p50']:.3g} ms ({r['ms_p20']:.3g} to {r['ms_p80']:.3g})"
                value = ", ".join(filter(None, (value, work_text(r))))
            if r["rel_rms_error"] is not None:
                value += f", error {r['rel_rms_error']:.2g} to {r['oracle']}"
            rows.append((f"inference, {r['variant']}", value))
    return rows


def page(document: dict) -> str:
    """Returns the document as a Markdown page."""
    title = document["verdict"]
    lines = ["# gamba gpu-check", "", f"Written by `gamba gpu-check`, not by hand. **{title}**", ""]
    lines.append(markdown(("what", "found"), headline(document)))
    not_done = [f"{row['what']}: {row['reason']}" for row in document["not_done"]]
    for name, rows in (("Failed", document["failures"]), ("Not done", not_done)):
        if rows:
            lines += ["", f"## {name}", "", *(f"- {row}" for row in rows)]
    for part in case_parts(document["bench"]):
        lines += ["", f"## {part.title}", "", *part.texts, ""]
        lines += [markdown(*rows) for rows in part.tables]
    return "\n".join([*lines, ""])
