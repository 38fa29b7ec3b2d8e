"""Who may come in: every request passes here before anything looks at it.

Without a token only this machine may ask, under its own names: a page of somebody else that
a browser has open may reach 127.0.0.1 too, also under a name of its own (DNS rebinding). Whoever
wants to change something has to show that the request was made by our page or by a program: by a
header that other pages cannot send.
"""

from __future__ import annotations

import asyncio
import hashlib
import hmac
import json
import logging
import urllib.parse
from collections.abc import Awaitable, Callable, Iterator, MutableMapping
from typing import Any

from rasnik.cameras.addresses import is_loopback

__all__ = ["HEADER", "LARGEST_BODY", "Guard", "cookie_of", "same_token"]

#: Has to come with every request that changes something; its value does not matter.
HEADER = "x-rasnik"
#: Bytes in the body of a request.
LARGEST_BODY = 16 * 1024
_BODY_S = 10.0  # time for it to come

_OPEN_PATHS = {"/login", "/login.css"}
_SAFE = {"GET", "HEAD", "OPTIONS"}
_HEADERS = (
    (
        b"content-security-policy",
        b"default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob:; "
        b"connect-src 'self'; manifest-src 'self'; base-uri 'none'; form-action 'self'; "
        b"frame-ancestors 'none'",
    ),
    (b"x-content-type-options", b"nosniff"),
    (b"x-frame-options", b"DENY"),
    (b"referrer-policy", b"same-origin"),  # with none at all a form would come from "null"
    (b"cross-origin-opener-policy", b"same-origin"),
    (b"cross-origin-resource-policy", b"same-origin"),
    (b"cache-control", b"no-store"),
)

_log = logging.getLogger(__name__)

Scope = MutableMapping[str, Any]
Message = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[Message]]
Send = Callable[[Message], Awaitable[None]]
App = Callable[[Scope, Receive, Send], Awaitable[None]]


def cookie_of(token: str) -> tuple[str, str]:
    """Name and value of what a browser keeps instead of the token, which it does not tell.

    Browsers do not keep the cookies of two ports apart: stations of one machine need other names.
    """
    name, value = (
        hmac.new(token.encode(), about, hashlib.sha256).hexdigest()
        for about in (b"rasnik station", b"rasnik page")
    )
    return f"rasnik-{name[:8]}", value


def same_token(given: str, token: str) -> bool:
    """Whether it is the token; takes as long whatever is given."""
    return hmac.compare_digest(given.encode("utf-8", "replace"), token.encode())


class _RefusedError(Exception):
    def __init__(self, status: int, sentence: str) -> None:
        self.status = status
        super().__init__(sentence)


