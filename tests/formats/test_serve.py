"""The local server of one page: clients that stall, and too many of them."""

import socket
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Iterator

import pytest

from gamba_warp.pages import serve
from gamba_warp.pages.serve import is_foreign


@pytest.fixture
def address(monkeypatch) -> Iterator[tuple[str, int]]:
    monkeypatch.setattr(serve, "READ_SECONDS", 0.4)
    monkeypatch.setattr(serve, "_CONNECTIONS", 3)
    server = serve.page_server(b"hello" * 100_000, 0)
    threading.Thread(target=server.serve_forever, args=[0.02], daemon=True).start()
    yield "127.0.0.1", server.server_port
    server.shutdown()
    server.server_close()


def read(address, path="") -> bytes:
    with urllib.request.urlopen(f"http://{address[0]}:{address[1]}/{path}", timeout=5) as answer:
        return answer.read()


def test_it_serves_this_machine_only():
    with serve.page_server(b"", 0) as server:
        assert server.server_address[0] == "127.0.0.1"


def test_it_serves_while_clients_stall(address):
    with socket.create_connection(address), socket.create_connection(address) as half:
        half.sendall(b"GET / HT")
        assert read(address) == b"hello" * 100_000
        with pytest.raises(urllib.error.HTTPError):
            read(address, "etc/passwd")


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


def status(address, *headers) -> int:
    """Of ``GET /`` with these headers and no others."""
    with socket.create_connection(address) as client:
        client.settimeout(5)
        client.sendall("\r\n".join(["GET / HTTP/1.1", *headers, "", ""]).encode())
        return int(client.makefile("rb").readline().split()[1])


@pytest.mark.parametrize(
    "headers",
    [
        [],
        ["Host: evil.example"],
        ["Host: evil.example:{port}"],
        ["Host: 127.0.0.1.evil.example:{port}"],
        ["Host: [::1]:{port}"],
        ["Host: 127.0.0.1:{port}", "Origin: http://evil.example"],
        ["Host: 127.0.0.1:{port}", "Origin: null"],
        ["host: localhost:{port}", "Sec-Fetch-Site: cross-site", "Sec-Fetch-Mode: no-cors"],
    ],
    ids=range(8),
)
def test_foreign_names_and_pages_are_refused(address, headers):
    """A foreign page can give its own name the address 127.0.0.1, and read what it is answered."""
    assert status(address, *(header.format(port=address[1]) for header in headers)) == 421


@pytest.mark.parametrize("host", ["127.0.0.1", "127.0.0.1:{port}", "localhost:9000"])
def test_its_own_names_and_links_to_it_are_answered(address, host):
    host = f"Host: {host.format(port=address[1])}"
    assert status(address, host) == 200
    followed = "Sec-Fetch-Site: cross-site", "Sec-Fetch-Mode: navigate"
    assert status(address, host, *followed) == 200


@pytest.mark.parametrize("method, foreign", [("GET", False), ("HEAD", False), ("POST", True)])
def test_a_form_of_another_page_is_refused(method, foreign):
    """A browser may send a form of another page without an Origin; a link only asks."""
    headers = {"Host": "127.0.0.1:9", "Sec-Fetch-Site": "cross-site", "Sec-Fetch-Mode": "navigate"}
    assert is_foreign(method, headers.items()) == foreign
    own = headers | {"Sec-Fetch-Site": "same-origin", "Origin": "http://127.0.0.1:9"}
    assert not is_foreign(method, own.items())
