"""The page of ``gamba gpu-check``: a table of findings, what was not done, and the benchmark."""

from __future__ import annotations

import torch
import warp as wp

from ..kernels.bench.core.case import Settings
from ..kernels.bench.core.measure import machine
from ..kernels.bench.core.report import groups, oracles, table
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
    results = document["results"]
    if found := results.get("compile"):
        text = f"{found['kernels']} of {found['of']} in {found['seconds']:.1f} s"
        rows.append(("kernels compiled or loaded", text))
    if words := [check["status"] for check in results.get("checks", {}).get("checks", [])]:
        counts = (f"{words.count(word)} {word}" for word in dict.fromkeys(words))
        rows.append(("checks of the kernels", ", ".join(counts)))
    inference = results.get("inference", {})
    for name, value in inference.get("ceilings", {}).items():
        rows.append((name.replace("_per_", "/").replace("_", " "), f"{value:.3g}"))
    if "reserved_gib" in inference:
        text = f"{inference['reserved_gib']:.1f} GiB, graphs and both precisions together"
        rows.append(("inference, memory taken", text))
    for record in document["bench"]["records"]:
        if record["op"] == "inference":
            rows.append((f"inference, {record['variant']}", _time(record)))
    return rows


def _time(record: dict) -> str:
    if record["status"] != "ok":
        return record["status"]
    text = f"{record['ms_p50']:.3g} ms ({record['ms_p20']:.3g} to {record['ms_p80']:.3g})"
    if "peak_bytes" in record["work"]:
        text += f", {record['work']['peak_bytes'] / 2**20:,.0f} MiB more at the peak"
    if record["rel_rms_error"] is not None:
        text += f", error {record['rel_rms_error']:.2g} to {record['oracle']}"
    return text


def page(document: dict) -> str:
    """Returns the document as a Markdown page."""
    title = document["verdict"]
    lines = ["# gamba gpu-check", "", f"Written by `gamba gpu-check`, not by hand. **{title}**", ""]
    lines.append(markdown(("what", "found"), headline(document)))
    not_done = [f"{row['what']}: {row['reason']}" for row in document["not_done"]]
    for name, rows in (("Failed", document["failures"]), ("Not done", not_done)):
        if rows:
            lines += ["", f"## {name}", "", *(f"- {row}" for row in rows)]
    for op, cases in groups({"records": document["bench"]["records"]}).items():
        for case, found in cases.items():
            lines += ["", f"## {op}: {case}", "", f"{found[0]['text']} {oracles(found)}", ""]
            lines.append(markdown(*table(found)))
    return "\n".join([*lines, ""])
