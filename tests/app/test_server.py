"""Requests, leftover files and threads of the page's server."""

import asyncio
import contextlib
import hashlib
import json
import logging
import os
import signal
import threading
import time
from pathlib import Path

import pytest
from helpers.app import FORM, form
from helpers.refusals import refused

from gamba_warp.app import guard, main_thread, server, visitor_files
from gamba_warp.app.main_thread import MainThread
from gamba_warp.app.visitor_files import VisitorFiles
from gamba_warp.errors import UserError


def headers_of(token, length, host="localhost"):
    """Headers of an upload."""
    said = {"host": host, "content-type": FORM["Content-Type"], "content-length": str(length)}
    said["cookie"] = token and f"gamba-visitor={token}"
    return [(name.encode(), value.encode()) for name, value in said.items() if value is not None]


def answered(host, kind="http", path="/", method="GET", files=None, body=b"", token=None, more=()):
    """Return the guard's messages for a request, and the scopes that it passes on."""
    sent, inside = [], []

    async def app(scope, receive, send):
        inside.append(scope)
        answer = [(b"a", b"b"), (b"cookie", b"as gradio repeats it")]
        await send({"type": "http.response.start", "status": 200, "headers": answer})
        await send({"type": "http.response.body", "body": b""})

    async def receive():
        return {"type": "http.request", "body": body}

    async def send(message):
        sent.append(message)

    headers = [*more, *headers_of(token, len(body), host)]
    place, _, asked = path.partition("?")
    scope = {"type": kind, "headers": headers, "path": place, "method": method}
    scope["query_string"] = asked.encode()
    layer = guard.Guard(app, files or VisitorFiles(Path("unused")), {}, 1 << 20)
    asyncio.run(layer(scope, receive, send))
    return sent, inside


def visitor_of(token):
    """The name of a visitor's folder."""
    return hashlib.sha256(token.encode()).hexdigest()[:32]


@pytest.mark.parametrize("host", ["127.0.0.1:7860", "localhost:1", "127.0.0.1", "localhost"])
def test_our_own_names_are_let_in(host):
    sent, inside = answered(host)
    assert inside and sent[0]["status"] == 200
    headers = dict(sent[0]["headers"])
    assert headers[b"a"] == b"b" and b"cookie" not in headers, "a script could read it"


@pytest.mark.parametrize("host", ["localhost", "evil.example"])
def test_every_answer_tells_the_browser_what_it_may_load(host):
    headers = dict(answered(host)[0][0]["headers"])
    policy = headers[b"content-security-policy"].decode()
    assert "http" not in policy and "*" not in policy
    told = dict(part.strip().split(" ", 1) for part in policy.split(";"))
    for name in ("default-src", "base-uri", "form-action", "frame-ancestors"):
        assert told[name] == "'self'", name
    assert told["object-src"] == "'none'"
    assert headers[b"referrer-policy"] == b"no-referrer"
    assert headers[b"x-content-type-options"] == b"nosniff"


@pytest.mark.parametrize("name", ["host", "origin", "sec-fetch-site", "sec-fetch-mode"])
def test_what_a_browser_says_it_says_once(name):
    said = {"host": "localhost", "origin": "http://localhost", "sec-fetch-site": "same-origin"}
    value = said.get(name, "cors").encode()
    once = [(name.encode(), value)] if name != "host" else []
    assert answered("localhost", more=once)[1]
    for second in (value, b"evil.example"):
        for pair in ([value, second], [second, value]):
            more = [(name.encode(), v) for v in pair]
            sent, inside = answered(None if name == "host" else "localhost", more=more)
            assert not inside and sent[0]["status"] == 421, pair


@pytest.mark.parametrize("place", ["heartbeat/abc", "queue/data?session_hash=abc"])
def test_a_session_is_told_apart_by_its_visitor(place):
    """When a heartbeat ends, gradio drops the state of that visitor's session only."""
    path = f"/gradio_api/{place}"
    for token in ("a" * 32, "b" * 32):
        [scope] = answered("localhost", path=path, token=token)[1]
        got = f"{scope['path']}?{scope['query_string'].decode()}"
        assert scope["gamba.page"] == f"abc{visitor_of(token)}"
        assert got.rstrip("?") == path + visitor_of(token)
    sent, inside = answered("localhost", path=path)
    assert not inside and sent[0]["status"] == 403


