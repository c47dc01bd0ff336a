"""Ways to a device: what is wrong is one line, and what has come is not lost."""

import http.client
import http.server
import os
import socket
import threading
import time

import pytest

from imu_fusion.errors import DeviceError
from imu_fusion.sources.transports.connection import Connection
from imu_fusion.sources.transports.live import open_transport


def until(condition, timeout=20.0):
    deadline = time.monotonic() + timeout
    while not condition():
        assert time.monotonic() < deadline, "the event did not happen"
        time.sleep(0.005)


@pytest.fixture
def listener():
    with socket.create_server(("127.0.0.1", 0)) as server:
        yield server


def connection(address, request=lambda: None, **options):
    made = Connection(open_transport(address, request), lambda: None, **{
        "silence": None, "longest_pause": 0.2, "retries": True, **options})
    made.start()
    return made


def test_a_connection_on_which_nothing_comes_is_made_anew(listener):
    """Half-open TCP: the cable is out, and nobody says so."""
    made = connection(f"tcp://127.0.0.1:{listener.getsockname()[1]}", silence=0.2)
    accepted = [listener.accept()[0]]
    until(lambda: "silent for 0.2 s" in made.problem)
    accepted.append(listener.accept()[0])
    until(lambda: made.connections == 2)
    assert "silent" in made.problem    # that it can be opened is no news
    accepted[1].sendall(b"a")
    chunks = []
    until(lambda: chunks.extend(made.take()) or chunks)
    assert chunks[0].data == b"a" and chunks[0].begins and not made.problem
    made.stop()
    for each in accepted:
        each.close()


def test_without_retries_it_ends(listener):
    port = listener.getsockname()[1]
    made = connection(f"tcp://127.0.0.1:{port}", retries=False)
    accepted, _ = listener.accept()
    accepted.sendall(b"last words")
    accepted.close()
    until(lambda: made.ended)
    assert [c.data for c in made.take()] == [b"last words"]
    assert "closed the connection" in made.problem and made.connections == 1


def test_a_terminal_that_is_unplugged_is_said():
    ours, theirs = os.openpty()
    transport = open_transport(f"serial://{os.ttyname(theirs)}?baud=115200")
    transport.open()
    os.write(ours, b"x")
    assert transport.read(5.0) == [("", b"x")]
    os.close(theirs)
    os.close(ours)
    with pytest.raises(DeviceError, match="gone|closed"):
        for _ in range(3):
            transport.read(1.0)
    transport.close()


@pytest.mark.parametrize("status", [401, 404])
def test_an_answer_that_is_no_device_s_is_said(status):
    class Handler(http.server.BaseHTTPRequestHandler):
        def do_GET(self):
            self.send_error(status)

        def log_message(self, *_):
            pass

    with http.server.HTTPServer(("127.0.0.1", 0), Handler) as server:
        threading.Thread(target=server.handle_request, daemon=True).start()
        transport = open_transport(f"http://127.0.0.1:{server.server_port}", lambda: "/config")
        transport.open()
        with pytest.raises(DeviceError, match=f"answers {status} .* to /config"):
            transport.read(1.0)
        transport.close()


def test_what_is_posted_comes_and_what_is_too_large_does_not():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    transport = open_transport(f"http-push://127.0.0.1:{port}")
    transport.open()
    answers = []

    def post():
        for body, length in ((b"{}", "2"), (b"", "99999999999")):
            sender = http.client.HTTPConnection("127.0.0.1", port, timeout=10)
            sender.putrequest("POST", "/")
            sender.putheader("Content-Length", length)
            sender.endheaders(body)
            answers.append(sender.getresponse().status)

    thread = threading.Thread(target=post)
    thread.start()
    parts = []
    until(lambda: parts.extend(transport.read(0.1)) or len(answers) == 2)
    thread.join()
    transport.close()
    assert parts == [("", b"{}")] and answers == [200, 413]


def test_a_device_waits_while_nobody_takes(listener):
    """Memory is bounded: what is not taken stays with the sender."""
    made = connection(f"tcp://127.0.0.1:{listener.getsockname()[1]}")
    accepted, _ = listener.accept()
    accepted.setblocking(False)
    sent, data, idle = 0, bytes(1 << 16), 0
    while idle < 20:
        try:
            sent += accepted.send(data)
            idle = 0
        except BlockingIOError:
            idle += 1
            time.sleep(0.01)
        assert sent < 1 << 27
    taken = 0

    def take():
        nonlocal taken
        taken += sum(len(chunk.data) for chunk in made.take())
        return taken == sent

    until(take)
    made.stop()
    accepted.close()
