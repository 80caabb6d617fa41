"""What stands between the page and the rest of the world.

The server listens on 127.0.0.1 alone. That keeps out neither a web page of somebody else, open in
the same browser, nor other programs of this machine. So every request passes here: for our own
name, from our own page, to one of the few addresses that the page uses; what it sends is bounded,
is taken apart here, and names no file but those of its own visitor. And the browser is told to load
nothing from any other host.
"""

from __future__ import annotations

import asyncio
import hashlib
import re
import secrets
import shutil
from collections import Counter
from collections.abc import Awaitable, Callable, Mapping, MutableMapping, Sequence
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
from ..images import PICTURE_SUFFIXES
from ..pages.serve import READ_SECONDS, is_foreign
from ..untrusted.documents import parse_document
from .cutting import examples
from .shelf import KEPT, Shelf

# Scripts stand in the page, and its brush compiles shaders' bindings; the viewer is a frame of the
# page's own text with a worker made of a text.
POLICY = (
    "default-src 'self'; img-src 'self' data: blob:; media-src 'self' data: blob:; "
    "font-src 'self' data:; style-src 'self' 'unsafe-inline'; "
    "script-src 'self' 'unsafe-inline' 'unsafe-eval' blob:; worker-src 'self' blob:; "
    "connect-src 'self' data: blob:; frame-src 'self' blob:; object-src 'none'; base-uri 'self'; "
    "form-action 'self'; frame-ancestors 'self'"
)
VISITOR = "gamba.visitor"  # in the scope of a request that is let in
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
_SESSION = re.compile(b"session_hash=[a-z0-9]{1,32}")  # all that an address may be followed by
# All that the page asks for; gradio itself answers to eighty addresses.
_READ = re.compile(
    "/|/theme[.]css|/favicon[.]ico|/(assets|static)/.*|/gradio_api/(file=.*|heartbeat/[a-z0-9]+"
    "|queue/data|upload_progress)",
    re.DOTALL,
)
_MAX_CALL = 1 << 20  # bytes of a call of a function; a real one takes 2 kB
_HEAD = 1 << 16  # bytes of an upload beside its files
_CALL_SECONDS = READ_SECONDS  # until all of it is there
UPLOAD_SECONDS = 300.0
MAX_AT_ONCE = 16  # requests of one visitor
# The rest is ignored: gradio fails with several ranges, or with other digits than ours.
_RANGE = re.compile(b"bytes=([0-9]{1,15}-[0-9]{0,15}|-[0-9]{1,15})")

Message = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[Message]]
Send = Callable[[Message], Awaitable[None]]


class GivenFile(msgspec.Struct):
    """A file that was uploaded, or that the page was given."""

    path: Annotated[str, Meta(max_length=4096)]
    orig_name: Annotated[str, Meta(max_length=1024)] | None = None
    meta: dict[str, str] | None = None


class Painted(msgspec.Struct):
    """The editor's value. It sends its pictures, too, which nobody needs."""

    layers: Annotated[list[GivenFile], Meta(max_length=4)]
    background: Any = None
    composite: Any = None


class _Call(msgspec.Struct):
    """A call of one of the page's functions; what else gradio would take is left out."""

    data: list[msgspec.Raw]
    fn_index: int
    session_hash: Annotated[str, Meta(pattern="^[a-z0-9]{1,32}$")]
    trigger_id: int | None = None
    event_data: Any = None


