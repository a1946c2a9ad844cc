"""Access to the page: by a secret token, from this machine, through a page of this server only."""

from __future__ import annotations

import hmac
import secrets
from collections.abc import Mapping
from http.cookies import CookieError, SimpleCookie
from typing import TYPE_CHECKING
from urllib.parse import parse_qsl, quote, urlencode

if TYPE_CHECKING:
    from starlette.types import ASGIApp, Message, Receive, Scope, Send

_NAMES = ("127.0.0.1", "localhost")
PLAIN = (
    "<!doctype html><html lang='en'><title>orthaug</title><body style='font:1rem "
    "system-ui;margin:3rem'>"
)
"""The beginning of a page that shows a message only."""
_REFUSED = (
    f"{PLAIN}<h1>This page needs its token</h1><p>Open the address that <code>orthaug "
    "app</code> printed in the terminal. It ends in <code>?token=…</code>.</p></body></html>"
)
_HEADERS = {
    "referrer-policy": "no-referrer",
    "x-content-type-options": "nosniff",
    "x-frame-options": "SAMEORIGIN",
    "cross-origin-resource-policy": "same-origin",
    "content-security-policy": (
        "default-src 'self' 'unsafe-inline' 'unsafe-eval' data: blob:; frame-ancestors 'self'; "
        "form-action 'self'; base-uri 'self'; object-src 'none'"
    ),
}


class Gate:
    """A guard before an application: requests and websockets without the token never reach it.

    The first request has the token in its query and is redirected without it; after that a separate
    secret in a cookie gives access. A ticket is a token for one request and useless afterwards.
    Other host names than this machine's are refused, so that no foreign name can be pointed here.
    Requests by pages of other origins are refused too.
    """

    def __init__(self, app: ASGIApp, port: int, token: str | None = None) -> None:
        self.app, self.port = app, port
        self.token = secrets.token_urlsafe(32) if token is None else token
        self.cookie = f"orthaug-{port}"  # cookies know no ports
        self._secret = secrets.token_urlsafe(32)  # of the cookie: no address contains it
        self._tickets: set[str] = set()

    @property
    def url(self) -> str:
        """Address of the page, with the token."""
        return f"http://127.0.0.1:{self.port}/?token={self.token}"

    def ticket(self) -> str:
        """Return an address that opens the page once.

        Every user of the machine can read the arguments of a browser.
        """
        token = secrets.token_urlsafe(32)
        self._tickets.add(token)
        return f"http://127.0.0.1:{self.port}/?token={token}"

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] not in ("http", "websocket"):
            await self.app(scope, receive, send)
            return
        headers = {
            name.decode("latin-1").lower(): value.decode("latin-1")
            for name, value in scope["headers"]
        }
        query = parse_qsl(scope.get("query_string", b"").decode("latin-1"), keep_blank_values=True)
        given = dict(query).get("token")
        comes = scope["type"] == "http" and scope["method"] in ("GET", "HEAD")
        allowed = self._from_here(headers) and (
            _equal_secrets(given, self.token)
            or _equal_secrets(self._cookie_of(headers), self._secret)
            or (comes and self._spend(given))
        )
        if not allowed:
            await _refuse(scope, send)
        elif comes and given is not None:
            rest = urlencode([(name, value) for name, value in query if name != "token"])
            path = "/" + quote(scope["path"].lstrip("/"))  # two slashes would be another host
            await self._sent_on(path + (f"?{rest}" if rest else ""), send)
        else:
            await self.app(scope, receive, _with_headers(send) if scope["type"] == "http" else send)

    def _from_here(self, headers: Mapping[str, str]) -> bool:
        hosts = {f"{name}:{self.port}" for name in _NAMES}
        origin = headers.get("origin")
        return headers.get("host", "") in hosts and (
            origin is None or origin in {f"http://{host}" for host in hosts}
        )

    def _cookie_of(self, headers: Mapping[str, str]) -> str | None:
        try:
            morsel = SimpleCookie(headers.get("cookie", "")).get(self.cookie)
        except CookieError:
            return None
        return None if morsel is None else morsel.value

    def _spend(self, token: str | None) -> bool:
        """Take a ticket; return whether it was still unused."""
        found = next((ticket for ticket in self._tickets if _equal_secrets(token, ticket)), None)
        self._tickets.discard(found or "")
        return found is not None

    async def _sent_on(self, place: str, send: Send) -> None:
        cookie = f"{self.cookie}={self._secret}; HttpOnly; SameSite=Strict; Path=/"
        headers = [(b"location", place.encode()), (b"set-cookie", cookie.encode())]
        headers += [
            (b"cache-control", b"no-store"),
            (b"referrer-policy", b"no-referrer"),
            (b"content-length", b"0"),
        ]
        await send({"type": "http.response.start", "status": 303, "headers": headers})
        await send({"type": "http.response.body", "body": b""})


def _equal_secrets(given: str | None, secret: str) -> bool:
    return given is not None and hmac.compare_digest(given.encode(), secret.encode())


async def _refuse(scope: Scope, send: Send) -> None:
    if scope["type"] == "websocket":
        await send({"type": "websocket.close", "code": 1008})
        return
    body = _REFUSED.encode()
    headers = [
        (b"content-type", b"text/html; charset=utf-8"),
        (b"content-length", str(len(body)).encode()),
    ]
    await send(
        {
            "type": "http.response.start",
            "status": 403,
            "headers": [*headers, (b"cache-control", b"no-store")],
        }
    )
    await send({"type": "http.response.body", "body": body})


def _with_headers(send: Send) -> Send:
    """Return a sender that marks every answer as one for this page only.

    Headers that an answer has already are kept.
    """

    async def send_with_headers(message: Message) -> None:
        if message["type"] == "http.response.start":
            own = list(message.get("headers", []))
            said = {name.lower() for name, _ in own}
            own += [(k.encode(), v.encode()) for k, v in _HEADERS.items() if k.encode() not in said]
            message = {**message, "headers": own}
        await send(message)

    return send_with_headers
