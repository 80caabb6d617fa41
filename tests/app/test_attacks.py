"""Attacks on ``gamba app`` by local programs and foreign web pages, as raw requests."""

import base64
import html
import re
import signal
import socket
import time
from pathlib import Path

import numpy as np
import pytest
from helpers.app import FORM, MEGABYTES, Program, form, serving
from helpers.images import bytes_of
from PIL import Image

from gamba_warp.app.cutting import examples
from gamba_warp.app.work import KINDS

TAKE, EXAMPLE, MEND, MAKE = 0, 2, 4, 6  # numbers of functions
CHOOSE = 8
ZIP = CHOOSE + 1 + 2 * list(KINDS).index("zip")
AREAS = CHOOSE + 1 + 2 * len(KINDS)  # after the two functions of each kind of file
EDIT = AREAS + 2
READ = ["", "theme.css", "gradio_api/file=/etc/passwd", "gradio_api/queue/data?session_hash=abc"]
ACT = ["gradio_api/upload", "gradio_api/queue/join", "gradio_api/run/predict"]


@pytest.fixture(scope="module")
def served(tmp_path_factory):
    pytest.importorskip("gradio", reason="needs gradio: pip install '.[app]'")
    with serving(tmp_path_factory.mktemp("tmp")) as made:
        yield made
        made.process.send_signal(signal.SIGINT)
        _, err = made.process.communicate(timeout=30)
        assert err == "gamba: interrupted\n", "no attack of this file leaves more than that"


@pytest.fixture
def program(served):
    return Program(served.host).opened(served.address)


@pytest.fixture
def private(tmp_path):
    """An image of the user, outside the app's folder."""
    path = tmp_path / "private.png"
    path.write_bytes(bytes_of(Image.new("RGB", (60, 60), "white")))
    return path


def given(path):
    return {"path": str(path), "orig_name": "a.png", "meta": {"_type": "gradio.FileData"}}


def test_a_program_that_does_as_the_page_does(program, private):
    path = program.upload(private.read_bytes())
    output = program.result(TAKE, [given(path)])
    note = output["data"][3]
    assert "No object was found" in note
    shown = output["data"][2]["value"]["background"]["path"]
    assert program.ask(f"/gradio_api/file={shown}").status == 200
    layer = Image.new("RGBA", (720, 720), (0, 0, 255, 255))
    painted = {"layers": [given(program.upload(bytes_of(layer)))]}
    _, editor, note, _ = program.result(MEND, [None, painted])["data"]
    assert "edited" in note and "touches the image" in note
    after = editor["value"]["background"]["path"]
    assert Path(after).read_bytes() != Path(shown).read_bytes()


def test_enclosed_areas_are_filled_and_cleared(program):
    pixels = np.full((60, 60, 3), 255, np.uint8)
    pixels[10:50, 10:50] = 200, 30, 20
    pixels[20:40, 20:40] = 255
    output = program.result(TAKE, [given(program.upload(bytes_of(Image.fromarray(pixels))))])
    assert "1 enclosed area" in output["data"][3]
    shown = [output["data"][2], *(program.result(AREAS, [None])["data"][1] for _ in range(2))]
    paths = [editor["value"]["background"]["path"] for editor in shown]
    first, filled, cleared = (np.asarray(Image.open(path))[360, 360] for path in paths)
    assert filled.min() == 255 > first.max() and (first == cleared).all()


def made_square(program):
    """Make an object; return its key, and the number of Gaussians that the viewer has."""
    image = Image.new("RGB", (200, 200), "white")
    image.paste((200, 30, 20), (50, 50, 150, 150))
    program.result(TAKE, [given(program.upload(bytes_of(image)))])
    page = str(program.result(MAKE, [None, None, None])["data"])
    edit = html.unescape(html.unescape(page[page.index("{&quot;title") :]))
    key = re.search(r'"key": "(\w+)"', edit)[1]
    return key, int(re.search(r'"count": (\d+)', edit)[1])


