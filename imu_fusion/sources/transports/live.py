"""Ports and the network: each transport opens, waits a little for bytes, and closes.

| address | what it does |
|---|---|
| ``serial:///dev/ttyACM0?baud=115200`` | a serial port, or a pseudo terminal |
| ``tcp://host:port`` | connects |
| ``udp://0.0.0.0:port`` | listens; each datagram ends a line |
| ``http://host:port?interval=0.05`` | asks the device what its format wants to know |
| ``http-push://0.0.0.0:port`` | listens for what a device posts |
"""

import contextlib
import errno
import http.client
import http.server
import os
import select
import socket
import termios
import time
import tty
from collections.abc import Callable
from urllib.parse import SplitResult, parse_qs, urlsplit

from imu_fusion.errors import DeviceError, ParameterError

Parts = list[tuple[str, bytes]]
"""(part, bytes) as a Source takes them."""

_PIECE = 1 << 16
_CONNECT = 3.0            # s, that a device has to answer
_LARGEST = 1 << 26        # bytes of one answer, or of what is posted
_BAUDS = {int(name[1:]): getattr(termios, name) for name in dir(termios)
          if name[0] == "B" and name[1:].isdecimal() and name != "B0"}


class Transport:
    """A way to a device.

    ``is_open_ended`` tells that silence means nothing: who listens cannot know whether anybody is
    there.
    """

    is_open_ended = False

    def __init__(self, address: str) -> None:
        self.address = address

    def open(self) -> None:
        """Connect, or begin to listen; DeviceError says why not."""
        raise NotImplementedError

    def read(self, wait: float) -> Parts:
        """What has come, after at most so many s; DeviceError if the device is gone."""
        raise NotImplementedError

    def close(self) -> None:
        """Let go of it; may be called at any time."""


class _Descriptor(Transport):
    """What is read from a file descriptor."""

    _file = -1

    def read(self, wait: float) -> Parts:
        try:
            if not select.select([self._file], [], [], wait)[0]:
                return []
            data = self._take()
        except (OSError, ValueError) as error:
            raise DeviceError(f"{self.address}: {_why(error)}") from None
        if not data:
            raise DeviceError(f"{self.address}: the device has closed the connection")
        return [("", data)]

    def _take(self) -> bytes:
        return os.read(self._file, _PIECE)

    def close(self) -> None:
        if self._file >= 0:
            with contextlib.suppress(OSError):
                os.close(self._file)
            self._file = -1


class Serial(_Descriptor):
    """A serial port."""

    def __init__(self, address: str, path: str, baud: int) -> None:
        super().__init__(address)
        if baud not in _BAUDS:
            raise ParameterError(f"transport {address}: {baud} baud is no rate of a port; there "
                                 f"are {', '.join(map(str, sorted(_BAUDS)))}")
        self._path, self._baud = path, _BAUDS[baud]

    def open(self) -> None:
        try:
            self._file = os.open(self._path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
            tty.setraw(self._file)
            settings = termios.tcgetattr(self._file)
            settings[4] = settings[5] = self._baud
            settings[2] |= termios.CLOCAL | termios.CREAD
            termios.tcsetattr(self._file, termios.TCSANOW, settings)
            termios.tcflush(self._file, termios.TCIFLUSH)    # what is older than we are
        except (OSError, termios.error) as error:
            self.close()
            raise DeviceError(f"{self.address}: {_why(error)}") from None


class Tcp(_Descriptor):
    """A connection to a device that listens."""

    def __init__(self, address: str, host: str, port: int) -> None:
        super().__init__(address)
        self._host, self._port = host, port

    def open(self) -> None:
        try:
            connection = socket.create_connection((self._host, self._port), _CONNECT)
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            connection.setblocking(False)
            self._file = connection.detach()
        except OSError as error:
            raise DeviceError(f"{self.address}: {_why(error)}") from None


class Udp(_Descriptor):
    """Datagrams that are sent here."""

    is_open_ended = True

    def __init__(self, address: str, host: str, port: int) -> None:
        super().__init__(address)
        self._host, self._port = host, port

    def open(self) -> None:
        try:
            listener = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 22)
            listener.bind((self._host, self._port))
            self._file = listener.detach()
        except OSError as error:
            raise DeviceError(f"{self.address}: {_why(error)}") from None

    def _take(self) -> bytes:
        data = os.read(self._file, _PIECE)
        return data if data.endswith(b"\n") else data + b"\n"


