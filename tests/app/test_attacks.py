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
from gamba_warp.app.guard import MAX_IMAGES
from gamba_warp.app.work import KINDS

TAKE, EXAMPLE, BRUSH, MEND, RESTART, MAKE = 0, 2, 3, 4, 5, 6  # numbers of functions
SEVERAL, CHOOSE = 7, 8
ZIP = CHOOSE + 1 + 2 * list(KINDS).index("zip")
AREAS = CHOOSE + 1 + 2 * len(KINDS)  # after the two functions of each kind of file
EDIT = AREAS + 2
ROUTES = ["", "theme.css", "gradio_api/file=/etc/passwd", "gradio_api/queue/data?session_hash=abc"]


@pytest.fixture(scope="module")
def served(tmp_path_factory):
    pytest.importorskip("gradio", reason="needs gradio: pip install '.[app]'")
    with serving(tmp_path_factory.mktemp("tmp")) as made:
        yield made
        made.process.send_signal(signal.SIGINT)
        _, err = made.process.communicate(timeout=30)
        assert err == "gamba: interrupted\n", "no attack of this file leaves more than that"


@pytest.fixture
def bare(served):
    return Program(served.host)


@pytest.fixture
def program(served):
    return Program(served.host).opened()


@pytest.fixture
def private(tmp_path):
    """An image of the user, outside the app's folder."""
    path = tmp_path / "private.png"
    path.write_bytes(bytes_of(Image.new("RGB", (60, 60), "white")))
    return path


def given(path, **more):
    return {"path": str(path), "orig_name": "a.png", **more}


def test_a_program_that_does_as_the_page_does(program, private):
    path = program.upload(private.read_bytes())
    output = program.result(TAKE, [given(path)])
    note = output["data"][3]
    assert "No object was found" in note
    shown = output["data"][2]["value"]["background"]["path"]
    assert program.ask(f"/gradio_api/file={shown}").status == 200
    layer = Image.new("RGBA", (720, 720), (0, 0, 255, 255))
    painted = {"layers": [given(program.upload(bytes_of(layer)))], "background": {"path": "/"}}
    _, editor, note, _ = program.result(MEND, [None, painted])["data"]
    assert "edited" in note and "touches the image" in note
    after = editor["value"]["background"]["path"]
    assert program.ask("/manifest.json").body == b"{}"  # the page links it
    assert Path(after).read_bytes() != Path(shown).read_bytes()


def test_enclosed_areas_are_filled_and_cleared(program):
    pixels = np.full((60, 60, 3), 255, np.uint8)
    pixels[10:50, 10:50] = 200, 30, 20
    pixels[20:40, 20:40] = 255
    output = program.result(TAKE, [given(program.upload(bytes_of(Image.fromarray(pixels))))])
    assert "1 enclosed area" in output["data"][3]
    shown = [output["data"][2]["value"]["background"]["path"]]
    shown += [
        program.result(AREAS, [None])["data"][1]["value"]["background"]["path"] for _ in range(2)
    ]
    first, filled, cleared = (np.asarray(Image.open(path))[360, 360] for path in shown)
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
        output = program.result(
            EDIT - 2 - 2 * len(KINDS), [None, "10,000 faces", "No texture", False]
        )
        return Path(output["data"][0]["value"][0]["path"]).stat().st_size

    before, good = written(), {"key": key, "elevation": 0, "removed": ""}
    for text in ("%%%", "AAA", "A" * 400_000, 7, None, ["AA=="]):
        answer = program.join(EDIT, [{**good, "removed": text}, None, None])
        assert answer.status == 400 and answer.line.startswith("the call: "), text
    for told in (
        *({"key": key}, {"removed": ""}, "AA==", None),
        *({**good, "key": "x" * 33}, {**good, "elevation": 91}, {**good, "elevation": "up"}),
    ):
        answer = program.join(EDIT, [told, None, None])
        assert answer.status == 400 and answer.line.startswith("the call: "), told
    told = {
        "the removed parts are not those of this object": [b"", one[:-1], one + b"\0"],
        "this removes all Gaussians": [full],
    }
    if count % 8:
        told["the removed parts are not those of this object"].append(more)
    for reason, all_removed in told.items():
        for removed in all_removed:
            data = [{**good, "removed": base64.b64encode(removed).decode()}, None, None]
            assert program.result(EDIT, data)["error"] == reason
    assert written() == before
    other = Program(served.host).opened()
    made_square(other)
    data = [{**good, "removed": base64.b64encode(one).decode()}, None, None]
    assert other.result(EDIT, data)["error"] == "this result has expired"
    assert written() == before
    assert "data" in program.result(EDIT, data) and written() < before