class Guard:
    """An ASGI layer that lets in what the page itself asks for.

    Args:
        app: gradio's.
        shelf: the visitors' files.
        inputs: of each of the page's functions, by its number: of which type each input is.
        max_bytes: largest file.
    """

    def __init__(
        self,
        app: Callable[[Message, Receive, Send], Awaitable[None]],
        shelf: Shelf,
        inputs: Mapping[int, Sequence[Any]],
        max_bytes: int,
    ) -> None:
        self._app, self._shelf, self._inputs = app, shelf, inputs
        self._max_bytes = max_bytes
        self._coming: Counter[str] = Counter()  # bytes of uploads that are there so far
        self._shown = {str(path) for path, _ in examples()}

    async def __call__(self, scope: Message, receive: Receive, send: Send) -> None:
        """Answers one request."""
        if scope["type"] == "lifespan":
            sweeper = asyncio.create_task(self._sweep())
            try:
                await self._app(scope, receive, send)
            finally:
                sweeper.cancel()
        elif scope["type"] != "http":
            await send({"type": "websocket.close", "code": 1008})
        else:
            # The token is the browser's secret, and the folder's name is in what the page says.
            token = Request(scope).cookies.get(_COOKIE, "")
            known = _TOKEN.fullmatch(token) is not None
            visitor = hashlib.sha256(token.encode()).hexdigest()[:32] if known else None
            scope[VISITOR] = visitor
            with self._shelf.visited(visitor or "") as at_once:
                await self._answer(scope, receive, send, at_once)

    async def _sweep(self) -> None:
        while True:
            await asyncio.sleep(KEPT / 6)
            await asyncio.to_thread(self._shelf.sweep)

    async def _answer(self, scope: Message, receive: Receive, send: Send, at_once: int) -> None:
        more = list(_HEADERS)

        async def guarded(message: Message) -> None:
            if message["type"] == "http.response.start":
                theirs = [h for h in message.get("headers", ()) if h[0] != b"cookie"]
                message["headers"] = [*theirs, *more]
            await send(message)

        # What a proxy would say of itself; gradio would make addresses of it.
        kept = [h for h in scope["headers"] if b"forwarded" not in h[0] and b"gradio" not in h[0]]
        ranges = [value for name, value in kept if name == b"range"]
        if len(ranges) > 1 or not all(map(_RANGE.fullmatch, ranges)):
            kept = [h for h in kept if h[0] != b"range"]
        scope.update({"headers": kept, "scheme": "http"})
        request, path, visitor = Request(scope, receive), scope["path"], scope[VISITOR]
        read, answer = receive, self._app
        try:
            if is_foreign(request.headers.items()):
                raise HTTPException(421, "this page is that of 127.0.0.1, for its own pages alone")
            if visitor and at_once > MAX_AT_ONCE:
                raise HTTPException(503, "too many requests at once; try again")
            if request.method in ("GET", "HEAD") and _READ.fullmatch(path):
                stated = request.headers.get("content-length", "0")
                if stated != "0" or "transfer-encoding" in request.headers:
                    raise HTTPException(400, "to ask for something takes no body")
                if path == "/" and visitor is None:
                    cookie = f"{_COOKIE}={secrets.token_hex(16)}; HttpOnly; SameSite=Lax; Path=/"
                    more.append((b"set-cookie", cookie.encode()))
                self._check_read(scope, visitor)
                if path == _PROGRESS:
                    answer = Response('data: {"msg": "done"}\n\n', media_type="text/event-stream")
            elif request.method != "POST" or path not in (_UPLOAD, _JOIN):
                raise HTTPException(404, "there is nothing here")
            elif visitor is None:
                raise HTTPException(403, _NO_COOKIE)
            elif path == _UPLOAD:
                answer = JSONResponse(await self._taken(request, visitor))
            else:
                _check_size(request, _MAX_CALL)
                body = await asyncio.wait_for(request.body(), _CALL_SECONDS)
                body = self._checked(body, visitor)
                pieces = iter([{"type": "http.request", "body": body}])

                async def again() -> Message:
                    return next(pieces, None) or await receive()

                read = again

        except (HTTPException, asyncio.TimeoutError) as error:
            if not isinstance(error, HTTPException):
                error = HTTPException(408, "what is sent took too long")
            line, kind = error.detail, "text/plain"
            if path == _JOIN:  # the page shows what a call's answer holds
                line, kind = msgspec.json.encode({"detail": line}).decode(), "application/json"
            answer = Response(f"{line}\n", error.status_code, media_type=kind)
        await answer(scope, read, guarded)

    def _check_read(self, scope: Message, visitor: str | None) -> None:
        """Only what is the visitor's own; sessions are told apart by the visitor as well."""
        path, asked = scope["path"], scope.get("query_string", b"")
        if path.startswith(_FILE) and path.removeprefix(_FILE) not in self._shown:
            try:
                self._shelf.file(path.removeprefix(_FILE), visitor or "-")
            except UserError as error:
                raise HTTPException(403, str(error)) from None
        elif path.startswith(_ALIVE) or path == _DATA:
            if visitor is None:
                raise HTTPException(403, _NO_COOKIE)
            if path != _DATA:
                scope["path"] += visitor
        session = visitor and _SESSION.fullmatch(asked)
        scope["query_string"] = asked + visitor.encode() if session else b""

    async def _taken(self, request: Request, visitor: str) -> list[str]:
        """Puts the files of a form on the shelf as they are; nobody looks into them yet."""
        _check_size(request, self._max_bytes + _HEAD)
        got = 0

        async def counted() -> Message:
            nonlocal got
            message = await request.receive()
            size = len(message.get("body", b""))
            got += size
            self._coming[visitor] += size
            if self._coming[visitor] > self._shelf.own or self._coming.total() > self._shelf.limit:
                raise HTTPException(503, "too much comes in at once; try again")
            return message

        form = FormData()
        try:
            sent = Request(request.scope, counted).form(max_files=4, max_fields=0)
            form = await asyncio.wait_for(sent, UPLOAD_SECONDS)
            if not form:
                raise HTTPException(400, "no upload of files")
            return [await asyncio.to_thread(self._keep, f, visitor) for f in form.values()]
        except MultiPartException as error:
            raise HTTPException(400, f"no upload of files ({first_line(error)})") from None
        except UserError as error:
            raise HTTPException(503, str(error)) from None
        finally:
            self._coming -= Counter({visitor: got})
            await form.close()

    def _keep(self, file: Any, visitor: str) -> str:
        if file.size > self._max_bytes:
            raise HTTPException(413, "the file is over the maximum allowed size")
        suffix = PurePath(file.filename or "").suffix.lower()
        name = f"picture{suffix if suffix in PICTURE_SUFFIXES else ''}"
        path = self._shelf.place(visitor, file.size) / name
        with open(path, "wb") as out:
            shutil.copyfileobj(file.file, out)
        return str(path)

    def _checked(self, body: bytes, visitor: str) -> bytes:
        """A call, put together again of what was declared, so that nothing else gets in."""
        try:
            call = parse_document(body, _Call, "the call")
            kinds = self._inputs.get(call.fn_index)
            if kinds is None or len(kinds) != len(call.data):
                raise UserError(f"the page has no such function (number {call.fn_index})")
            given = [parse_document(bytes(d), k, "the call") for d, k in zip(call.data, kinds)]
            for item in given:
                if isinstance(item, Painted):
                    item.background = item.composite = None
                for file in getattr(item, "layers", [item]):
                    if isinstance(file, GivenFile):
                        self._shelf.file(file.path, visitor)
                        file.meta = {"_type": "gradio.FileData"}  # gradio looks at such alone
            index = call.event_data.get("index") if isinstance(call.event_data, dict) else None
        except UserError as error:
            raise HTTPException(400, str(error)) from None
        call.session_hash += visitor
        call.data = [msgspec.Raw(msgspec.json.encode(item)) for item in given]
        call.event_data = {"index": index}
        return msgspec.json.encode(call)


def _check_size(request: Request, limit: int) -> None:
    """A request must state how many bytes it sends, and may not be over the limit."""
    stated = request.headers.get("content-length", "")
    if not re.fullmatch("[0-9]{1,15}", stated):
        raise HTTPException(411, "what is sent must state its length")
    if int(stated) > limit:
        raise HTTPException(413, f"more than {limit >> 20} MB, the maximum allowed size")
