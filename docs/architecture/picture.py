"""SVG diagram of the packages, as boxes on levels, and their imports, as arrows."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass
from html import escape

WIDTH, HEIGHT = 152, 54  # of a box, in pixels
COLUMN, ROW, MARGIN, HEAD = 172, 114, 26, 64
_APART = 11  # pixels between two arrows that pass the same floor

_STYLE = """
svg { font-family: ui-sans-serif, system-ui, "Segoe UI", "DejaVu Sans", sans-serif; }
.page { fill: #ffffff; } .name { font-size: 13px; font-weight: 600; }
.text { font-size: 10.5px; } text { fill: #1f2328; } .note { font-size: 12px; }
.box { stroke-width: 1.2; } .arrow { fill: none; stroke: #57606a; stroke-width: 1.3; }
.later { stroke-dasharray: 5 4; } .head { fill: #57606a; }
.kernels { fill: #dafbe1; stroke: #1a7f37; } .gamba_warp { fill: #ddf4ff; stroke: #0969da; }
.train { fill: #fff8c5; stroke: #9a6700; } .eval { fill: #fbefff; stroke: #8250df; }
@media (prefers-color-scheme: dark) {
  .page { fill: #0d1117; } text { fill: #e6edf3; }
  .arrow { stroke: #9198a1; } .head { fill: #9198a1; }
  .kernels { fill: #12261e; stroke: #3fb950; } .gamba_warp { fill: #121d2f; stroke: #4493f8; }
  .train { fill: #272115; stroke: #d29922; } .eval { fill: #1f1a2e; stroke: #ab7df8; }
}
"""


@dataclass(frozen=True)
class Box:
    """A package of the diagram: its column, its floor (0 is the lowest) and its text."""

    column: float
    floor: int
    folder: str
    title: str
    text: tuple[str, str]

    @property
    def x(self) -> float:
        """Centre, in pixels from the left."""
        return MARGIN + WIDTH / 2 + self.column * COLUMN

    @property
    def top(self) -> float:
        """Upper edge, in pixels from the top."""
        return HEAD + (FLOORS - 1 - self.floor) * ROW


BOXES = {
    "kernels.runtime": Box(1, 0, "kernels", "runtime", ("views, launches,", "threads, lanes")),
    "kernels.causal_conv1d": Box(
        0, 1, "kernels", "causal_conv1d", ("the convolution", "before the scan")
    ),
    "kernels.selective_scan": Box(
        1, 1, "kernels", "selective_scan", ("Mamba's scan", "cpu/ and cuda/")
    ),
    "kernels.rasterize": Box(
        2.4, 1, "kernels", "rasterize", ("Gaussians to pictures", "cpu/ and cuda/")
    ),
    "kernels.ssim": Box(4.4, 1, "kernels", "ssim", ("1 - SSIM of pictures", "and its gradient")),
    "kernels.triangles": Box(5.4, 1, "kernels", "triangles", ("intersecting", "faces")),
    "kernels": Box(0, 2, "kernels", "kernels", ("public operators,", "loaded when used")),
    "kernels.bench": Box(1, 2, "kernels", "bench", ("run time against error", "of the operators")),
    "kernels.stress": Box(2, 2, "kernels", "stress", ("hostile cases", "against float64")),
    "core": Box(3.4, 2, "gamba_warp", "core", ("gaussians, cameras,", "render, images, files")),
    "compat": Box(0, 3, "gamba_warp", "compat", ("other packages' names", "over our kernels")),
    "untrusted": Box(3.4, 3, "gamba_warp", "untrusted", ("validation of", "untrusted files")),
    "data": Box(2.5, 4, "gamba_warp", "data", ("datasets,", "preprocessing")),
    "formats": Box(4, 4, "gamba_warp", "formats", (".ply .splat .glb,", "meshes, their headers")),
    "vision": Box(1.4, 4, "gamba_warp", "vision", ("VGG16, LPIPS,", "their weights")),
    "model": Box(1.6, 6, "gamba_warp", "model", ("posing, tokens, blocks,", "decoder")),
    "surfaces": Box(4, 5, "gamba_warp", "surfaces", ("Gaussians to meshes:", "TSDF, density")),
    "fitting": Box(2.8, 5, "gamba_warp", "fitting", ("one object", "by optimisation")),
    "photo": Box(0.4, 5, "gamba_warp", "photo", ("cut-outs", "of photographs")),
    "trajectories": Box(
        6.4, 5, "gamba_warp", "trajectories", ("camera paths,", "their files, movies")
    ),
    "viewer": Box(5.2, 5, "gamba_warp", "viewer", ("the 3D viewer", "and its pages")),
    "app": Box(4, 11, "gamba_warp", "app", ("the local", "web app")),
    "pages": Box(2.2, 7, "gamba_warp", "pages", ("pages, turntables", "")),
    "measure": Box(0.6, 8, "gamba_warp", "measure", ("bench and stress cases", "with the model")),
    "train": Box(3.6, 8, "train", "train", ("batches, losses, loop;", "data/: rendering")),
    "eval": Box(4.8, 8, "eval", "eval", ("views/: PSNR, LPIPS", "shapes/: Chamfer, IoU")),
    "gpu_check": Box(0.6, 9, "gamba_warp", "gpu_check", ("checks on", "a CUDA machine")),
    "ablation": Box(2.1, 9, "gamba_warp", "ablation", ("rows trained and", "evaluated alike")),
    "commands": Box(2.2, 11, "gamba_warp", "commands", ("by subject:", "parse, call, print")),
    "cli": Box(2.8, 12, "gamba_warp", "cli", ("gamba COMMAND,", "python -m …")),
    "public": Box(0.2, 12, "gamba_warp", "gamba_warp", ("its public names,", "loaded when used")),
}
FLOORS = 1 + max(box.floor for box in BOXES.values())


def box_of(package: str) -> str:
    """Return the box of a package: an operator has one, train/data is drawn in train."""
    parts = package.split(".")
    return ".".join(parts[:2]) if parts[0] == "kernels" else parts[0]


def arrows(at_once: dict[str, set[str]], any_time: dict[str, set[str]]) -> dict:
    """Return the arrows to draw; the value is True if all imports are inside functions.

    Implied arrows are left out: if commands import pages, and pages import model, an arrow from
    commands to model is redundant.
    """
    graph: dict[str, set[str]] = defaultdict(set)
    firm = set()
    for entries in (at_once, any_time):
        for here, packages in entries.items():
            for there in packages:
                pair = (box_of(here), box_of(there))
                if pair[0] != pair[1] and set(pair) <= set(BOXES):
                    graph[pair[0]].add(pair[1])
                    if entries is at_once:
                        firm.add(pair)

    def below(box: str) -> set[str]:
        return set().union(*({near} | below(near) for near in graph[box]))

    drawn = {}
    for here in sorted(graph):
        for there in sorted(graph[here]):
            if not any(there in below(near) for near in graph[here] - {there}):
                drawn[here, there] = (here, there) not in firm
    return drawn


def draw(drawn: dict) -> str:
    """Return the SVG of ``arrows``."""
    width = MARGIN * 2 + WIDTH + max(box.column for box in BOXES.values()) * COLUMN
    height = HEAD + FLOORS * ROW - (ROW - HEIGHT) + MARGIN
    lines = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width:.0f} {height:.0f}" '
        f'width="{width:.0f}" height="{height:.0f}" role="img" '
        'aria-label="The packages of gamba_warp and what imports what">',
        f"<style>{_STYLE}</style>",
        '<defs><marker id="head" viewBox="0 0 8 8" refX="7" refY="4" markerWidth="7" '
        'markerHeight="7" orient="auto"><path class="head" d="M0 0 8 4 0 8z"/></marker></defs>',
        f'<rect class="page" width="{width:.0f}" height="{height:.0f}"/>',
        *_legend(),
    ]
    for (here, there), points in _routes(drawn).items():
        later = " later" if drawn[here, there] else ""
        lines.append(f'<path class="arrow{later}" marker-end="url(#head)" d="{_curve(points)}"/>')
    for box in BOXES.values():
        left = box.x - WIDTH / 2
        lines.append(
            f'<rect class="box {box.folder}" x="{left:.0f}" y="{box.top:.0f}" width="{WIDTH}" '
            f'height="{HEIGHT}" rx="6"/>'
        )
        rows = zip((17, 32, 45), ("name", "text", "text"), (box.title, *box.text), strict=True)
        lines += [_text(box.x, box.top + y, kind, text) for y, kind, text in rows]
    return "\n".join([*lines, "</svg>", ""])


def _text(x: float, y: float, kind: str, text: str, anchor: str = "middle") -> str:
    place = f'x="{x:.0f}" y="{y:.0f}" text-anchor="{anchor}"'
    return f'<text class="{kind}" {place}>{escape(text)}</text>'


def _legend() -> list[str]:
    lines, x = [], float(MARGIN)
    for folder in ("kernels", "gamba_warp", "train", "eval"):
        lines.append(f'<rect class="box {folder}" x="{x:.0f}" y="14" width="16" height="16"/>')
        lines.append(_text(x + 22, 26, "note", f"{folder}/", "start"))
        x += 52 + 7.5 * len(folder)
    for later, text in (("", "imports"), (" later", "imports inside functions")):
        path = f'd="M{x:.0f} 22h34"'
        lines.append(f'<path class="arrow{later}" marker-end="url(#head)" {path}/>')
        lines.append(_text(x + 42, 26, "note", text, "start"))
        x += 110
    return lines


def _routes(drawn: dict) -> dict:
    """Return the points of every arrow: down from its box, through gaps of the floors between."""
    outs, ins = defaultdict(list), defaultdict(list)
    for here, there in drawn:
        outs[here].append(there)
        ins[there].append(here)

    def port(box: str, others: list[str], other: str) -> float:
        order = sorted(others, key=lambda name: (BOXES[name].x, BOXES[name].floor))
        step = min(24.0, (WIDTH - 24) / len(order))
        return BOXES[box].x + (order.index(other) - (len(order) - 1) / 2) * step

    taken: dict[int, list[float]] = defaultdict(list)
    routes = {}
    for here, there in sorted(drawn, key=lambda pair: _length(*pair)):
        a, b = BOXES[here], BOXES[there]
        x0, x1 = port(here, outs[here], there), port(there, ins[there], here)
        points = [(x0, a.top + HEIGHT)]
        for floor in range(a.floor - 1, b.floor, -1):
            share = (a.floor - floor) / (a.floor - b.floor)
            x = _gap(floor, x0 + (x1 - x0) * share, taken[floor])
            taken[floor].append(x)
            top = HEAD + (FLOORS - 1 - floor) * ROW
            points += [(x, top - 4), (x, top + HEIGHT + 4)]
        routes[here, there] = [*points, (x1, b.top - 2)]
    return routes


def _length(here: str, there: str) -> tuple:
    a, b = BOXES[here], BOXES[there]
    return (a.floor - b.floor, abs(a.x - b.x), here, there)


def _gap(floor: int, wanted: float, taken: list[float]) -> float:
    """Return the free x nearest to ``wanted``: outside all boxes and other arrows of the floor."""
    boxes = [box.x for box in BOXES.values() if box.floor == floor]

    def free(x: float) -> bool:
        clear = all(abs(x - middle) >= WIDTH / 2 + 8 for middle in boxes)
        return clear and all(abs(x - other) >= _APART for other in taken)

    tries = (wanted + sign * 2 * step for step in range(1000) for sign in (1, -1))
    return next(x for x in tries if x > 8 and free(x))


def _curve(points: list[tuple[float, float]]) -> str:
    """Return a smooth path: straight through the floors, curved between them."""
    path = f"M{points[0][0]:.0f} {points[0][1]:.0f}"
    for (x0, y0), (x1, y1) in zip(points[::2], points[1::2], strict=True):
        bend = (y1 - y0) * 0.5
        path += f"C{x0:.0f} {y0 + bend:.0f} {x1:.0f} {y1 - bend:.0f} {x1:.0f} {y1:.0f}"
        after = points.index((x1, y1)) + 1
        if after < len(points):
            path += f"V{points[after][1]:.0f}"
    return path