@pytest.mark.parametrize("meta", [None, {"_type": "gradio.FileData"}])
def test_only_files_of_the_visitor_are_taken(served, program, private, meta):
    """The answer does not reveal which files exist."""
    other = Program(served.host).opened()
    theirs, mine = other.upload(private.read_bytes()), program.upload(private.read_bytes())
    link = Path(mine).with_name("link.png")
    link.symlink_to(private)
    (example, _), *_ = examples()
    lines = {}
    for path in (
        *(private, private.with_name("none.png"), "/etc/passwd", "/dev/zero", "/", "", "a\0b"),
        *(theirs, link, example, Path(mine).parent, Path(mine).parents[1], "../" * 9 + mine),
        *(f"{Path(mine).parent}/../{Path(mine).parent.name}/a.png", f"/{mine}", "x" * 4000),
        *("http://127.0.0.1/", "file:///etc/passwd", next(served.temporary.iterdir()) / ".lock"),
    ):
        item = given(path, meta=meta)
        for number, data in (
            (TAKE, [item]),
            (MEND, [None, {"layers": [item]}]),
            (SEVERAL, [[item], None]),
        ):
            answer = program.join(number, data)
            lines[str(path), number] = answer.status, answer.line
    assert len(set(lines.values())) == 1, lines
    assert set(lines.values()) == {
        (400, "this file is missing or has expired; give the image again")
    }
    for item in (str(private), [given(private)], {"url": str(private)}, 1, {"a": given(private)}):
        for number, data in ((TAKE, [item]), (MEND, [None, item]), (MEND, [item, None])):
            assert program.join(number, data).status == 400, (number, data)


def test_a_session_is_that_of_its_visitor(served, program, private):
    """A page's image is not available to another that knows its session."""
    assert "data" in program.result(TAKE, [given(program.upload(private.read_bytes()))])
    assert "data" in program.result(RESTART, [None])
    other = Program(served.host, session=program.session).opened()
    assert other.result(RESTART, [None])["error"].startswith("give an image first")


def test_only_files_of_the_visitor_are_shown(served, program, private):
    other = Program(served.host).opened()
    path = other.upload(private.read_bytes())
    assert other.ask(f"/gradio_api/file={path}").body == private.read_bytes()
    asked = (path, private, "/etc/passwd", "/etc", "/none", Path(__file__).resolve(), "http://a/")
    answers = [program.ask(f"/gradio_api/file={asked}") for asked in asked]
    assert {answer.status for answer in answers} == {403}
    assert len({answer.line for answer in answers}) == 1
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


def test_more_layers_than_the_editor_has(program):
    painted = {"layers": [given(program.upload(b"x"))] * 5}
    assert program.join(MEND, [None, painted]).line.startswith("the call: Expected `array`")


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
    for route in ROUTES:
        assert program.ask(f"/{route}", **headers).status == 421, route
    for route in ("gradio_api/upload", "gradio_api/queue/join", "gradio_api/run/predict"):
        answer = program.ask(f"/{route}", form(b"x"), **FORM, **headers)
        assert answer.status == 421 and answer.line, route
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


def test_no_request_of_http_is_no_line_on_the_terminal(served):
    """The fixture of this file sees what the command says."""
    for line in ("nothing", "GET /\0 HTTP/1.1", "GET / HTTP/1.1\r\nA b"):
        assert raw(served, line, f"Host: {served.host}")[1] == 400
    upgrade = "Connection: Upgrade", "Upgrade: websocket", "Sec-WebSocket-Key: " + "a" * 22 + "=="
    assert raw(served, "GET / HTTP/1.1", f"Host: {served.host}", *upgrade)[1] == 200


