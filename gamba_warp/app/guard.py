"""ASGI layer that restricts access to the app.

The server listens on 127.0.0.1 only. That keeps out neither other web pages in the same browser nor
other programs of this machine. So this layer checks every request: its host and origin, the path
(one of the few that the page uses), and the size and content of its body, which may name only files
of the same visitor. Headers forbid the browser to load anything from other hosts.
"""

from __future__ import annotations

import asyncio
import hashlib
import re
import secrets
import shutil
from collections import Counter
from collections.abc import Awaitable, Callable, Iterable, Mapping, MutableMapping, Sequence
from pathlib import PurePath
from typing import Annotated, Any

import msgspec
from msgspec import Meta
from starlette.datastructures import FormData
from starlette.exceptions import HTTPException
from starlette.formparsers import MultiPartException
from starlette.requests import Request
from starlette.responses import JSONResponse, Response

from ..errors import UserError, first_line
from ..images import IMAGE_SUFFIXES
from ..untrusted.documents import parse_document
from .connections import READ_SECONDS
from .cutting import examples
from .visitor_files import KEEP_SECONDS, VisitorFiles
from .work import HIGHEST, LOWEST

# The page has inline scripts, and its brush evaluates code for shaders; the viewer is an inline
# frame with a worker from a blob.
POLICY = (
    "default-src 'self'; img-src 'self' data: blob:; media-src 'self' data: blob:; "
    "font-src 'self' data:; style-src 'self' 'unsafe-inline'; "
    "script-src 'self' 'unsafe-inline' 'unsafe-eval' blob:; worker-src 'self' blob:; "
    "connect-src 'self' data: blob:; frame-src 'self' blob:; object-src 'none'; base-uri 'self'; "
    "form-action 'self'; frame-ancestors 'self'"
)
VISITOR = "gamba.visitor"  # key in the scope of an accepted request
_PAGE = "gamba.page"  # of a request that lasts as long as a page or its calls: the session
_HEADERS = (
    (b"content-security-policy", POLICY.encode()),
    (b"referrer-policy", b"no-referrer"),
    (b"x-content-type-options", b"nosniff"),
)
_COOKIE = "gamba-visitor"
_TOKEN = re.compile("[0-9a-f]{32}")
_FILE, _UPLOAD, _JOIN = "/gradio_api/file=", "/gradio_api/upload", "/gradio_api/queue/join"
_PROGRESS, _DATA = "/gradio_api/upload_progress", "/gradio_api/queue/data"
_ALIVE = "/gradio_api/heartbeat/"
_NO_COOKIE = "open the page first; it needs its cookie"
_SESSION = re.compile(b"session_hash=[a-z0-9]{1,32}")  # the only allowed query
# All paths that the page reads; gradio itself serves eighty.
_READ = re.compile(
    "/|/theme[.]css|/favicon[.]ico|/manifest[.]json|/(assets|static)/.*"
    "|/gradio_api/(file=.*|heartbeat/[a-z0-9]+|queue/data|upload_progress)",
    re.DOTALL,
)
_MAX_CALL = 1 << 20  # bytes of a function call; a real one takes 2 kB
_HEAD = 1 << 16  # bytes of an upload besides its files
_CALL_SECONDS = READ_SECONDS  # to receive it completely
UPLOAD_SECONDS = 300.0
MAX_AT_ONCE = 16  # requests of one visitor
MAX_IMAGES = 12  # of one upload, and results of one page
# Others are ignored: gradio fails with several ranges, or with non-ASCII digits.
_RANGE = re.compile(b"bytes=([0-9]{1,15}-[0-9]{0,15}|-[0-9]{1,15})")

_HOSTS = ("127.0.0.1", "localhost")
_CHECKED = ("host", "origin", "sec-fetch-mode", "sec-fetch-site")

Message = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[Message]]
Send = Callable[[Message], Awaitable[None]]


def is_foreign(method: str, headers: Iterable[tuple[str, str]]) -> bool:
    """Return True if a request to a server on 127.0.0.1 is neither of its page nor of the user.

    Another web page in the same browser can send requests there, and even read the answers by
    resolving its own name to that address (DNS rebinding). The browser reveals it by these headers,
    each of which comes once.

    Args:
        method: of the request, such as GET.
        headers: all of the request, by name.
    """
    found: dict[str, str] = {}
    for name, value in ((name.lower(), value) for name, value in headers):
        if name in found and name in _CHECKED:
            return True
        found[name] = value
    host, site = found.get("host", ""), found.get("sec-fetch-site")
    name, colon, port = host.partition(":")
    if name not in _HOSTS or (colon and not port.isdecimal()):
        return True
    if found.get("origin") not in (None, f"http://{host}"):
        return True
    # The page of a link sees no answer; a form of another page, without an Origin, would act.
    followed = found.get("sec-fetch-mode") == "navigate" and method in ("GET", "HEAD")
    return not followed and site not in (None, "none", "same-origin")


