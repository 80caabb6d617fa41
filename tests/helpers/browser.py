"""Pages in a headless Chromium, driven by Playwright, with WebGL in software.

Tests that open a page take the fixture ``browser_page``; where Chromium or Playwright is missing,
they are skipped, with the missing one as the reason.
"""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
# A page must look the same on every machine: SwiftShader draws it, and nothing asks the network.
FLAGS = (
    *("--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"),
    *("--disable-quic", "--no-first-run", "--disable-background-networking"),
    *("--disable-component-update", "--disable-sync"),
)


@dataclass
class Opened:
    """Page with its warnings and errors.

    Attributes:
        page: Playwright's page.
        messages: warnings and errors of its console, and uncaught errors.
    """

    page: Any
    messages: list[str] = field(default_factory=list)

    def promised(self, expression: str, seconds: float = 30.0) -> Any:
        """Return the value of a JavaScript promise; a pending one fails the test."""
        late = f"setTimeout(() => fail(new Error('no answer')), {1000 * seconds})"
        race = f"Promise.race([{expression}, new Promise((_, fail) => {late})])"
        return self.page.evaluate(f"() => {race}")

    def until(self, expression: str, seconds: float = 30.0) -> None:
        """Wait until an expression of JavaScript is true, whatever the page's policy allows."""
        end = time.monotonic() + seconds
        while not self.page.evaluate(expression):
            assert time.monotonic() < end, f"{expression} does not become true"
            self.page.wait_for_timeout(10)

    def fingers(self, kind: str, *points: tuple[float, float]) -> None:
        """Send one touch event, ``touchStart``, ``touchMove`` or ``touchEnd``, of all fingers."""
        if not hasattr(self, "_devtools"):
            self._devtools = self.page.context.new_cdp_session(self.page)
        places = [{"x": x, "y": y, "id": i} for i, (x, y) in enumerate(points)]
        self._devtools.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": places})


def complains(message: Any) -> bool:
    """Return whether a message of Playwright's console is an error of the page or its requests.

    A graphics driver warns about its speed, above all in software rendering. Messages of a page
    have arguments, unlike those of the browser; a driver's errors count as the page's.
    """
    speed = "GL Driver Message (OpenGL, Performance," in message.text and not message.args
    return message.type == "error" or (message.type == "warning" and not speed)


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    """A headless Chromium for the tests of one file."""
    program = next(filter(None, map(shutil.which, NAMES)), None)
    if program is None:
        pytest.skip(f"needs a browser: none of {', '.join(NAMES)} is installed")
    missing = "needs playwright, which is not installed"
    library = pytest.importorskip("playwright.sync_api", reason=missing)
    with library.sync_playwright() as playwright:
        found = playwright.chromium.launch(executable_path=program, args=list(FLAGS))
        yield found
        found.close()


@pytest.fixture
def browser_page(browser) -> Iterator[Callable[..., Opened]]:
    """Open pages: ``browser_page(file or address, width=640, height=480, **options)``.

    The options are those of Playwright's ``new_context``, such as ``has_touch`` and
    ``color_scheme``. All pages are closed after the test.
    """
    contexts = []

    def opened(place: Path | str, width: int = 640, height: int = 480, **options: Any) -> Opened:
        context = browser.new_context(viewport={"width": width, "height": height}, **options)
        contexts.append(context)
        context.set_default_timeout(30_000)
        result = Opened(context.new_page())
        note = result.messages.append
        result.page.on("console", lambda message: complains(message) and note(message.text))
        result.page.on("pageerror", lambda error: note(str(error)))
        result.page.goto(place.resolve().as_uri() if isinstance(place, Path) else place)
        return result

    yield opened
    for context in contexts:
        context.close()