def test_parts_of_a_file(program):
    file = f"/gradio_api/file={program.upload(b'0123456789')}"
    for value, part in (("0-1", b"01"), ("2-", b"23456789"), ("-3", b"789"), ("8-99", b"89")):
        answer = program.ask(file, Range=f"bytes={value}")
        assert (answer.status, answer.body) == (206, part), value
        assert "cookie" not in answer.headers
    assert program.ask(file, Range="bytes=10-").status == 416
    assert program.ask(file, Range="bytes=10-11").status == 416
    answer = program.ask(file, Range="bytes=0-1,2-3")
    assert (answer.status, answer.body) == (200, b"0123456789")
    example = f"/gradio_api/file={examples()[0][0]}"
    assert program.ask(example, Range="bytes=0-1,2-3").status == 200


def test_a_page_that_is_open_is_heard_of(served, program):
    cookie, host = f"Cookie: {program.headers['Cookie']}", f"Host: {served.host}"
    place = f"GET /gradio_api/heartbeat/{program.session} HTTP/1.1"
    assert raw(served, place, host)[1] == 403
    answer, status = raw(served, place, host, cookie)
    assert status == 200
    assert "data: ALIVE\n" in iter(lambda: answer.readline().decode(), "")


def test_the_job_of_a_closed_page_ends(served, program, private):
    """The next visitor does not wait until all files of the one who left are written."""
    image = Image.new("RGB", (200, 200), "white")
    image.paste((200, 30, 20), (50, 50, 150, 150))
    program.result(TAKE, [given(program.upload(bytes_of(image)))])
    assert "data" in program.result(MAKE, [None, None, None])
    assert program.join(ZIP, [None, "200,000 faces", "Texture 2048", True]).status == 200
    cookie, host = f"Cookie: {program.headers['Cookie']}", f"Host: {served.host}"
    place = f"GET /gradio_api/queue/data?session_hash={program.session} HTTP/1.1"
    answer, _ = raw(served, place, host, cookie)
    assert "process_starts" in next(
        line for line in map(bytes.decode, answer) if "process_" in line
    )
    time.sleep(3)  # it is in the middle
    answer.close()
    other = Program(served.host).opened()
    started = time.monotonic()
    assert "data" in other.result(TAKE, [given(other.upload(private.read_bytes()))])
    assert time.monotonic() - started < 20


def test_half_sent_requests_stop_nothing(served, program):
    """More connections than the limit; the page is still answered."""
    host, port = served.host.split(":")
    held = []
    for _ in range(3):
        for _ in range(60):
            held.append(socket.create_connection((host, int(port))))
            held[-1].sendall(b"GET / HTTP/1.1\r\n")
        assert program.ask("/").status == 200
    for link in held:
        link.close()


def test_forwarded_names_are_ignored(bare):
    for name in ("X_Forwarded_Host", "X_Forwarded_Server", "Forwarded", "X_Gradio_Server"):
        answer = bare.ask("/", **{name: "evil.example", "X_Forwarded_Proto": "https"})
        assert answer.status == 200
        assert b"evil.example" not in answer.body and b"https://127" not in answer.body


def test_what_is_closed(served, program):
    for route in (
        *("docs", "redoc", "openapi.json", "gradio_api/openapi.json", "gradio_api/info", "config"),
        *("monitoring", "monitoring/summary", "gradio_api/app_id", "gradio_api/proxy=http://a/"),
        *("gradio_api/file", "gradio_api/runs", "gradio_api/queue/status"),
        *("gradio_api/call/take/1", "gradio_api/vibe-code", "gradio_api/deep_link", "nothing"),
    ):
        answer = program.ask(f"/{route}")
        assert (answer.status, answer.line) == (404, "not found"), route
    for route in (
        *("run/predict", "api/take", "call/take", "call/v2/take", "cancel", "reset"),
        *("component_server", "component_server/", "process_recording", "vibe-edit", "stream/1"),
    ):
        assert program.ask(f"/gradio_api/{route}", b"{}").status == 404, route
    for method in ("PUT", "DELETE", "OPTIONS", "PATCH"):
        assert program.ask("/gradio_api/upload", b"x", method).status == 404
    for route in ("assets/../../../../../../etc/passwd", "static/%2e%2e/%2e%2e/__init__.py"):
        assert program.ask(f"/{route}").status in (403, 404), route
    # gradio would read a file by this name.
    assert program.ask("/?deep_link=../../../etc/passwd").status == 200


