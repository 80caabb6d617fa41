"""What the page's server lets in, leaves behind, and computes on."""

import asyncio
import logging
import os
import threading
import time

import pytest

from gamba_warp.app import guard, server
from gamba_warp.app.turns import MainThread
from gamba_warp.errors import UserError


def answered(host, kind="http"):
    """What the guard answers to a request for a host: the messages, and whether it let it in."""
    sent, inside = [], []

    async def app(scope, receive, send):
        inside.append(scope["type"])
        await send({"type": "http.response.start", "status": 200, "headers": [(b"a", b"b")]})
        await send({"type": "http.response.body", "body": b""})

    async def send(message):
        sent.append(message)

    headers = [] if host is None else [(b"host", host.encode())]
    asyncio.run(guard.Guard(app)({"type": kind, "headers": headers}, None, send))
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
    "host", ["evil.example", "evil.example:7860", "127.0.0.1.evil.example:80", "", None, "[::1]:80"]
)
def test_other_names_are_refused(host):
    sent, inside = answered(host)
    assert not inside and sent[0]["status"] == 421
    sent, inside = answered(host, "websocket")
    assert not inside and sent == [{"type": "websocket.close", "code": 1008}]


def test_the_folder_goes_and_so_do_those_of_the_killed(tmp_path, monkeypatch):
    monkeypatch.setattr(server.tempfile, "gettempdir", lambda: str(tmp_path))
    monkeypatch.setattr(server.tempfile, "tempdir", str(tmp_path))
    killed, foreign = tmp_path / f"{server.PREFIX}killed", tmp_path / f"{server.PREFIX}foreign"
    for folder in (killed, foreign):
        folder.mkdir()
        (folder / "picture.png").write_bytes(b"x")
    (killed / ".lock").write_text("1\n")
    with server.work_folder() as first:
        assert not killed.exists() and foreign.exists(), "without our lock it may be anybody's"
        (first / "sub").mkdir()
        with server.work_folder() as second:
            assert first.exists() and second != first, "another that runs keeps its own"
        assert not second.exists()
    assert [p.name for p in tmp_path.iterdir()] == [foreign.name]


def test_a_link_is_not_followed(tmp_path, monkeypatch):
    monkeypatch.setattr(server.tempfile, "gettempdir", lambda: str(tmp_path / "tmp"))
    monkeypatch.setattr(server.tempfile, "tempdir", str(tmp_path / "tmp"))
    (tmp_path / "tmp").mkdir()
    home = tmp_path / "home"
    home.mkdir()
    (home / ".lock").touch()
    os.symlink(home, tmp_path / "tmp" / f"{server.PREFIX}link")
    with server.work_folder():
        assert home.exists()


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