class GivenFile(msgspec.Struct):
    """A file that was uploaded or sent to the page."""

    path: Annotated[str, Meta(max_length=4096)]
    orig_name: Annotated[str, Meta(max_length=1024)] | None = None
    meta: dict[str, str] | None = None


class Painted(msgspec.Struct):
    """The editor's value; its background and composite are ignored."""

    layers: Annotated[list[GivenFile], Meta(max_length=4)]
    background: Any = None
    composite: Any = None


class Edit(msgspec.Struct):
    """Message of the viewer about its object; ``removed`` has a bit for each Gaussian."""

    key: Annotated[str, Meta(max_length=32)]
    elevation: Annotated[float, Meta(ge=LOWEST, le=HIGHEST)]
    removed: Annotated[bytes, Meta(max_length=1 << 18)]  # base64 in the call


class _Call(msgspec.Struct):
    """A call of one of the page's functions, reduced to the fields that the page uses."""

    data: list[msgspec.Raw]
    fn_index: int
    session_hash: Annotated[str, Meta(pattern="^[a-z0-9]{1,32}$")]
    trigger_id: int | None = None
    event_data: Any = None


class Guard:
    """ASGI layer that accepts only requests of the page itself.

    Args:
        app: gradio's.
        files: the visitors' files.
        inputs: types of the inputs of each of the page's functions, by its number.
        max_bytes: largest file.
    """

    def __init__(
        self,
        app: Callable[[Message, Receive, Send], Awaitable[None]],
        files: VisitorFiles,
        inputs: Mapping[int, Sequence[Any]],
        max_bytes: int,
    ) -> None:
        self._app, self._files, self._inputs = app, files, inputs
        self._max_bytes = max_bytes
        self._incoming: Counter[str] = Counter()  # bytes received of running uploads
        self._examples = {str(path) for path, _ in examples()}

    async def __call__(self, scope: Message, receive: Receive, send: Send) -> None:
        """Answer one request."""
        if scope["type"] == "lifespan":
            sweeper = asyncio.create_task(self._sweep())
            try:
                await self._app(scope, receive, send)
            finally:
                sweeper.cancel()
        elif scope["type"] != "http":
            await send({"type": "websocket.close", "code": 1008})
        else:
            # The token is the browser's secret; the page sees only its hash, the folder's name.
            token = Request(scope).cookies.get(_COOKIE, "")
            known = _TOKEN.fullmatch(token) is not None
            visitor = hashlib.sha256(token.encode()).hexdigest()[:32] if known else None
            scope[VISITOR] = visitor
            with self._files.visited(visitor or "") as at_once:
                await self._answer(scope, receive, send, at_once)

    async def _sweep(self) -> None:
        while True:
            await asyncio.sleep(KEEP_SECONDS / 6)
            await asyncio.to_thread(self._files.sweep)

    async def _answer(self, scope: Message, receive: Receive, send: Send, at_once: int) -> None:
        more = list(_HEADERS)

        async def guarded(message: Message) -> None:
            if message["type"] == "http.response.start":
                theirs = [h for h in message.get("headers", ()) if h[0] != b"cookie"]
                message["headers"] = [*theirs, *more]
            await send(message)

        # Drop headers of proxies, from which gradio would build addresses.
        kept = [h for h in scope["headers"] if b"forwarded" not in h[0] and b"gradio" not in h[0]]
        ranges = [value for name, value in kept if name == b"range"]
        if len(ranges) > 1 or not all(map(_RANGE.fullmatch, ranges)):
            kept = [h for h in kept if h[0] != b"range"]
        scope.update({"headers": kept, "scheme": "http"})
        request, path, visitor = Request(scope, receive), scope["path"], scope[VISITOR]
        read, answer = receive, self._app
        try:
            if is_foreign(request.method, request.headers.items()):
                raise HTTPException(421, "only this page itself may ask, at 127.0.0.1")
            if visitor and at_once > MAX_AT_ONCE:
                raise HTTPException(503, "too many requests at once; try again")
            if request.method in ("GET", "HEAD") and _READ.fullmatch(path):
                stated = request.headers.get("content-length", "0")
                if stated != "0" or "transfer-encoding" in request.headers:
                    raise HTTPException(400, "a read request has no body")
                if path == "/" and visitor is None:
                    cookie = f"{_COOKIE}={secrets.token_hex(16)}; HttpOnly; SameSite=Lax; Path=/"
                    more.append((b"set-cookie", cookie.encode()))
                self._check_read(scope, visitor)
                if path == "/manifest.json":  # gradio has one for pages that are installed only
                    answer = Response("{}", media_type="application/manifest+json")
                if path == _PROGRESS:
                    answer = Response('data: {"msg": "done"}\n\n', media_type="text/event-stream")
            elif request.method != "POST" or path not in (_UPLOAD, _JOIN):
                raise HTTPException(404, "not found")
            elif visitor is None:
                raise HTTPException(403, _NO_COOKIE)
            elif path == _UPLOAD:
                answer = JSONResponse(await self._receive_files(request, visitor))
            else:
                _check_size(request, _MAX_CALL)
                body = await asyncio.wait_for(request.body(), _CALL_SECONDS)
                body = self._checked_call(body, visitor)
                pieces = iter([{"type": "http.request", "body": body}])

                async def again() -> Message:
                    return next(pieces, None) or await receive()

                read = again

        except (HTTPException, asyncio.TimeoutError) as error:
            if not isinstance(error, HTTPException):
                error = HTTPException(408, "the request took too long")
            line, kind = error.detail, "text/plain"
            if path == _JOIN:  # the page shows the detail of a call's answer
                line, kind = msgspec.json.encode({"detail": line}).decode(), "application/json"
            answer = Response(f"{line}\n", error.status_code, media_type=kind)
        with self._files.visited(scope.get(_PAGE, "")):
            await answer(scope, read, guarded)

    def _check_read(self, scope: Message, visitor: str | None) -> None:
        """Allow only the visitor's own files; append the visitor to the session."""
        path, asked = scope["path"], scope.get("query_string", b"")
        if path.startswith(_FILE) and path.removeprefix(_FILE) not in self._examples:
            try:
                self._files.file(path.removeprefix(_FILE), visitor or "-")
            except UserError as error:
                raise HTTPException(403, str(error)) from None
        elif path.startswith(_ALIVE) or path == _DATA:
            if visitor is None:
                raise HTTPException(403, _NO_COOKIE)
            if path != _DATA:
                scope["path"] += visitor
            asked_by = asked.decode("latin-1") if path == _DATA else path
            scope[_PAGE] = re.split("[/=]", asked_by)[-1] + visitor
        scope["query_string"] = b""
        if visitor and _SESSION.fullmatch(asked):
            scope["query_string"] = asked + visitor.encode()

    async def _receive_files(self, request: Request, visitor: str) -> list[str]:
        """Store the files of a form unread."""
        _check_size(request, self._max_bytes + _HEAD)
        got = 0

        async def counted() -> Message:
            nonlocal got
            message = await request.receive()
            size = len(message.get("body", b""))
            got += size
            self._incoming[visitor] += size
            files, incoming = self._files, self._incoming
            if incoming[visitor] > files.per_visitor or incoming.total() > files.limit:
                raise HTTPException(503, "too many uploads at once; try again")
            return message

        form = FormData()
        try:
            sent = Request(request.scope, counted).form(max_files=MAX_IMAGES, max_fields=0)
            form = await asyncio.wait_for(sent, UPLOAD_SECONDS)
            if not form:
                raise HTTPException(400, "not an upload of files")
            given = (file for _, file in form.multi_items())
            return [await asyncio.to_thread(self._store, file, visitor) for file in given]
        except MultiPartException as error:
            raise HTTPException(400, f"not an upload of files ({first_line(error)})") from None
        except UserError as error:
            raise HTTPException(503, str(error)) from None
        finally:
            self._incoming -= Counter({visitor: got})
            await form.close()

    def _store(self, file: Any, visitor: str) -> str:
        if file.size > self._max_bytes:
            raise HTTPException(413, "the file is over the maximum allowed size")
        suffix = PurePath(file.filename or "").suffix.lower()
        name = f"image{suffix if suffix in IMAGE_SUFFIXES else ''}"
        path = self._files.new_folder(visitor, file.size) / name
        with open(path, "wb") as out:
            shutil.copyfileobj(file.file, out)
        return str(path)

    def _checked_call(self, body: bytes, visitor: str) -> bytes:
        """Parse a call and encode it again, so that only declared fields pass."""
        try:
            call = parse_document(body, _Call, "the call")
            kinds = self._inputs.get(call.fn_index)
            if kinds is None or len(kinds) != len(call.data):
                raise UserError(f"unknown endpoint {call.fn_index}")
            given = [parse_document(bytes(d), k, "the call") for d, k in zip(call.data, kinds)]
            for item in given:
                if isinstance(item, Painted):
                    item.background = item.composite = None
                for file in item if isinstance(item, list) else getattr(item, "layers", [item]):
                    if isinstance(file, GivenFile):
                        self._files.file(file.path, visitor)
                        file.meta = {"_type": "gradio.FileData"}  # else gradio ignores it
            index = call.event_data.get("index") if isinstance(call.event_data, dict) else None
        except UserError as error:
            raise HTTPException(400, str(error)) from None
        call.session_hash += visitor
        call.data = [msgspec.Raw(msgspec.json.encode(item)) for item in given]
        call.event_data = {"index": index}
        return msgspec.json.encode(call)


def _check_size(request: Request, limit: int) -> None:
    """Raise HTTPException unless the request states a length within the limit."""
    stated = request.headers.get("content-length", "")
    if not re.fullmatch("[0-9]{1,15}", stated):
        raise HTTPException(411, "the request must state its length")
    if int(stated) > limit:
        raise HTTPException(413, f"more than {limit >> 20} MB, the maximum allowed size")
