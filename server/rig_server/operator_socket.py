"""The running server's door for its operator: a Unix socket, one JSON object in, one out, a line each.

The file's mode admits the server's user and root, nobody else: whoever may write there may do what the
server may.
"""

import contextlib
import json
import logging
import os
import socket
import stat
import threading
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

from rig_protocol.errors import ConfigurationError, RigError

logger = logging.getLogger(__name__)

Request = Mapping[str, Any]
Answer = dict[str, Any]

SERVICE_SOCKET = Path("/run/kinect-rig/control.sock")
"""Where the installed service has it: systemd makes the folder (RuntimeDirectory=)."""
MAX_LINE = 64 << 10
_MODE = 0o600
_MOST_AT_ONCE = 4  # operators; more wait their turn
_REQUEST_TIMEOUT_S = 5.0
_ANSWER_TIMEOUT_S = 60.0


def own_socket() -> Path | None:
    """Where a server that a user runs by hand has it; None where the session has no folder for that."""
    folder = os.environ.get("XDG_RUNTIME_DIR")
    return Path(folder) / "kinect-rig" / "control.sock" if folder else None


@contextlib.contextmanager
def operator_served(path: Path | None, answer: Callable[[Request], Answer]) -> Iterator[None]:
    """Answer the operator's requests meanwhile, at `path`, else where it is usual and possible.

    ConfigurationError when `path` was asked for and cannot be had.
    """
    try:
        door = OperatorSocket(path or _usual_place(), answer)
    except (OSError, ConfigurationError) as error:
        if path is not None:
            raise ConfigurationError(f"control_socket {path}: {error}") from error
        logger.info("rig-server control will not reach this server: %s", error)
        yield
        return
    with contextlib.closing(door):
        yield


class OperatorSocket:
    """Listens from construction to `close`."""

    def __init__(self, path: Path, answer: Callable[[Request], Answer]) -> None:
        """OSError when the path cannot be used, ConfigurationError when another server listens there.

        `answer` is called on threads of this object; a RigError that it raises is told to the operator.
        """
        self._path, self._answer = path, answer
        _remove_dead(path)
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        try:
            os.fchmod(self._socket.fileno(), _MODE)  # before the file exists: it never has another mode
            self._socket.bind(str(path))
            self._inode = path.stat().st_ino
            self._socket.listen(_MOST_AT_ONCE)
        except OSError:
            self._socket.close()
            raise
        self._places = threading.Semaphore(_MOST_AT_ONCE)
        self._thread = threading.Thread(target=self._listen, name="operator socket", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Listen no more; harmless when closed."""
        with contextlib.suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)  # wakes up the thread, which `close` alone does not
        self._thread.join()
        self._socket.close()
        with contextlib.suppress(OSError):
            if self._path.stat().st_ino == self._inode:
                self._path.unlink()

    def _listen(self) -> None:
        while True:
            self._places.acquire()
            try:
                connection, _ = self._socket.accept()
            except OSError:  # closed
                return
            threading.Thread(target=self._serve, args=(connection,), name="operator", daemon=True).start()

    def _serve(self, connection: socket.socket) -> None:
        try:
            with connection, contextlib.suppress(OSError):  # an operator who leaves is no trouble
                connection.settimeout(_REQUEST_TIMEOUT_S)
                with connection.makefile("rwb") as stream:
                    answer = self._answered(stream.readline(MAX_LINE))
                    stream.write(json.dumps(answer).encode() + b"\n")
        finally:
            self._places.release()

    def _answered(self, line: bytes) -> Answer:
        try:
            request = json.loads(line)
            if not isinstance(request, dict):
                raise ConfigurationError("a request is one JSON object in a line")
            return {"error": None, **self._answer(request)}
        except RigError as error:
            return {"error": str(error), "exit_status": error.exit_status}
        except (ValueError, RecursionError) as error:
            return {"error": f"a request is one JSON object in a line: {error}", "exit_status": 2}
        except Exception as error:  # the thread's boundary: the rig goes on, and the operator hears of it
            logger.exception("a request of the operator failed")
            return {"error": f"the server failed to do it: {error!r}", "exit_status": 1}


def ask_server(path: Path | None, request: Request) -> Answer:
    """The running server's answer; RigError where none runs, or with what it says."""
    places = [path] if path else [place for place in (SERVICE_SOCKET, own_socket()) if place is not None]
    connection, tried = None, []
    for place in places:
        try:
            connection = _connected(place)
            break
        except OSError as error:
            tried.append(f"{place}: {error.strerror or error}")
    if connection is None:
        raise RigError(
            f"no running rig-server can be reached ({'; '.join(tried)}): start one, name its "
            "`control_socket` with --socket, or use sudo where it is another user's"
        )
    try:
        with connection, connection.makefile("rwb") as stream:
            stream.write(json.dumps(request).encode() + b"\n")
            stream.flush()
            answer = json.loads(stream.readline())
    except (OSError, ValueError) as error:
        raise RigError(f"the server ended before it answered: {error}") from error
    if answer["error"] is not None:
        kind = ConfigurationError if answer["exit_status"] == ConfigurationError.exit_status else RigError
        raise kind(answer["error"])
    return dict(answer)


def _connected(path: Path) -> socket.socket:
    connection = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    connection.settimeout(_ANSWER_TIMEOUT_S)
    try:
        connection.connect(str(path))
    except OSError:
        connection.close()
        raise
    return connection


def _usual_place() -> Path:
    """The service's folder where it is ours, else the session's; OSError where there is neither."""
    if os.access(SERVICE_SOCKET.parent, os.W_OK):
        return SERVICE_SOCKET
    place = own_socket()
    if place is None:
        raise FileNotFoundError("there is no $XDG_RUNTIME_DIR; set `control_socket` in rig.toml")
    place.parent.mkdir(mode=0o700, exist_ok=True)
    return place


def _remove_dead(path: Path) -> None:
    """Make way for a socket where a server that was killed left its own."""
    try:
        if not stat.S_ISSOCK(path.lstat().st_mode):
            raise ConfigurationError(f"{path} exists and is no socket")
        _connected(path).close()
    except FileNotFoundError:
        return
    except ConnectionRefusedError:
        path.unlink()
    else:
        raise ConfigurationError(f"another rig-server listens at {path}")
