"""ASGI layer that lets only the user's own browser in.

The server listens on 127.0.0.1 only, which keeps out neither other web pages in the same browser
nor other programs of this machine. So every request needs the token of the printed address, which a
cookie holds from then on, and headers that say that the page itself asks. gradio bounds the rest.
"""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Iterable, MutableMapping
from secrets import compare_digest
from typing import Any

from starlette.requests import Request
from starlette.responses import PlainTextResponse, RedirectResponse, Response

# The page has inline scripts, and its brush evaluates code for shaders; the viewer is an inline
# frame with a worker from a blob.
POLICY = (
    "default-src 'self'; img-src 'self' data: blob:; media-src 'self' data: blob:; "
    "font-src 'self' data:; style-src 'self' 'unsafe-inline'; "
    "script-src 'self' 'unsafe-inline' 'unsafe-eval' blob:; worker-src 'self' blob:; "
    "connect-src 'self' data: blob:; frame-src 'self' blob:; object-src 'none'; base-uri 'self'; "
    "form-action 'self'; frame-ancestors 'self'"
)
_HEADERS = (
    (b"content-security-policy", POLICY.encode()),
    (b"referrer-policy", b"no-referrer"),
    (b"x-content-type-options", b"nosniff"),
)
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
    by_name: dict[str, str] = {}
    for name, value in ((name.lower(), value) for name, value in headers):
        if name in by_name and name in _CHECKED:
            return True
        by_name[name] = value
    host, site = by_name.get("host", ""), by_name.get("sec-fetch-site")
    name, colon, port = host.partition(":")
    if name not in _HOSTS or (colon and not port.isdecimal()):
        return True
    if by_name.get("origin") not in (None, f"http://{host}"):
        return True
    # The page of a link sees no answer; a form of another page, without an Origin, would act.
    followed = by_name.get("sec-fetch-mode") == "navigate" and method in ("GET", "HEAD")
    return not followed and site not in (None, "none", "same-origin")


class Guard:
    """ASGI layer in front of gradio's app.

    Args:
        app: gradio's.
        token: secret that the printed address has as ``?token=``.
        port: of the server. Cookies of all ports are sent to each, so the cookie's name has it.
    """

    def __init__(
        self, app: Callable[[Message, Receive, Send], Awaitable[None]], token: str, port: int
    ) -> None:
        self._app, self._token, self._cookie = app, token, f"gamba-{port}"

    async def __call__(self, scope: Message, receive: Receive, send: Send) -> None:
        """Answer one request."""

        async def guarded(message: Message) -> None:
            if message["type"] == "http.response.start":
                message["headers"] = [*message.get("headers", ()), *_HEADERS]
            await send(message)

        if scope["type"] == "lifespan":
            await self._app(scope, receive, send)
        elif scope["type"] != "http":
            await send({"type": "websocket.close", "code": 1008})
        else:
            answer = self._own_answer(Request(scope)) or self._app
            await answer(scope, receive, guarded)

    def _own_answer(self, request: Request) -> Response | None:
        """Return a refusal, or the answer that sets the cookie; None for a request of the page."""
        if is_foreign(request.method, request.headers.items()):
            return PlainTextResponse("only this page itself may ask, at 127.0.0.1\n", 421)
        if request.url.path == "/" and self._is_token(request.query_params.get("token")):
            answer = RedirectResponse("/", 303)
            answer.set_cookie(self._cookie, self._token, httponly=True, samesite="lax")
            return answer
        if not self._is_token(request.cookies.get(self._cookie)):
            return PlainTextResponse("open the address that gamba app has printed\n", 403)
        return None

    def _is_token(self, token: str | None) -> bool:
        return compare_digest((token or "").encode(), self._token.encode())