@pytest.mark.parametrize("number", [-1, CHOOSE + 2, 99, 1 << 70, 1.5, "0", None, [0]])
def test_no_such_function_is_one_line(program, number):
    answer = program.join(number, [None])
    assert answer.status == 400 and answer.line
    assert answer.headers["content-type"].startswith("application/json")


@pytest.mark.parametrize(
    "number, data",
    [
        *[(TAKE, []), (TAKE, [None, None]), (BRUSH, ["Paint it black"]), (BRUSH, [0])],
        *[(MAKE, [None] * 2), (MAKE, [None, 0, None])],
        *[(SEVERAL, [[{"path": "x"}] * (MAX_IMAGES + 1), None]), (SEVERAL, ["x", None])],
    ],
)
def test_other_inputs_are_one_line(program, number, data):
    answer = program.join(number, data)
    assert answer.status == 400 and answer.line


@pytest.mark.parametrize("index", [-1, 10**6, 1.0, "0", None, [0, 1], True, {"a": 1}])
def test_no_such_example_is_one_line(program, index):
    output = program.result(EXAMPLE, [], event_data={"index": index, "value": 1})
    assert "not one of the" in output["error"]


@pytest.mark.parametrize("index", [-1, 1, 1.0, "0", None, True])
def test_no_such_result_is_one_line(program, index):
    output = program.result(CHOOSE, [None], event_data={"index": index, "value": 1})
    assert output["error"] == "this result has expired"


@pytest.mark.parametrize(
    "body, status",
    [
        (b"", 400),
        (b"{", 400),
        (b"[" * 100_000, 400),
        (b'{"fn_index":0,"data":[' + b"[" * 500 + b"]" * 500 + b'],"session_hash":"a"}', 400),
        (b'{"fn_index":0,"data":[null],"session_hash":"../../a"}', 400),
        (b'{"fn_index":0,"data":[null]}', 400),
        (b'{"fn_index":0,"data":[null],"session_hash":null}', 400),
        (b" " * ((1 << 20) + 1), 413),
    ],
    ids=range(8),
)
def test_a_call_that_is_none_is_one_line(program, body, status):
    answer = program.ask("/gradio_api/queue/join", body)
    assert answer.status == status and answer.line


def test_uploads_are_bounded(served, program, bare):
    large = form(bytes((MEGABYTES << 20) + 1))
    huge = form(bytes((MEGABYTES << 20) + (1 << 17)))
    head = b'--edge\r\nContent-Disposition: form-data; name="files"; filename="a"\r\n\r\nx\r\n'
    field = b'--edge\r\nContent-Disposition: form-data; name="files"\r\n\r\nx\r\n--edge--\r\n'
    for body, headers, status in (
        (large, FORM, 413),
        (huge, FORM, 413),
        (form(b"x"), {}, 400),
        (b"nothing", FORM, 400),
        (head * (MAX_IMAGES + 1) + b"--edge--\r\n", FORM, 400),
        (field, FORM, 400),
        (iter([form(b"x")]), FORM, 411),
    ):
        answer = program.ask("/gradio_api/upload", body, **headers)
        assert answer.status == status and answer.line, (body[:80], status)
    answer = bare.ask("/gradio_api/upload", form(b"x"), **FORM)
    assert answer.status == 403 and "open the page first" in answer.line
    kept = [path for path in served.temporary.rglob("*") if path.is_file()]
    assert all(path.stat().st_size <= MEGABYTES << 20 for path in kept)


def test_the_name_of_an_upload_is_not_its_own(served, program):
    for name in ("../../../evil.png", "/etc/evil.PNG", "a\\..\\evil.png", "evil.html", ".png"):
        path = Path(program.upload(b"x", name))
        assert path.name in ("image.png", "image")
        assert path.is_relative_to(served.temporary)
    assert not [path for path in served.temporary.rglob("*") if "evil" in path.name]
