"""Who may use the console: whoever brings its token, from a page of its own."""

import hmac
import os
import secrets
import stat
from pathlib import Path

from aiohttp import web

from rig_protocol.errors import ConfigurationError

_LEAST_LENGTH, _MOST_BYTES = 16, 1024
_SAFE_METHODS = ("GET", "HEAD")
_BEARER = "Bearer "


def console_token(file: Path | None) -> str:
    """The token of `file`, which its owner alone may read; without a file a random one."""
    if file is None:
        return secrets.token_urlsafe(24)
    try:
        with file.open("rb") as opened:
            mode = stat.S_IMODE(os.fstat(opened.fileno()).st_mode)
            text = opened.read(_MOST_BYTES).decode("ascii").strip()
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigurationError(f"console.token_file {file} cannot be read: {error}") from error
    if mode & 0o077:
        raise ConfigurationError(f"console.token_file {file} has mode {mode:04o}: chmod 600 {file}")
    if len(text) < _LEAST_LENGTH or not text.isprintable() or " " in text:
        raise ConfigurationError(
            f"console.token_file {file} holds no token of at least {_LEAST_LENGTH} characters: "
            f"openssl rand -hex 24 > {file}"
        )
    return text


class Gate:
    """Compares tokens in constant time. The cookie is the port's own: cookies know no ports."""

    def __init__(self, token: str, port: int) -> None:
        self._token = token.encode()
        self.cookie = f"rig-console-{port}"

    def is_token(self, text: str) -> bool:
        """Whether it is the token."""
        return hmac.compare_digest(text.encode("utf-8", "replace"), self._token)

    def refusal(self, request: web.Request) -> str | None:
        """Why a request is not answered, in a sentence; None for one that brings the token.

        A browser sends the cookie along on whatever page's behalf: what changes something or opens a socket
        must come from a page of ours. A program sends `Authorization: Bearer TOKEN` and no Origin.
        """
        header = request.headers.get("Authorization", "")
        if header.startswith(_BEARER) and self.is_token(header.removeprefix(_BEARER)):
            return None
        if not self.is_token(request.cookies.get(self.cookie, "")):
            return "this console wants its token: open the link that rig-server printed when it started"
        harmless = request.method in _SAFE_METHODS and "Upgrade" not in request.headers
        # Either scheme: there may be a proxy that speaks TLS in front of us.
        if harmless or request.headers.get("Origin") in (f"http://{request.host}", f"https://{request.host}"):
            return None
        return "the console takes orders from its own page alone"