class HttpPoll(Transport):
    """Asks a device by GET.

    Args:
        request: what to ask next, a path; None: nothing for now.
        interval: s from one question to the next.
    """

    def __init__(self, address: str, host: str, port: int, request: Callable[[], str | None],
                 interval: float) -> None:
        super().__init__(address)
        self._connection = http.client.HTTPConnection(host, port, timeout=_CONNECT)
        self._request, self._interval, self._next = request, interval, 0.0

    def open(self) -> None:
        try:
            self._connection.connect()
        except OSError as error:
            raise DeviceError(f"{self.address}: {_why(error)}") from None

    def read(self, wait: float) -> Parts:
        pause = self._next - time.monotonic()
        if pause > 0.0:
            time.sleep(min(pause, wait))
            if pause > wait:
                return []
        path = self._request()
        if path is None:
            time.sleep(wait)
            return []
        self._next = time.monotonic() + self._interval
        try:
            self._connection.request("GET", path)
            answer = self._connection.getresponse()
            data = answer.read(_LARGEST)
        except (OSError, http.client.HTTPException) as error:
            raise DeviceError(f"{self.address}: {_why(error)}") from None
        # What an older version does not know is answered by nothing, and the format goes on.
        if answer.status != http.HTTPStatus.OK and path == "/config":
            raise DeviceError(f"{self.address}: answers {answer.status} {answer.reason} to {path}; "
                              "is remote access switched on, and is this the right address?")
        return [(path, data if answer.status == http.HTTPStatus.OK else b"")]

    def close(self) -> None:
        self._connection.close()


class HttpPush(Transport):
    """Takes what a device posts."""

    is_open_ended = True

    def __init__(self, address: str, host: str, port: int) -> None:
        super().__init__(address)
        self._host, self._port = host, port
        self._server: http.server.HTTPServer | None = None
        self._posted: list[bytes] = []

    def open(self) -> None:
        posted = self._posted

        class Handler(http.server.BaseHTTPRequestHandler):
            timeout = _CONNECT

            def do_POST(self) -> None:
                size = self.headers.get("Content-Length", "")
                if not size.isdecimal() or int(size) > _LARGEST:
                    self.send_error(http.HTTPStatus.REQUEST_ENTITY_TOO_LARGE)
                    return
                data = self.rfile.read(int(size))
                if len(data) == int(size):
                    posted.append(data)
                self.send_response(http.HTTPStatus.OK)
                self.send_header("Content-Length", "0")
                self.end_headers()

            def log_message(self, *_: object) -> None:
                """Nothing: the node says what matters."""

        try:
            self._server = http.server.HTTPServer((self._host, self._port), Handler)
        except OSError as error:
            raise DeviceError(f"{self.address}: {_why(error)}") from None

    def read(self, wait: float) -> Parts:
        assert self._server is not None
        self._server.timeout = wait
        try:
            self._server.handle_request()
        except OSError as error:
            raise DeviceError(f"{self.address}: {_why(error)}") from None
        parts = [("", data) for data in self._posted]
        self._posted.clear()
        return parts

    def close(self) -> None:
        if self._server is not None:
            self._server.server_close()
            self._server = None


def _why(error: Exception) -> str:
    """The reason in words, with the remedy where it is known."""
    number = getattr(error, "errno", None)
    words = getattr(error, "strerror", None) or str(error) or type(error).__name__
    if isinstance(error, TimeoutError):
        words = "does not answer"
    if number == errno.EACCES:
        words += "; may this user open it (group dialout)?"
    if number == errno.ENOENT:
        words = "no such port; is the device plugged in?"
    if number == errno.EIO:
        words = "the device is gone"
    return words


def open_transport(address: str, request: Callable[[], str | None] = lambda: None) -> Transport:
    """The transport of an address, not opened yet.

    Args:
        address: see the module. request: see HttpPoll.

    Raises:
        ParameterError: the address is not of one of these forms.
    """
    url = urlsplit(address)
    if url.scheme == "serial":
        return Serial(address, url.path, int(_number(address, url, "baud", 115200)))
    known: dict[str, Callable[[str, int], Transport]] = {
        "tcp": lambda host, port: Tcp(address, host, port),
        "udp": lambda host, port: Udp(address, host, port),
        "http": lambda host, port: HttpPoll(address, host, port, request,
                                            _number(address, url, "interval", 0.05)),
        "http-push": lambda host, port: HttpPush(address, host, port)}
    if url.scheme not in known:
        raise ParameterError(f"transport '{address}': expected serial://, {'://, '.join(known)}:// "
                             "or file://")
    try:
        port = url.port
    except ValueError:
        port = None
    if url.scheme == "http" and port is None and url.hostname:
        port = 80
    if not url.hostname or port is None:
        raise ParameterError(f"transport '{address}': expected {url.scheme}://HOST:PORT")
    return known[url.scheme](url.hostname, port)


def _number(address: str, url: SplitResult, name: str, default: float) -> float:
    """A number behind the question mark, of the type of its default."""
    given = parse_qs(url.query)
    wrong = sorted(set(given) - {name})
    if wrong:
        raise ParameterError(f"transport '{address}': '{wrong[0]}' is unknown; known: {name}")
    text = given.get(name, [str(default)])[0]
    try:
        value = type(default)(text)
        if not 0 < value < 1e9:
            raise ValueError
    except ValueError:
        raise ParameterError(f"transport '{address}': {name} '{text}' is not a number above zero"
                             ) from None
    return value
