"""Connections of the app: too many, slow requests, and clients that do not read."""

import socket
import threading
import time
import urllib.request

import pytest

uvicorn = pytest.importorskip("uvicorn", reason="needs gradio: pip install '.[app]'")

from gamba_warp.app import connections  # noqa: E402
from gamba_warp.app.guard import is_foreign  # noqa: E402

LARGE = 32 << 20  # bytes; more than the system's buffers take


@pytest.fixture
def address(monkeypatch):
    """Server of a word, of many bytes, and of an endless stream."""
    monkeypatch.setattr(connections, "READ_SECONDS", 0.4)
    monkeypatch.setattr(connections, "CONNECTIONS", 3)

    async def app(scope, receive, send):
        await send({"type": "http.response.start", "status": 200, "headers": []})
        if scope["path"] == "/stream":
            await send({"type": "http.response.body", "body": b"x", "more_body": True})
            while (await receive())["type"] != "http.disconnect":
                pass
        content = bytes(LARGE) if scope["path"] == "/large" else b"hello"
        await send({"type": "http.response.body", "body": content})

    options = {"ws": "none", "lifespan": "off", "log_config": None, "timeout_keep_alive": 60}
    server = uvicorn.Server(uvicorn.Config(app, http=connections.Connection, **options))
    listening = socket.create_server(("127.0.0.1", 0))
    thread = threading.Thread(target=server.run, args=[[listening]], daemon=True)
    thread.start()
    yield listening.getsockname()
    server.should_exit = server.force_exit = True
    thread.join(timeout=10)
    assert not thread.is_alive()


def asked(address, path="", end="\r\n\r\n"):
    client = socket.create_connection(address, timeout=5)
    client.sendall(f"GET /{path} HTTP/1.1\r\nHost: a{end}".encode())
    return client


def closed(client, seconds=5.0):
    """Return whether the server closes a connection within a time; its answers are read."""
    client.settimeout(seconds)
    try:
        while client.recv(1 << 16):
            pass
    except ConnectionResetError:
        pass
    except TimeoutError:
        return False
    return True


def read(address):
    with urllib.request.urlopen("http://{}:{}/".format(*address), timeout=5) as answer:
        return answer.read()


def test_the_one_that_waited_longest_makes_room(address):
    held = []
    for _ in range(20):
        held.append(asked(address, end=""))
        time.sleep(0.005)
    assert read(address) == b"hello"
    assert all(closed(client, 0.2) for client in held[:17])


def test_who_asks_nothing_more_makes_room(address):
    idle = [asked(address) for _ in range(3)]
    assert all(client.recv(1) for client in idle)
    time.sleep(0.05)
    assert read(address) == b"hello"


def test_who_is_answered_makes_no_room(address):
    streams = [asked(address, "stream") for _ in range(3)]
    assert all(client.recv(1) for client in streams)
    assert closed(socket.create_connection(address))
    assert not closed(streams[0], 0.6), "a stream may stay"
    streams.pop().close()
    time.sleep(0.1)
    assert read(address) == b"hello"


@pytest.mark.parametrize("first", ["", "GET / HTTP/1.1\r\nHost: a\r\n\r\n"])
def test_a_request_that_dawdles_is_left(address, first):
    """The first one of a connection, and a second one."""
    with socket.create_connection(address) as client:
        started = time.monotonic()
        client.sendall(first.encode())
        with pytest.raises((BrokenPipeError, ConnectionResetError)):
            for letter in "GET / HTTP/1.1\r\nX-A: " + "b" * 200:
                client.sendall(letter.encode())
                time.sleep(0.02)
        assert 0.3 < time.monotonic() - started < 3


def test_who_takes_nothing_is_left(address):
    with asked(address, "large") as client:
        time.sleep(1.2)
        got = 0
        with pytest.raises(ConnectionResetError):
            while part := client.recv(1 << 20):
                got += len(part)
            raise ConnectionResetError
        assert got < LARGE


def test_who_takes_slowly_gets_all(address):
    """Takes longer than the time limit, which applies to each piece."""
    with asked(address, "large") as client:
        got, started = 0, time.monotonic()
        while part := client.recv(1 << 20):
            if got // (4 << 20) < (got := got + len(part)) // (4 << 20):
                time.sleep(0.2)
            if got >= LARGE:
                break
        assert got >= LARGE and time.monotonic() - started > 1


@pytest.mark.parametrize("method, foreign", [("GET", False), ("HEAD", False), ("POST", True)])
def test_a_form_of_another_page_is_refused(method, foreign):
    """A browser may send a form of another page without an Origin; a link only asks."""
    headers = {"Host": "127.0.0.1:9", "Sec-Fetch-Site": "cross-site", "Sec-Fetch-Mode": "navigate"}
    assert is_foreign(method, headers.items()) == foreign
    own = headers | {"Sec-Fetch-Site": "same-origin", "Origin": "http://127.0.0.1:9"}
    assert not is_foreign(method, own.items())
