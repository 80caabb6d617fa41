"""What the page's server lets in, leaves behind, and computes on."""

import asyncio
import json
import logging
import os
import threading
import time
from pathlib import Path

import pytest
from helpers.app import FORM, form

from gamba_warp.app import guard, server
from gamba_warp.app import shelf as shelves
from gamba_warp.app.server import MainThread
from gamba_warp.app.shelf import Shelf
from gamba_warp.errors import UserError


def answered(host, kind="http", path="/", method="GET", shelf=None, body=b"", token=None):
    """What the guard answers to a request: the messages, and whether it let it in."""
    sent, inside = [], []

    async def app(scope, receive, send):
        inside.append(scope)
        await send({"type": "http.response.start", "status": 200, "headers": [(b"a", b"b")]})
        await send({"type": "http.response.body", "body": b""})

    async def receive():
        return {"type": "http.request", "body": body}

    async def send(message):
        sent.append(message)

    headers = [] if host is None else [(b"host", host.encode())]
    headers += [(b"content-type", FORM["Content-Type"].encode())]
    headers += [(b"content-length", str(len(body)).encode())]
    headers += [(b"cookie", f"gamba-visitor={token}".encode())] if token else []
    scope = {"type": kind, "headers": headers, "path": path, "method": method}
    asyncio.run(guard.Guard(app, shelf, {}, 1 << 20)(scope, receive, send))
    return sent, bool(inside)


@pytest.mark.parametrize("host", ["127.0.0.1:7860", "localhost:1", "127.0.0.1", "localhost"])
def test_our_own_names_are_let_in(host):
    sent, inside = answered(host)
    assert inside and sent[0]["status"] == 200
    headers = dict(sent[0]["headers"])
    assert headers[b"a"] == b"b"
    policy = headers[b"content-security-policy"].decode()
    assert "default-src 'self'" in policy and "http" not in policy and "*" not in policy


@pytest.mark.parametrize(
    "host",
    [
        *("evil.example", "evil.example:7860", "127.0.0.1.evil.example:80", "", None, "[::1]:80"),
        *("127.0.0.1:80:80", "127.0.0.1:", "localhost.", "127.0.0.1 evil.example"),
    ],
)
def test_other_names_are_refused(host):
    sent, inside = answered(host)
    assert not inside and sent[0]["status"] == 421
    sent, inside = answered(host, "websocket")
    assert not inside and sent == [{"type": "websocket.close", "code": 1008}]


def test_a_cookie_is_given_once_and_is_the_visitor():
    def cookie(token):
        return dict(answered("localhost", token=token)[0][0]["headers"]).get(b"set-cookie")

    first, second = cookie(None), cookie("../../etc")
    assert second and first != second and b"; HttpOnly; SameSite=Lax; Path=/" in first
    assert cookie(first.decode().partition("=")[2].partition(";")[0]) is None


def test_all_uploads_together_are_bounded(tmp_path):
    """A megabyte each; the first ones go."""
    shelf, paths = Shelf(tmp_path, limit=4 << 20), []
    for k in range(9):
        body = form(bytes([k]) * (1 << 20))
        request = {"path": "/gradio_api/upload", "method": "POST", "body": body}
        sent, _ = answered("localhost", shelf=shelf, token="a" * 32, **request)
        assert sent[0]["status"] == 200
        paths.append(Path(json.loads(sent[1]["body"])[0]))
        os.utime(paths[-1], (time.time() - 100 + k,) * 2)
        kept = [path for path in tmp_path.rglob("*") if path.is_file()]
        assert sum(path.stat().st_size for path in kept) <= shelf.limit
    assert [path.is_file() for path in paths] == [False] * 6 + [True] * 3
    assert not paths[0].parent.exists()


def test_what_comes_in_at_once_is_bounded(tmp_path):
    """Of four that dawdle with a megabyte each, the fourth is sent away."""
    sent = [[] for _ in range(4)]

    async def receive():
        await asyncio.sleep(60)

    async def come():
        layer = guard.Guard(None, Shelf(tmp_path, limit=7 << 19), {}, 1 << 20)
        headers = [(b"host", b"localhost"), (b"cookie", b"gamba-visitor=" + b"a" * 32)]
        headers += [(b"content-length", b"1048576")]
        headers += [(b"content-type", FORM["Content-Type"].encode())]
        scope = {"type": "http", "method": "POST", "path": "/gradio_api/upload"}

        async def ask(k):
            async def send(message):
                sent[k].append(message.get("status"))

            await layer({**scope, "headers": list(headers)}, receive, send)

        tasks = [asyncio.create_task(ask(k)) for k in range(4)]
        await asyncio.wait(tasks, timeout=10, return_when=asyncio.FIRST_COMPLETED)
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        assert layer._coming == 0, "who leaves makes room"

    asyncio.run(come())
    assert sent == [[], [], [], [503, None]]


def test_old_files_go_by_themselves(tmp_path, monkeypatch):
    monkeypatch.setattr(guard, "KEPT", 0.06)
    monkeypatch.setattr(shelves, "KEPT", 0.06)
    shelf = Shelf(tmp_path)
    path = shelf.place("a") / "picture.png"
    path.write_bytes(b"x")

    async def lives(scope, receive, send):
        await asyncio.sleep(0.3)

    assert path.exists()
    asyncio.run(guard.Guard(lives, shelf, {}, 1)({"type": "lifespan"}, None, None))
    assert not path.exists() and not path.parent.exists()