@pytest.mark.parametrize(
    "values",
    [
        *(["bytes=0-1,2-3"], ["bytes=0-1-2"], ["bytes=-"], ["bytes="], ["items=0-1"], ["0-1"]),
        *(["bytes=\xb2-\xb3"], ["bytes=0-" + "9" * 5000], ["bytes=0-1"] * 2),
    ],
)
def test_other_ranges_are_ignored(values):
    more = [(b"range", value.encode("latin-1")) for value in values]
    [scope] = answered("localhost", path="/theme.css", more=more)[1]
    assert not [name for name, _ in scope["headers"] if name == b"range"]


@pytest.mark.parametrize("more", [(b"content-length", b"5"), (b"transfer-encoding", b"chunked")])
def test_who_only_asks_sends_no_body(more):
    sent, inside = answered("localhost", more=[more])
    assert not inside and sent[0]["status"] == 400


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
    """A megabyte each; the oldest are removed."""
    files, paths = VisitorFiles(tmp_path, limit=4 << 20), []
    for k in range(9):
        body = form(bytes([k]) * (1 << 20))
        request = {"path": "/gradio_api/upload", "method": "POST", "body": body}
        sent, _ = answered("localhost", files=files, token="a" * 32, **request)
        assert sent[0]["status"] == 200
        paths.append(Path(json.loads(sent[1]["body"])[0]))
        os.utime(paths[-1], (time.time() - 100 + k,) * 2)
        kept = [path for path in tmp_path.rglob("*") if path.is_file()]
        assert sum(path.stat().st_size for path in kept) <= files.limit
    assert [path.is_file() for path in paths] == [False] * 5 + [True] * 4
    assert not paths[0].parent.exists()


def kept_file(files, visitor, size=1000):
    path = files.new_folder(visitor, size) / "image.png"
    path.write_bytes(bytes(size))
    return path


def test_files_of_who_is_here_stay(tmp_path):
    """Files of inactive visitors are removed first; without any, a new file is refused."""
    files = VisitorFiles(tmp_path, limit=3000)
    with files.visited("a"):
        first, left, last = (kept_file(files, visitor) for visitor in "aba")
        for path, age in ((first, 90), (left, 50), (last, 9)):
            os.utime(path, (time.time() - age,) * 2)
        newer = kept_file(files, "c")
        assert first.is_file() and last.is_file() and not left.exists(), "though it was newer"
        with files.visited("c"), pytest.raises(UserError, match="leave no room"):
            files.new_folder("d", 1000)
        assert newer.is_file() and not (tmp_path / "d").exists()
        os.utime(first, (time.time() - visitor_files.KEEP_SECONDS - 9,) * 2)
        files.sweep()
        assert first.is_file(), "the page is open"
    files.sweep()
    assert not first.exists() and last.is_file() and newer.is_file()


def test_a_visitor_displaces_its_own_files_alone(tmp_path):
    files = VisitorFiles(tmp_path, limit=9000, per_visitor=2000)
    other = kept_file(files, "b")
    os.utime(other, (1 << 30,) * 2)
    os.utime(other, (time.time() - 99,) * 2)
    mine = [kept_file(files, "a") for _ in range(4)]
    assert [path.is_file() for path in (other, *mine)] == [True, False, False, True, True]


def dawdled(files, uploads, seconds=0.3):
    """Return statuses of stalled simultaneous uploads (token, bytes received), and the guard."""
    sent = [[] for _ in uploads]
    layer = guard.Guard(None, files, {}, 1 << 20)

    async def ask(k, token, content):
        for _ in range(50 * k):  # one after the other
            await asyncio.sleep(0)
        pieces = [content[at : at + 65536] for at in range(0, len(content), 65536)]

        async def receive():
            if not pieces:
                await asyncio.sleep(60)
            await asyncio.sleep(0)
            return {"type": "http.request", "body": pieces.pop(0), "more_body": True}

        async def send(message):
            sent[k].append(message.get("status"))

        scope = {"type": "http", "method": "POST", "path": "/gradio_api/upload"}
        await layer({**scope, "headers": headers_of(token * 32, 1 << 20)}, receive, send)

    async def come():
        tasks = [asyncio.create_task(ask(k, *upload)) for k, upload in enumerate(uploads)]
        await asyncio.wait(tasks, timeout=seconds)
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)

    asyncio.run(come())
    return [statuses[0] if statuses else None for statuses in sent], layer


