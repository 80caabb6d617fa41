"""Frames per second of the viewer in a headless Chromium that draws in software, at 720p.

    python docs/examples/viewer_speed.py 4096 16384

Each object is a bumpy ball covered about three times by its Gaussians. It is turned for some
seconds until the viewer has adapted to the machine, then for some more, which are measured. Needs
playwright (in the extra test) and an installed Chromium.
"""

import argparse
import math
import shutil
import tempfile
import time
from pathlib import Path

import torch
from playwright.sync_api import sync_playwright

from gamba_warp.gaussians import Gaussians
from gamba_warp.viewer.page import write_viewer

FLAGS = ["--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"]
TURN = """(seconds) => new Promise((done) => {
  const viewer = gambaViewer, before = viewer.stats.frames, start = performance.now();
  let longest = 0;
  const watch = new PerformanceObserver((list) => {
    for (const entry of list.getEntries()) longest = Math.max(longest, entry.duration);
  });
  watch.observe({ entryTypes: ["longtask"] });
  const step = () => {
    const passed = (performance.now() - start) / 1000;
    if (passed < seconds) {
      viewer.act.turn(6, 0.5);
      return requestAnimationFrame(step);
    }
    watch.disconnect();
    const frames = (viewer.stats.frames - before) / passed;
    done({ frames, longest, share: SIZES[viewer.coarse], some: viewer.some });
  };
  step();
})"""


def ball(n: int) -> Gaussians:
    """``n`` Gaussians on a bumpy ball."""
    directions = torch.nn.functional.normalize(torch.randn(n, 3), dim=1)
    radii = 0.4 + 0.05 * (6 * directions).sin().prod(1, keepdim=True)
    side = 0.5 * math.sqrt(1.5 * 4 * math.pi * 0.16 / n)
    return Gaussians(
        means=directions * radii,
        quats=torch.randn(n, 4),
        scales=side * (0.3 + torch.rand(n, 3)),
        opacities=0.3 + 0.7 * torch.rand(n),
        colors=(0.5 + 0.5 * directions).clamp(0, 1),
    )


def measure(browser, n: int, folder: Path, seconds: float) -> None:
    """Print one line about ``n`` Gaussians."""
    path = folder / f"{n}.html"
    write_viewer(path, "Ball", ball(n), camera=(1.5, 49.1, 0.0))
    page = browser.new_page(viewport={"width": 1280, "height": 720})
    start = time.perf_counter()
    page.goto(path.as_uri())
    page.evaluate("gambaViewer.rest()")
    loaded = time.perf_counter() - start
    page.evaluate(TURN, seconds)
    found = page.evaluate(TURN, seconds)
    start = time.perf_counter()
    page.evaluate("gambaViewer.rest()")
    sharp = time.perf_counter() - start
    page.close()
    print(
        f"{n:9,} Gaussians: file {path.stat().st_size / 1e6:.2f} MB, first picture after "
        f"{loaded:.1f} s; moving {found['frames']:.1f} frames/s at {found['share']:.2f} of each "
        f"side and {found['some']:,} Gaussians; complete {sharp:.1f} s after it rests; longest "
        f"task of the page {found['longest']:.0f} ms",
        flush=True,
    )


def main() -> None:
    """Measure each requested number of Gaussians."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("numbers", type=int, nargs="+")
    parser.add_argument("--seconds", type=float, default=4.0)
    options = parser.parse_args()
    names = ("chromium", "chromium-browser", "google-chrome")
    program = next(filter(None, map(shutil.which, names)), None)
    with tempfile.TemporaryDirectory() as folder, sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=program, args=FLAGS)
        for n in options.numbers:
            measure(browser, n, Path(folder), options.seconds)
        browser.close()


if __name__ == "__main__":
    main()