def test_an_edit_that_is_none_is_one_line(served, program):
    """Nothing changes, as the size of the next file shows."""
    key, count = made_square(program)
    size = -(-count // 8)
    one, more = bytes([1]) + bytes(size - 1), bytes(size - 1) + b"\xff"
    full = bytes([255]) * (count // 8) + (bytes([2 ** (count % 8) - 1]) if count % 8 else b"")

    def written():
        first = EDIT - 2 - 2 * len(KINDS)
        output = program.result(first, [None, "10,000 faces", "No texture", False])
        return Path(output["data"][0]["value"][0]["path"]).stat().st_size

    before, good = written(), {"key": key, "elevation": 0, "removed": ""}
    for told in (
        *({**good, "removed": text} for text in ("%%%", "AAA", 7, None, ["AA=="])),
        *({"key": key}, {"removed": ""}, "AA==", None),
        *({**good, "elevation": 91}, {**good, "elevation": "up"}),
    ):
        error = program.result(EDIT, [told, None, None])["error"]
        assert error.startswith("the edit: ") and "\n" not in error, told

    def removing(bits):
        return [{**good, "removed": base64.b64encode(bits).decode()}, None, None]

    for bits in (b"", one[:-1], one + b"\0", *([more] if count % 8 else [])):
        said = program.result(EDIT, removing(bits))["error"]
        assert said == "the removed parts are not those of this object"
    assert program.result(EDIT, removing(full))["error"] == "this removes all Gaussians"
    assert written() == before
    data = removing(one)
    other = Program(served.host, dict(program.headers))  # another page of the same browser
    made_square(other)
    assert other.result(EDIT, data)["error"] == "this result has expired"
    assert written() == before
    assert "data" in program.result(EDIT, data) and written() < before


def test_without_the_token_nothing_is_answered(served, program, private):
    """Other programs of this machine, with no cookie, a wrong one, or another server's."""
    path = program.upload(private.read_bytes())
    name, _, token = program.headers["Cookie"].partition("=")
    before = sorted(served.temporary.rglob("*"))
    for cookie in ("", f"{name}=", f"{name}={token[:-1]}", f"{name}=é", f"gamba-1={token}"):
        bare = Program(served.host, {"Cookie": cookie})
        for route in (*READ, f"gradio_api/file={path}", "?token=", "?token=x", "theme.css?token="):
            assert bare.ask(f"/{route}").status == 403, (cookie, route)
        assert bare.ask(f"/theme.css?token={token}").status == 403
        for route in ACT:
            answer = bare.ask(f"/{route}", form(b"x"), **FORM)
            assert answer.status == 403 and b"has printed" in answer.body, (cookie, route)
    assert sorted(served.temporary.rglob("*")) == before, "nothing of it is kept"


def test_only_files_of_the_page_are_shown(program, private):
    path = program.upload(private.read_bytes())
    assert program.ask(f"/gradio_api/file={path}").body == private.read_bytes()
    for asked in (private, "/etc/passwd", "/etc", "/none", Path(__file__).resolve()):
        assert program.ask(f"/gradio_api/file={asked}").status in (403, 404), asked
    (example, _), *_ = examples()
    assert program.ask(f"/gradio_api/file={example}").status == 200


@pytest.mark.parametrize(
    "content, reason",
    [
        (bytes_of(Image.new("1", (9000, 9000))), "9000x9000 is over 4 megapixels"),
        (bytes_of(Image.new("RGB", (50, 50)), "EPS"), "not an image that can be read"),
        (bytes_of(Image.new("RGB", (50, 50)), "TIFF"), "not an image that can be read"),
        (bytes_of(Image.new("RGB", (500, 50)))[:70], "cannot be decoded"),
        (b"", "the file is empty"),
    ],
    ids=range(5),
)
def test_strokes_go_through_our_reader(program, private, content, reason):
    assert "data" in program.result(TAKE, [given(program.upload(private.read_bytes()))])
    painted = {"layers": [given(program.upload(content))]}
    output = program.result(MEND, [None, painted])
    assert output["error"].startswith("the strokes: ") and reason in output["error"]


@pytest.mark.parametrize(
    "headers",
    [
        {"Host": "evil.example"},
        {"Host": "127.0.0.1:80@evil.example"},
        {"Origin": "null"},
        {"Origin": "http://127.0.0.1:1"},
        {"Origin": "https://{host}"},
        {"Sec_Fetch_Site": "cross-site"},
        {"Sec_Fetch_Site": "same-site", "Sec_Fetch_Mode": "cors"},
        {"Origin": "null", "Sec_Fetch_Site": "cross-site", "Sec_Fetch_Mode": "navigate"},
    ],
    ids=range(8),
)
def test_foreign_pages_get_nothing(served, program, headers):
    """Refuse forms, requests of scripts, and names that resolve to 127.0.0.1."""
    headers = {name: value.format(host=served.host) for name, value in headers.items()}
    before = sorted(served.temporary.rglob("*"))
    for route in (*READ, served.address.partition("/?")[2]):
        assert program.ask(f"/{route}", **headers).status == 421, route
    for route in ACT:
        assert program.ask(f"/{route}", form(b"x"), **FORM, **headers).status == 421, route
    assert sorted(served.temporary.rglob("*")) == before, "nothing of it is kept"


def test_our_own_pages_and_links_to_them_are_let_in(served, program):
    name = f"localhost:{served.host.rpartition(':')[2]}"
    for headers in (
        {"Origin": f"http://{served.host}", "Sec_Fetch_Site": "same-origin"},
        {"Host": name, "Origin": f"http://{name}"},
        {"Sec_Fetch_Site": "none"},
        {"Sec_Fetch_Site": "cross-site", "Sec_Fetch_Mode": "navigate"},
    ):
        assert program.ask("/", **headers).status == 200, headers


def raw(served, *lines):
    """The connection, and the status of a request of these lines."""
    host, port = served.host.split(":")
    link = socket.create_connection((host, int(port)), timeout=30)
    link.sendall("\r\n".join([*lines, "", ""]).encode("latin-1"))
    answer = link.makefile("rb")
    return answer, int(answer.readline().split()[1])


def test_what_is_not_http_is_not_answered(served, program):
    """The fixture of this file sees that the command prints nothing."""
    for line in ("nothing", "GET /\0 HTTP/1.1", "GET / HTTP/1.1\r\nA b"):
        assert raw(served, line, f"Host: {served.host}")[1] == 400


def test_the_job_of_a_closed_page_ends(served, program, private):
    """The next page does not wait until all files of the closed one are written."""
    made_square(program)
    assert program.join(ZIP, [None, "200,000 faces", "Texture 2048", True]).status == 200
    cookie, host = f"Cookie: {program.headers['Cookie']}", f"Host: {served.host}"
    session = program.session
    places = f"heartbeat/{session}", f"queue/data?session_hash={session}"
    answers = [raw(served, f"GET /gradio_api/{p} HTTP/1.1", host, cookie)[0] for p in places]
    assert b"process_starts" in next(line for line in answers[1] if b"process_" in line)
    time.sleep(3)  # it is in the middle
    for answer in answers:
        answer.close()
    other = Program(served.host, dict(program.headers))
    started = time.monotonic()
    assert "data" in other.result(TAKE, [given(other.upload(private.read_bytes()))])
    assert time.monotonic() - started < 20


@pytest.mark.parametrize("index", [-1, 10**6, 1.0, "0", None, [0, 1], True, {"a": 1}])
def test_no_such_example_is_one_line(program, index):
    output = program.result(EXAMPLE, [], event_data={"index": index, "value": 1})
    assert "not one of the" in output["error"]


@pytest.mark.parametrize("index", [-1, 1, 1.0, "0", None, True])
def test_no_such_result_is_one_line(program, index):
    output = program.result(CHOOSE, [None], event_data={"index": index, "value": 1})
    assert output["error"] == "this result has expired"


def test_uploads_are_bounded(served, program):
    answer = program.ask("/gradio_api/upload", form(bytes((MEGABYTES << 20) + 1)), **FORM)
    assert answer.status == 413 and b"maximum allowed size" in answer.body
    # Warp keeps headers in a folder of its own while it compiles.
    files = (p for p in served.temporary.rglob("*") if not p.parent.name.startswith("wp_pch_"))
    assert not [p for p in files if p.is_file() and p.stat().st_size > MEGABYTES << 20]


def test_an_upload_stays_in_the_folder_of_the_page(served, program):
    for name in ("../../../evil.png", "/etc/evil.PNG", "a\\..\\evil.png", ".png"):
        path = Path(program.upload(b"x", name))
        assert path.resolve().is_relative_to(served.temporary)