def test_what_is_stated_takes_no_room(tmp_path):
    """A visitor announces a megabyte sixteen times; files and page of another stay."""
    files = VisitorFiles(tmp_path, limit=3 << 20)
    other = kept_file(files, visitor_of("b" * 32))
    empty = form(b"")[:-20]
    assert dawdled(files, [("a", empty)] * 16 + [("b", empty)])[0] == [None] * 17
    assert other.is_file()


def test_what_has_come_in_is_bounded(tmp_path):
    """Limit uploads per visitor and in total; an ended upload frees its fraction."""
    content = form(bytes(500_000))[:-20]
    statuses, layer = dawdled(
        VisitorFiles(tmp_path, per_visitor=700_000), [("a", content), ("a", content)]
    )
    assert sorted(statuses, key=str) == [503, None] and not layer._incoming
    each = [(token, content) for token in "abc"]
    statuses, layer = dawdled(VisitorFiles(tmp_path, limit=1_200_000), each)
    assert sorted(statuses, key=str) == [503, None, None] and not layer._incoming


def test_requests_of_one_visitor_are_bounded(tmp_path):
    empty = form(b"")[:-20]
    files = VisitorFiles(tmp_path)
    assert dawdled(files, [("a", empty)] * 17 + [("b", empty)])[0] == [None] * 16 + [503, None]


@pytest.mark.parametrize("name", ["_CALL_SECONDS", "UPLOAD_SECONDS"])
def test_a_body_that_does_not_come_is_refused(monkeypatch, name):
    monkeypatch.setattr(guard, name, 0.05)
    path = "/gradio_api/upload" if "UPLOAD" in name else "/gradio_api/queue/join"
    sent, start = [], [form(b"")[:-20]]

    async def receive():
        await asyncio.sleep(0.01)
        return {"type": "http.request", "body": start.pop() if start else b" ", "more_body": True}

    async def send(message):
        sent.append(message)

    scope = {"type": "http", "method": "POST", "path": path, "headers": headers_of("a" * 32, 9999)}
    layer = guard.Guard(None, VisitorFiles(Path("unused")), {}, 1 << 20)
    asyncio.run(asyncio.wait_for(layer(scope, receive, send), 10))
    assert sent[0]["status"] == 408 and b"took too long" in sent[1]["body"]


def test_old_files_go_by_themselves(tmp_path, monkeypatch):
    monkeypatch.setattr(guard, "KEEP_SECONDS", 0.06)
    monkeypatch.setattr(visitor_files, "KEEP_SECONDS", 0.06)
    files = VisitorFiles(tmp_path)
    path = files.new_folder("a") / "image.png"
    path.write_bytes(b"x")

    async def lives(scope, receive, send):
        await asyncio.sleep(0.3)

    assert path.exists()
    asyncio.run(guard.Guard(lives, files, {}, 1)({"type": "lifespan"}, None, None))
    assert not path.exists() and not path.parent.exists()


def test_nothing_of_the_environment_opens_the_server(monkeypatch, tmp_path):
    for name in ("GRADIO_SHARE", "GRADIO_NUM_WORKERS", "GRADIO_ROOT_PATH", "GRADIO_ANYTHING"):
        monkeypatch.setenv(name, "7")
    monkeypatch.setattr(os, "environ", dict(os.environ))
    server.configure_gradio(tmp_path)
    ours = {name: value for name, value in os.environ.items() if name.startswith("GRADIO_")}
    assert ours.pop("GRADIO_TEMP_DIR") == str(tmp_path)
    assert set(ours.values()) == {"False"}


@pytest.fixture
def temporary(tmp_path, monkeypatch):
    """Folder for temporary files, shared by all users."""
    folder = tmp_path / "tmp"
    folder.mkdir()
    monkeypatch.setattr(server.tempfile, "tempdir", str(folder))
    return folder


