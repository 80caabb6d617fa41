"""Requests, leftover files and threads of the page's server."""

import asyncio
import contextlib
import os
import signal
import threading
import time

import pytest
from helpers.refusals import refused

from gamba_warp.app import guard, main_thread, server
from gamba_warp.app.main_thread import MainThread
from gamba_warp.app.store import Store
from gamba_warp.errors import UserError

TOKEN = "a-token"


def answered(host, kind="http", path="/", cookie=f"gamba-1={TOKEN}", more=()):
    """Return the guard's messages for a request, and the scopes that it passes on."""
    sent, inside = [], []

    async def app(scope, receive, send):
        inside.append(scope)
        await send({"type": "http.response.start", "status": 200, "headers": [(b"a", b"b")]})
        await send({"type": "http.response.body", "body": b""})

    async def send(message):
        sent.append(message)

    said = {"host": host, "cookie": cookie}
    headers = [*more, *((k.encode(), v.encode()) for k, v in said.items() if v is not None)]
    place, _, asked = path.partition("?")
    scope = {"type": kind, "headers": headers, "path": place, "method": "GET"}
    scope["query_string"] = asked.encode()
    asyncio.run(guard.Guard(app, TOKEN, 1)(scope, None, send))
    return sent, inside


@pytest.mark.parametrize("host", ["127.0.0.1:7860", "localhost:1", "127.0.0.1", "localhost"])
def test_our_own_names_are_let_in(host):
    (start, _), inside = answered(host)
    assert inside and start["status"] == 200 and dict(start["headers"])[b"a"] == b"b"


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


@pytest.mark.parametrize("method, foreign", [("GET", False), ("HEAD", False), ("POST", True)])
def test_a_form_of_another_page_is_refused(method, foreign):
    """A browser may send a form of another page without an Origin; a link only asks."""
    headers = {"Host": "127.0.0.1:9", "Sec-Fetch-Site": "cross-site", "Sec-Fetch-Mode": "navigate"}
    assert guard.is_foreign(method, headers.items()) == foreign
    own = headers | {"Sec-Fetch-Site": "same-origin", "Origin": "http://127.0.0.1:9"}
    assert not guard.is_foreign(method, own.items())


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
    assert answered(host, "websocket") == ([{"type": "websocket.close", "code": 1008}], [])


def test_the_token_becomes_a_cookie():
    sent, inside = answered("localhost", path=f"/?token={TOKEN}", cookie=None)
    headers = dict(sent[0]["headers"])
    assert not inside and sent[0]["status"] == 303 and headers[b"location"] == b"/"
    assert headers[b"set-cookie"].startswith(f"gamba-1={TOKEN}; HttpOnly;".encode())


def test_the_oldest_files_are_removed(tmp_path):
    kept, paths = Store(tmp_path, limit=4000), []
    for age in range(9, 0, -1):
        paths.append(kept.new_folder() / "image.png")
        paths[-1].write_bytes(bytes(1000))
        os.utime(paths[-1], (time.time() - age,) * 2)
    kept.new_folder()
    assert [path.is_file() for path in paths] == [False] * 5 + [True] * 4
    assert not paths[0].parent.exists()


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
    stopped = "gamba app has stopped; restart it"
    assert found == [(5, threading.get_ident()), "no image", "ours", stopped]


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