def test_nothing_of_the_environment_opens_the_server(monkeypatch, tmp_path):
    for name in ("GRADIO_SHARE", "GRADIO_NUM_WORKERS", "GRADIO_ROOT_PATH", "GRADIO_ANYTHING"):
        monkeypatch.setenv(name, "7")
    monkeypatch.setattr(os, "environ", dict(os.environ))
    server.quiet(tmp_path)
    ours = {name: value for name, value in os.environ.items() if name.startswith("GRADIO_")}
    assert ours.pop("GRADIO_TEMP_DIR") == str(tmp_path)
    assert set(ours.values()) == {"False"}


@pytest.fixture
def temporary(tmp_path, monkeypatch):
    """The folder for temporary files, which is everybody's."""
    folder = tmp_path / "tmp"
    folder.mkdir()
    monkeypatch.setattr(server.tempfile, "tempdir", str(folder))
    return folder


def left_folder(path, mode=0o700):
    """What a killed process leaves."""
    path.mkdir()
    path.chmod(mode)
    (path / "picture.png").write_bytes(b"x")
    (path / ".lock").write_text("1\n")
    return path


def test_the_folder_goes_and_so_do_those_of_the_killed(temporary):
    killed, foreign = (temporary / f"{server.PREFIX}{name}" for name in ("killed", "foreign"))
    left_folder(killed)
    (left_folder(foreign) / ".lock").unlink()
    with server.work_folder() as first:
        assert not killed.exists() and foreign.exists(), "without our lock it may be anybody's"
        (first / "sub").mkdir()
        with server.work_folder() as second:
            assert first.exists() and second != first, "another that runs keeps its own"
        assert not second.exists()
    assert list(temporary.iterdir()) == [foreign]


def test_a_link_is_not_followed(tmp_path, temporary):
    """Neither one in a folder's place nor one in that of its lock, with any version of filelock."""
    home = left_folder(tmp_path / "home")
    (temporary / f"{server.PREFIX}folder").symlink_to(home)
    left = left_folder(temporary / f"{server.PREFIX}lock")
    (left / ".lock").unlink()
    (left / ".lock").symlink_to(home / "picture.png")
    with server.work_folder():
        assert (home / ".lock").exists() and left.exists()
    assert (home / "picture.png").read_bytes() == b"x"


@pytest.mark.skipif(os.name != "posix", reason="folders have owners and modes on POSIX alone")
def test_folders_of_others_are_left(temporary, monkeypatch):
    ours = left_folder(temporary / f"{server.PREFIX}ours")
    open_to_all = left_folder(temporary / f"{server.PREFIX}open", 0o777)
    monkeypatch.setattr(server.os, "geteuid", lambda: os.getuid() + 1)
    with server.work_folder():
        assert ours.exists() and (ours / ".lock").read_text() == "1\n"
    monkeypatch.undo()
    monkeypatch.setattr(server.tempfile, "tempdir", str(temporary))
    with server.work_folder():
        assert not ours.exists() and open_to_all.exists()
    assert (open_to_all / ".lock").read_text() == "1\n"


def test_a_port_in_use_is_one_line():
    import socket

    with socket.socket() as taken:
        taken.bind((server.HOST, 0))
        taken.listen()
        port = taken.getsockname()[1]
        with pytest.raises(UserError, match=f"--port {port}: Address already in use"):
            server.free_port(port)
    assert 0 < server.free_port(0) < 65536


def test_a_browser_that_leaves_is_no_error():
    def logged(error):
        info = (type(error), error, None)
        return server._is_ours(logging.LogRecord("uvicorn.error", 40, "", 1, "x", (), info))

    requests = pytest.importorskip("starlette.requests", reason="needs gradio")
    assert not logged(requests.ClientDisconnect())
    assert logged(ZeroDivisionError())
    assert server._is_ours(logging.LogRecord("uvicorn.error", 40, "", 1, "x", (), None))


def test_jobs_are_done_by_the_one_that_works():
    turns, found = MainThread(), []

    def fail(error):
        raise error

    def ask():
        found.append(turns.call(lambda a, b: (a + b, threading.get_ident()), 2, 3))
        for error in (UserError("no picture"), ZeroDivisionError("ours"), KeyboardInterrupt()):
            try:
                turns.call(fail, error)
            except Exception as caught:
                found.append(str(caught))

    thread = threading.Thread(target=ask)
    thread.start()
    with pytest.raises(KeyboardInterrupt):
        turns.work()
    thread.join(timeout=10)
    assert found == [
        (5, threading.get_ident()),
        "no picture",
        "ours",
        "gamba app was ended; start it again",
    ]


def test_who_waits_does_not_wait_for_ever():
    """Ctrl-C comes during one job; others stand behind it, and one comes later."""
    turns, ended = MainThread(), []

    def wait(function):
        try:
            turns.call(function)
        except UserError:
            ended.append(function.__name__)

    def interrupt():
        deadline = time.monotonic() + 10
        while turns._jobs.qsize() < 2 and time.monotonic() < deadline:
            time.sleep(0.001)
        raise KeyboardInterrupt

    threads = [threading.Thread(target=wait, args=[f]) for f in (interrupt, print, print)]
    for thread in threads:
        thread.start()
        time.sleep(0.02)
    with pytest.raises(KeyboardInterrupt):
        turns.work()
    wait(print)
    for thread in threads:
        thread.join(timeout=10)
    assert sorted(ended) == ["interrupt", "print", "print", "print"]