class Guard:
    """Lets requests through to the application, or answers why not.

    Parameters
    ----------
    app
        The application.
    token : str or None
        Without one only names of this machine are answered to.
    """

    def __init__(self, app: App, token: str | None) -> None:
        self._app = app
        self._token = token
        self._cookie = ("", "") if token is None else cookie_of(token)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "websocket":
            await self._websocket(scope, receive, send)
        elif scope["type"] == "http":
            await self._http(scope, receive, send)
        else:
            await self._app(scope, receive, send)

    # ----------------------------------------------------------------- both kinds

    async def _http(self, scope: Scope, receive: Receive, send: Send) -> None:
        begun = False

        async def guarded_send(message: Message) -> None:
            nonlocal begun
            if message["type"] == "http.response.start":
                begun = True
                there = {name.lower() for name, _ in message["headers"]}
                own = [pair for pair in _HEADERS if pair[0] not in there]
                message["headers"] = [*message["headers"], *own]
            await send(message)

        try:
            headers = self._checked(scope)
            if scope["method"] not in _SAFE:
                self._check_write(scope, headers)
            body = await _body(headers, receive)
            await self._app(scope, _replay(body, receive), guarded_send)
        except _RefusedError as refusal:
            if refusal.status == 401 and "text/html" in headers_of(scope).get("accept", ""):
                await _answer(guarded_send, 303, "", [(b"location", b"/login")])
            else:
                await _answer(guarded_send, refusal.status, str(refusal))
        except Exception:
            # The caller learns nothing of the inside; the log does.
            _log.exception("a request for %s failed", scope["path"])
            if begun:
                raise
            await _answer(
                guarded_send, 500, "Something failed inside; the log of rasnik says what."
            )

    async def _websocket(self, scope: Scope, receive: Receive, send: Send) -> None:
        try:
            headers = self._checked(scope)
            self._check_origin(headers)
        except _RefusedError as refusal:
            await receive()
            _log.info("a websocket was refused: %s", refusal)
            await send({"type": "websocket.close", "code": 1008, "reason": ""})
            return
        await self._app(scope, receive, send)

    def _checked(self, scope: Scope) -> dict[str, str]:
        """The headers of a request that may be looked at at all."""
        headers = headers_of(scope)
        _check_path(scope)
        if self._token is None:
            if not is_loopback(_name(headers.get("host", ""))):
                raise _RefusedError(
                    403, "This page is served for this machine alone; ask for it as 127.0.0.1."
                )
        elif scope["path"] not in _OPEN_PATHS and not self._knows_token(headers):
            raise _RefusedError(
                401,
                "The token is missing or wrong; send it as 'Authorization: Bearer TOKEN', "
                "or open /login in a browser.",
            )
        return headers

    def _knows_token(self, headers: dict[str, str]) -> bool:
        assert self._token is not None
        kind, _, given = headers.get("authorization", "").partition(" ")
        if kind.lower() == "bearer" and same_token(given.strip(), self._token):
            return True
        name, known = self._cookie
        return any(
            hmac.compare_digest(value.encode(), known.encode())
            for value in _cookies(headers.get("cookie", ""), name)
        )

    # ----------------------------------------------------------------- changes

    def _check_write(self, scope: Scope, headers: dict[str, str]) -> None:
        self._check_origin(headers)
        if headers.get("sec-fetch-site", "same-origin") not in ("same-origin", "none"):
            raise _RefusedError(403, "A page of another origin may not change anything here.")
        if scope["path"] in _OPEN_PATHS or HEADER in headers or "authorization" in headers:
            return
        raise _RefusedError(403, "The header 'X-Rasnik: 1' is needed to change something.")

    def _check_origin(self, headers: dict[str, str]) -> None:
        """A browser says which page asks; programs do not."""
        origin = headers.get("origin")
        if origin is None:
            return
        # Compared as text: what is no address is another one, too.
        if origin.lower().partition("://")[2] != headers.get("host", "").lower():
            raise _RefusedError(403, "A page of another origin may not do this.")


# ------------------------------------------------------------------------ requests


def headers_of(scope: Scope) -> dict[str, str]:
    """By lower-case name; of several with the same name the last."""
    return {name.decode("latin-1"): value.decode("latin-1") for name, value in scope["headers"]}


def _name(host: str) -> str:
    """Without the port and brackets."""
    try:
        return (urllib.parse.urlsplit(f"//{host}").hostname or "").lower()
    except ValueError:
        return ""


def _cookies(header: str, wanted: str) -> Iterator[str]:
    for part in header.split(";"):
        name, _, value = part.strip().partition("=")
        if name == wanted:
            yield value


def _check_path(scope: Scope) -> None:
    """No path that means another one: nothing here has a name with such signs."""
    path = urllib.parse.unquote(scope["path"])
    if "\\" in path or "\0" in path or "//" in path or ".." in path.split("/"):
        raise _RefusedError(400, "There is no such path.")


async def _body(headers: dict[str, str], receive: Receive) -> bytes:
    """The whole body, which is small."""
    sentence = f"The body is larger than {LARGEST_BODY} bytes."
    length = headers.get("content-length", "0")
    if not length.isdecimal():
        raise _RefusedError(400, "The length of the body is not a number.")
    if len(length) > 12 or int(length) > LARGEST_BODY:
        raise _RefusedError(413, sentence)
    body = b""
    try:
        async with asyncio.timeout(_BODY_S):
            while True:
                message = await receive()
                body += message.get("body", b"")
                if len(body) > LARGEST_BODY:
                    raise _RefusedError(413, sentence)
                if not message.get("more_body", False):
                    return body
    except TimeoutError:
        raise _RefusedError(408, "The body did not come in time.") from None


def _replay(body: bytes, receive: Receive) -> Receive:
    """Hand out a body that was read already."""
    given = False

    async def again() -> Message:
        nonlocal given
        if given:
            return await receive()
        given = True
        return {"type": "http.request", "body": body, "more_body": False}

    return again


async def _answer(
    send: Send, status: int, sentence: str, headers: list[tuple[bytes, bytes]] | None = None
) -> None:
    body = json.dumps({"error": sentence}).encode()
    await send(
        {
            "type": "http.response.start",
            "status": status,
            "headers": [
                (b"content-type", b"application/json"),
                (b"content-length", str(len(body)).encode()),
                *(headers or []),
            ],
        }
    )
    await send({"type": "http.response.body", "body": body})