def left_folder(path, mode=0o700):
    """Folder of a killed process."""
    path.mkdir()
    path.chmod(mode)
    (path / "image.png").write_bytes(b"x")
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
    """Links in place of a folder or its lock, with any version of filelock."""
    home = left_folder(tmp_path / "home")
    (temporary / f"{server.PREFIX}folder").symlink_to(home)
    left = left_folder(temporary / f"{server.PREFIX}lock")
    (left / ".lock").unlink()
    (left / ".lock").symlink_to(home / "image.png")
    with server.work_folder():
        assert (home / ".lock").exists() and left.exists()
    assert (home / "image.png").read_bytes() == b"x"


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
    with server.listener(0) as taken:
        host, port = taken.getsockname()
        assert host == "127.0.0.1" and 0 < port < 65536
        refused(f"--port {port}: Address already in use", server.listener, port)
    server.listener(port).close()


def test_a_defect_is_logged_once_and_a_browser_that_leaves_is_none():
    new = server.NewErrors()

    def logged(kind):
        try:
            raise kind
        except Exception as error:
            info = (type(error), error, error.__traceback__)
        return new.filter(logging.LogRecord("uvicorn.error", 40, "", 1, "x", (), info))

    requests = pytest.importorskip("starlette.requests", reason="needs gradio")
    assert not logged(requests.ClientDisconnect())
    assert [logged(ZeroDivisionError()) for _ in range(3)] == [True, False, False]
    assert logged(OSError()), "another defect of the same line"
    assert new.filter(logging.LogRecord("uvicorn.error", 40, "", 1, "x", (), None))


def test_jobs_are_done_by_the_one_that_works():
    main_thread, found = MainThread(), []

    def fail(error):
        raise error

    def ask():
        found.append(main_thread.call(lambda a, b: (a + b, threading.get_ident()), 2, 3))
        for error in (UserError("no image"), ZeroDivisionError("ours"), KeyboardInterrupt()):
            try:
                main_thread.call(fail, error)
            except Exception as caught:
                found.append(str(caught))

    thread = threading.Thread(target=ask)
    thread.start()
    with pytest.raises(KeyboardInterrupt):
        main_thread.work()
    thread.join(timeout=10)
    assert found == [
        (5, threading.get_ident()),
        "no image",
        "ours",
        "gamba app has stopped; restart it",
    ]


def test_a_job_that_nobody_wants_is_ended(monkeypatch):
    """The end comes between two steps, but not within an import or the load of kernels."""
    monkeypatch.setattr(main_thread, "LOOK_SECONDS", 0.05)
    jobs, found = MainThread(), []

    def steps(count):
        for _ in range(count):
            time.sleep(0.01)
        return count

    def load():
        return steps(40)

    def ask():
        try:
            jobs.call(steps, 10**6, wanted=lambda: False)
        except UserError as error:
            found.append(str(error))
        found.append(jobs.call(load, wanted=lambda: False))
        found.append(jobs.call(steps, 40, wanted=lambda: True))
        with contextlib.suppress(UserError):
            jobs.call(signal.raise_signal, signal.SIGINT)

    thread = threading.Thread(target=ask, daemon=True)
    thread.start()
    with pytest.raises(KeyboardInterrupt):
        jobs.work()
    thread.join(timeout=10)
    assert found == ["it was cancelled, or its page was closed", 40, 40]


def test_who_waits_does_not_wait_for_ever():
    """Ctrl-C during one job, with others queued, and one that comes later."""
    main_thread, ended = MainThread(), []

    def wait(function):
        try:
            main_thread.call(function)
        except UserError:
            ended.append(function.__name__)

    def interrupt():
        deadline = time.monotonic() + 10
        while main_thread._jobs.qsize() < 2 and time.monotonic() < deadline:
            time.sleep(0.001)
        raise KeyboardInterrupt

    threads = [threading.Thread(target=wait, args=[f]) for f in (interrupt, print, print)]
    for thread in threads:
        thread.start()
        time.sleep(0.02)
    with pytest.raises(KeyboardInterrupt):
        main_thread.work()
    wait(print)
    for thread in threads:
        thread.join(timeout=10)
    assert sorted(ended) == ["interrupt", "print", "print", "print"]
