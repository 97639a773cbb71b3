"""Who may talk to the review pages: host names, origins, the access token, strict headers."""

import hmac
import ipaddress
import socket
from dataclasses import dataclass
from urllib.parse import urlencode, urlsplit

from starlette.datastructures import Headers, MutableHeaders
from starlette.requests import HTTPConnection
from starlette.responses import PlainTextResponse, RedirectResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

LOOPBACK_NAMES = frozenset({"127.0.0.1", "localhost", "::1"})
COOKIE = "robot_gst_token"

HEADERS = {
    "Content-Security-Policy": (
        "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; "
        "media-src 'self'; connect-src 'self'; form-action 'self'; "
        "base-uri 'none'; frame-ancestors 'none'"
    ),
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Permissions-Policy": "camera=(), microphone=(), geolocation=()",
}


def is_loopback(host: str) -> bool:
    """Say whether a host to listen on can only be reached from this machine."""
    if host in LOOPBACK_NAMES:
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def host_name(header: str) -> str:
    """Return the name in a Host header without its port; "" when it is malformed."""
    if header.startswith("["):
        name, closed, rest = header[1:].partition("]")
        return name.lower() if closed and (not rest or rest.startswith(":")) else ""
    name, _, port = header.partition(":")
    return name.lower() if not port or port.isdigit() else ""


@dataclass(frozen=True, kw_only=True)
class Admission:
    """Which Host headers are answered, and the token to show, if any."""

    host: str = "127.0.0.1"
    """The address listened on."""
    token: str | None = None
    """Required when the address can be reached from outside."""

    def admits_host(self, name: str) -> bool:
        """Refuse names that a foreign page could have pointed at us (DNS rebinding)."""
        if name in LOOPBACK_NAMES or name == self.host.lower():
            return True
        if is_loopback(self.host):
            return False
        if name == socket.gethostname().lower():
            return True
        try:
            ipaddress.ip_address(name)
        except ValueError:
            return False
        return True


class Guard:
    """ASGI middleware that lets in whoever may be here, with strict headers on every answer.

    400 on a foreign host; 403 without the token, and to a page of another origin that would write.
    """

    def __init__(self, app: ASGIApp, admission: Admission) -> None:
        """Wrap an application."""
        self._app = app
        self._admission = admission

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer one request."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return

        async def send_with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                for name, value in HEADERS.items():
                    headers[name] = value
                headers.setdefault("Cache-Control", "no-store")
            await send(message)

        refusal = self._refusal(scope)
        await (refusal or self._app)(scope, receive, send_with_headers)

    def _refusal(self, scope: Scope) -> ASGIApp | None:
        asked = HTTPConnection(scope)
        headers = asked.headers
        name = host_name(headers.get("host", ""))
        if not self._admission.admits_host(name):
            return PlainTextResponse(
                "This server does not answer to that host name; use the address it printed.\n",
                status_code=400,
            )
        if scope["method"] not in ("GET", "HEAD") and not _is_own_origin(headers):
            return PlainTextResponse(
                "Only a page of this server may change something here (Origin header).\n",
                status_code=403,
            )
        token = self._admission.token
        if token is None or _same(asked.cookies.get(COOKIE, ""), token):
            return None
        query = asked.query_params.multi_items()
        if _same(dict(query).get("token", ""), token):
            return _remember_token(scope["path"], query, token)
        return PlainTextResponse(
            "A token is needed: open the address that robot-gst dashboard printed.\n",
            status_code=403,
        )


def _remember_token(path: str, query: list[tuple[str, str]], token: str) -> ASGIApp:
    rest = urlencode([(key, value) for key, value in query if key != "token"])
    path = "/" + path.lstrip("/\\")  # "//host" would lead to another host
    response = RedirectResponse(path + (f"?{rest}" if rest else ""), status_code=303)
    response.set_cookie(COOKIE, token, httponly=True, samesite="strict")
    return response


def _is_own_origin(headers: Headers) -> bool:
    """Say whether a page of this very server asks; a browser tells the origin of every POST."""
    try:
        origin = urlsplit(headers.get("origin", ""))
    except ValueError:
        return False
    own = headers.get("host", "").lower()
    return origin.scheme in ("http", "https") and origin.netloc.lower() == own


def _same(found: str, wanted: str) -> bool:
    return hmac.compare_digest(found.encode(), wanted.encode())
