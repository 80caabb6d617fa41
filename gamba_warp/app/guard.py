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
from collections.abc import Awaitable, Callable, Mapping, MutableMapping, Sequence
from http.cookies import CookieError, SimpleCookie
from pathlib import PurePath
from typing import Annotated, Any

import msgspec
from msgspec import Meta

from ..errors import UserError, first_line
from ..images import PICTURE_SUFFIXES
from ..pages.serve import is_foreign
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
_PROGRESS, _ALIVE = "/gradio_api/upload_progress", "/gradio_api/heartbeat/"
_SESSION = re.compile(b"session_hash=[a-z0-9]{1,32}")  # all that an address may be followed by
# All that the page asks for; gradio itself answers to eighty addresses.
_READ = re.compile(
    "/|/theme[.]css|/favicon[.]ico|/(assets|static)/.*|/gradio_api/(file=.*|heartbeat/[a-z0-9]+"
    "|queue/data|startup-events|upload_progress)",
    re.DOTALL,
)
_MAX_CALL = 1 << 20  # bytes of a call of a function; a real one takes 2 kB
_HEAD = 1 << 16  # bytes of an upload beside its files
_UPLOAD_SECONDS = 300.0

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


class _Refused(Exception):
    """A status and one line."""


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
        self._max_bytes, self._coming = max_bytes, 0
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
            await self._answer(scope, receive, send)

    async def _sweep(self) -> None:
        while True:
            await asyncio.sleep(KEPT / 6)
            await asyncio.to_thread(self._shelf.sweep)

    async def _answer(self, scope: Message, receive: Receive, send: Send) -> None:
        headers = {name.decode("latin-1"): v.decode("latin-1") for name, v in scope["headers"]}
        token, more = _token(headers.get("cookie", "")), list(_HEADERS)

        async def guarded(message: Message) -> None:
            if message["type"] == "http.response.start":
                message["headers"] = [*message.get("headers", ()), *more]
            await send(message)

        # What a proxy would say of itself; gradio would make addresses of it.
        kept = [h for h in scope["headers"] if b"forwarded" not in h[0] and b"gradio" not in h[0]]
        # The token is the browser's secret, and the folder's name is in what the page says.
        visitor = token and hashlib.sha256(token.encode()).hexdigest()[:32]
        scope.update({"headers": kept, "scheme": "http", VISITOR: visitor})
        try:
            if is_foreign(headers):
                raise _Refused(421, "this page is that of 127.0.0.1, for its own pages alone")
            if scope["method"] in ("GET", "HEAD") and _READ.fullmatch(scope["path"]):
                if scope["path"] == "/" and token is None:
                    cookie = f"{_COOKIE}={secrets.token_hex(16)}; HttpOnly; SameSite=Lax; Path=/"
                    more.append((b"set-cookie", cookie.encode()))
                self._check_read(scope, visitor or "-")
                if scope["path"] == _PROGRESS:
                    await _say(guarded, 200, 'data: {"msg": "done"}\n', "text/event-stream")
                else:
                    await self._app(scope, receive, guarded)
            elif scope["method"] == "POST" and scope["path"] in (_UPLOAD, _JOIN):
                if visitor is None:
                    raise _Refused(403, "open the page first; it needs its cookie")
                await self._take(scope, headers, receive, guarded, visitor)
            else:
                raise _Refused(404, "there is nothing here")
        except _Refused as error:
            status, line = error.args
            if scope["path"] == _JOIN:  # the page shows what a call's answer holds
                detail = msgspec.json.encode({"detail": line}).decode()
                await _say(guarded, status, detail, "application/json")
            else:
                await _say(guarded, status, line)

    def _check_read(self, scope: Message, visitor: str) -> None:
        """Only what is the visitor's own; sessions are told apart by the visitor as well."""
        path, asked = scope["path"], scope.get("query_string", b"")
        if path.startswith(_FILE) and path.removeprefix(_FILE) not in self._shown:
            try:
                self._shelf.file(path.removeprefix(_FILE), visitor)
            except UserError as error:
                raise _Refused(403, str(error)) from None
        elif path.startswith(_ALIVE):
            scope["path"] += visitor
        scope["query_string"] = asked + visitor.encode() if _SESSION.fullmatch(asked) else b""

    async def _take(
        self, scope: Message, headers: dict[str, str], receive: Receive, send: Send, visitor: str
    ) -> None:
        """What comes in: never more than it states, nor more than all files together may take."""
        stated, limit = headers.get("content-length", ""), _MAX_CALL
        if scope["path"] == _UPLOAD:
            limit = self._max_bytes + _HEAD
        if not re.fullmatch("[0-9]{1,15}", stated):
            raise _Refused(411, "what is sent must state its length")
        if int(stated) > limit:
            raise _Refused(413, f"more than {limit >> 20} MB, the maximum allowed size")
        if scope["path"] == _JOIN:
            body = self._checked(await _whole(receive), visitor)
            pieces = iter([{"type": "http.request", "body": body}])

            async def again() -> Message:
                return next(pieces, None) or await receive()

            await self._app(scope, again, send)
            return
        if self._coming + int(stated) > self._shelf.limit:
            raise _Refused(503, "too much comes in at once; try again")
        self._coming += int(stated)
        try:
            await asyncio.to_thread(self._shelf.sweep, self._coming)
            taken = await asyncio.wait_for(self._upload(scope, receive, visitor), _UPLOAD_SECONDS)
        except asyncio.TimeoutError:
            raise _Refused(408, "the upload took too long") from None
        finally:
            self._coming -= int(stated)
        await _say(send, 200, msgspec.json.encode(taken).decode(), "application/json")

    async def _upload(self, scope: Message, receive: Receive, visitor: str) -> list[str]:
        """Puts the files of a form on the shelf as they are; nobody looks into them yet."""
        from starlette.exceptions import HTTPException
        from starlette.formparsers import MultiPartException
        from starlette.requests import Request

        try:
            async with Request(scope, receive).form(max_files=4, max_fields=0) as form:
                if not form:
                    raise _Refused(400, "no upload of files")
                return [await asyncio.to_thread(self._keep, f, visitor) for f in form.values()]
        except (HTTPException, MultiPartException) as error:
            raise _Refused(400, f"no upload of files ({first_line(error)})") from None

    def _keep(self, file: Any, visitor: str) -> str:
        if file.size > self._max_bytes:
            raise _Refused(413, "the file is over the maximum allowed size")
        suffix = PurePath(file.filename or "").suffix.lower()
        name = f"picture{suffix if suffix in PICTURE_SUFFIXES else ''}"
        path = self._shelf.place(visitor) / name
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
            raise _Refused(400, str(error)) from None
        call.session_hash += visitor
        call.data = [msgspec.Raw(msgspec.json.encode(item)) for item in given]
        call.event_data = {"index": index}
        return msgspec.json.encode(call)


def _token(cookies: str) -> str | None:
    """The visitor's token, which the browser brings back; None for a new one."""
    try:
        cookie = SimpleCookie(cookies).get(_COOKIE)
    except CookieError:
        return None
    return cookie.value if cookie and _TOKEN.fullmatch(cookie.value) else None


async def _whole(receive: Receive) -> bytes:
    parts, more = [], True
    while more:
        message = await receive()
        parts.append(message.get("body", b""))
        more = message.get("more_body", False)
    return b"".join(parts)


async def _say(send: Send, status: int, line: str, kind: str = "text/plain") -> None:
    headers = [(b"content-type", f"{kind}; charset=utf-8".encode())]
    await send({"type": "http.response.start", "status": status, "headers": headers})
    await send({"type": "http.response.body", "body": f"{line}\n".encode()})
