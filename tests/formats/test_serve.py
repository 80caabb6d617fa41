"""The local server of one page: clients that stall, and too many of them."""

import socket
import threading
import time
import urllib.request
from collections.abc import Iterator

import pytest

from gamba_warp.pages import serve


@pytest.fixture
def address(monkeypatch) -> Iterator[tuple[str, int]]:
    monkeypatch.setattr(serve, "_READ_SECONDS", 0.4)
    monkeypatch.setattr(serve, "_CONNECTIONS", 3)
    server = serve.page_server(b"hello" * 100_000, 0)
    threading.Thread(target=server.serve_forever, args=[0.02], daemon=True).start()
    yield "127.0.0.1", server.server_port
    server.shutdown()
    server.server_close()


def read(address) -> bytes:
    with urllib.request.urlopen(f"http://{address[0]}:{address[1]}/", timeout=5) as answer:
        return answer.read()


def test_it_serves_this_machine_only():
    with serve.page_server(b"", 0) as server:
        assert server.server_address[0] == "127.0.0.1"


def test_it_serves_while_clients_stall(address):
    with socket.create_connection(address), socket.create_connection(address) as half:
        half.sendall(b"GET / HT")
        assert read(address) == b"hello" * 100_000


@pytest.mark.parametrize(
    "letters", ["", "GET / HTTP/1.1\r\nX-A: bbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbb"]
)
def test_a_client_that_dawdles_is_left(address, letters):
    with socket.create_connection(address) as client:
        started = time.monotonic()
        client.settimeout(3)
        try:
            for letter in letters:  # one at a time, each well within the limit of a read
                client.sendall(letter.encode())
                time.sleep(0.05)
            assert client.recv(1) == b""
        except (BrokenPipeError, ConnectionResetError):
            pass
        assert time.monotonic() - started < 2.5


def test_connections_are_bounded_and_come_back(address):
    held = [socket.create_connection(address) for _ in range(3)]
    time.sleep(0.1)
    with socket.create_connection(address) as further:
        further.settimeout(2)
        assert further.recv(1) == b""  # closed at the door
    for client in held:
        client.close()
    time.sleep(0.2)
    assert read(address).startswith(b"hello")
