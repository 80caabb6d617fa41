"""A running ``gamba app``, and programs that talk to it without a browser."""

from __future__ import annotations

import http.client
import json
import os
import re
import secrets
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from gamba_warp.files import STARTER
from helpers.forked import python

MEGABYTES = 1  # the limit on uploads here
EDGE = "edge"
FORM = {"Content-Type": f"multipart/form-data; boundary={EDGE}"}


@dataclass
class Served:
    """A running ``gamba app``."""

    process: subprocess.Popen
    address: str
    temporary: Path

    @property
    def host(self) -> str:
        return self.address.removeprefix("http://").partition("/")[0]

    def folders(self) -> list[str]:
        return sorted(p.name for p in self.temporary.glob("gamba-app-*"))


def command(*options) -> list[str]:
    shared = ["--no-open-browser", "--checkpoint", str(STARTER / "tiny.safetensors")]
    return [python(), "-m", "gamba_warp", "app", *shared, *map(str, options)]


@contextmanager
def serving(temporary: Path) -> Iterator[Served]:
    """Start the command like a user, with its own folder for temporary files."""
    environment = {**os.environ, "TMPDIR": str(temporary), "HTTP_PROXY": "http://127.0.0.1:9"}
    words = command("--port", 0, "--max-upload-mb", MEGABYTES, "--device", "cpu")
    pipes: dict[str, Any] = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    process = subprocess.Popen(words, env=environment, **pipes)
    lines = [process.stdout.readline() for _ in range(4)]
    match = re.match(r"(http://127\.0\.0\.1:\d+/\?token=\S+) \(Ctrl-C ends it\)$", lines[-1])
    assert match, "".join(lines) + process.communicate(timeout=10)[1]
    parts = ("torch", "the model", "the page's libraries")
    assert lines[:3] == [f"loading {part}\n" for part in parts]
    yield Served(process, match[1], temporary)
    process.kill()
    process.communicate()


@dataclass
class Answer:
    """Response of the server."""

    status: int
    headers: dict[str, str]
    body: bytes


def form(content: bytes, name: str = "a.png") -> bytes:
    """The body of an upload."""
    head = f'--{EDGE}\r\nContent-Disposition: form-data; name="files"; filename="{name}"\r\n\r\n'
    return head.encode() + content + f"\r\n--{EDGE}--\r\n".encode()


@dataclass
class Program:
    """Program on the same machine that sends any requests; ``opened`` has the cookie."""

    host: str
    headers: dict[str, str] = field(default_factory=dict)
    session: str = field(default_factory=lambda: secrets.token_hex(5))

    def ask(self, place: str, body: bytes | None = None, method: str = "", **headers) -> Answer:
        """Send one request; names of headers have ``_`` for ``-``."""
        link = http.client.HTTPConnection(self.host, timeout=30)
        named = {name.replace("_", "-"): value for name, value in headers.items()}
        sent = {name: value for name, value in {**self.headers, **named}.items() if value}
        link.request(method or ("GET" if body is None else "POST"), place, body, sent)
        got = link.getresponse()
        answer = Answer(got.status, {k.lower(): v for k, v in got.getheaders()}, got.read())
        link.close()
        return answer

    def opened(self, address: str) -> Program:
        """Open the printed address first, like a browser."""
        answer = self.ask(address.removeprefix(f"http://{self.host}"))
        assert answer.status == 303 and answer.headers["location"] == "/", answer
        self.headers["Cookie"] = answer.headers["set-cookie"].partition(";")[0]
        return self

    def upload(self, content: bytes, name: str = "a.png") -> str:
        """Upload a file; return its path for the page."""
        answer = self.ask("/gradio_api/upload", form(content, name), **FORM)
        assert answer.status == 200, answer
        return json.loads(answer.body)[0]

    def join(self, number: Any, data: list, **more) -> Answer:
        """Request a call of a function; ``result`` returns its output."""
        call = {"fn_index": number, "data": data, "session_hash": self.session, **more}
        kind = {"Content-Type": "application/json"}
        return self.ask("/gradio_api/queue/join", json.dumps(call).encode(), **kind)

    def result(self, number: int, data: list, **more) -> dict:
        """Return the output of a call: ``data``, or an ``error``."""
        answer = self.join(number, data, **more)
        assert answer.status == 200, answer
        events = self.ask(f"/gradio_api/queue/data?session_hash={self.session}").body.decode()
        found = [json.loads(line[6:]) for line in events.splitlines() if line.startswith("data: ")]
        [output] = [event["output"] for event in found if event["msg"] == "process_completed"]
        return output
