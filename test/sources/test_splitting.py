"""However the bytes are cut the samples are the same, and no bytes at all make a parser fail."""

import struct

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pyubx2 import GET, UBXMessage

from imu_fusion.errors import ImuFusionError
from imu_fusion.sources.description import Description
from imu_fusion.sources.gnss import Receiver
from imu_fusion.sources.gpx import Gpx
from imu_fusion.sources.phyphox_live import PhyphoxLive
from imu_fusion.sources.registry import FORMATS
from imu_fusion.sources.sensor_logger import SensorLoggerPush
from imu_fusion.sources.sketch import sketch
from imu_fusion.sources.table import TableSource
from imu_fusion.sources.ximu3 import Ximu3
from test.sources.logs import read, same

DESCRIPTION = Description.from_mapping({
    "time": {"column": "t", "unit": "us", "wrap": 65536.0, "start": 1.0},
    "accelerometer": {"columns": ["x", "y", "z"], "unit": "g"}}, "test")


def nmea(body):
    total = 0
    for byte in body.encode():
        total ^= byte
    return f"${body}*{total:02X}\r\n".encode()


def solution(second):
    return UBXMessage("NAV", "NAV-PVT", GET, iTOW=1000 * second, year=2026, month=3, day=4, hour=5,
                      min=6, second=second, validDate=1, validTime=1, fixType=3, gnssFixOk=1,
                      lat=47.5, lon=8.25 + second * 1e-3, height=500_000, velN=second,
                      sAcc=100).serialize()


def escaped(message):
    return message[:1] + message[1:].replace(b"\xdb", b"\xdb\xdd").replace(
        b"\n", b"\xdb\xdc") + b"\n"


STREAMS = {
    "ubx": (Receiver, b"".join(solution(k) + nmea(f"GPGLL,4717.1,N,00833.9,E,08172{k}.00,A")
                               + bytes([0xB5, k]) for k in range(4))),
    "nmea": (Receiver, b"".join(
        nmea(f"GPRMC,08360{k}.00,A,4717.11437,N,00833.91522,E,{k}.4,77.52,091202,,,A")
        + nmea(f"GPGGA,08360{k}.00,4717.11399,N,00833.91590,E,1,08,1.01,499.6,M,48.0,M,,")
        for k in range(4))),
    "ximu3": (Ximu3, b"".join(
        escaped(struct.pack("<BQ6f", 0xC9, 10 + k, k, 2, 3, 0, 0, 1)) + b"M,%d,1,.5,.25\r\n" % k
        for k in range(12))),
    "table": (lambda: TableSource(DESCRIPTION), b"t,x,y,z\n" + b"".join(
        b"%d,1,%d,.5\r\n" % (9000 * k % 65536, k) for k in range(20))),
    "gpx": (Gpx, b"<gpx><trk><trkseg>" + b"".join(
        b'<trkpt lat="47.%d" lon="8.5"><ele>400</ele><time>2026-01-02T03:04:0%dZ</time></trkpt>'
        % (k, k) for k in range(5)) + b"</trkseg></trk></gpx>")}


@pytest.mark.parametrize("name", STREAMS)
@settings(max_examples=40, deadline=None)
@given(cuts=st.lists(st.integers(0, 2000), max_size=12))
def test_cuts_change_nothing(name, cuts):
    make, data = STREAMS[name]
    source = make()
    cut = read(source, data, "part", sorted(c for c in cuts if c < len(data)))
    whole = make()
    expected = read(whole, data, "part")
    assert sum(map(len, expected.values())) >= 4
    assert same(cut, expected) and source.lost == whole.lost


LIVE = [Receiver, Ximu3, lambda: TableSource(DESCRIPTION, strict=False), PhyphoxLive,
        SensorLoggerPush]


@pytest.mark.parametrize("make", LIVE)
@settings(max_examples=60, deadline=None)
@given(pieces=st.lists(st.one_of(
    st.binary(max_size=200), st.sampled_from([data for _, data in STREAMS.values()]),
    st.sampled_from([b"{}", b"[]", b'{"inputs": [1]}', b'{"buffer": {"a": 1}}', b"t,x,y,z\n",
                     b'{"messageId": 1, "sessionId": 2, "payload": [{"name": "gyroscope", '
                     b'"time": -1, "x": 1e999}, 7]}'])), max_size=6),
    part=st.sampled_from(["/config", "/get", "/time", ""]))
def test_no_bytes_stop_a_stream(make, pieces, part):
    source = make()
    for piece in pieces:
        try:
            source.feed(piece, part)
        except ImuFusionError as error:    # such as a header without the columns described
            assert str(error)
    source.finish()


@pytest.mark.parametrize("make, part, data", [
    (PhyphoxLive, "/time", b'[{"event": "START", "experimentTime": 0, "systemTime": 1e999}]'),
    (PhyphoxLive, "/time", b'[{"event": "START", "experimentTime": 1e300, "systemTime": 2e9}]'),
    (SensorLoggerPush, "", b'{"messageId": Infinity, "sessionId": "s", "payload": []}'),
    (SensorLoggerPush, "", b'{"messageId": %s, "sessionId": "s", "payload": []}' % (b"9" * 400))])
def test_numbers_beyond_all_bounds_are_counted_and_stop_no_stream(make, part, data):
    source = make()
    assert not source.feed(data, part) and sum(source.lost.values()) == 1 and not source.finish()


@settings(max_examples=60, deadline=None)
@given(name=st.sampled_from(sorted(STREAMS)), data=st.data())
def test_damage_is_an_error_of_the_user_or_counted(name, data):
    make, sound = STREAMS[name]
    place = data.draw(st.integers(0, len(sound) - 1))
    broken = sound[:place] + data.draw(st.binary(max_size=8)) + sound[place + data.draw(
        st.integers(0, 20)):]
    try:
        read(make(), broken, "part")
    except ImuFusionError as error:
        assert str(error)
    for known in FORMATS.values():
        known.recognises({"part.csv": broken})
    try:
        sketch(broken, "part")
    except ImuFusionError as error:
        assert "part" in str(error)


def test_a_corrupted_frame_costs_itself_and_is_counted():
    broken = bytearray(solution(2))
    broken[40] ^= 0xFF
    data = solution(1) + bytes(broken) + solution(3)
    source = Receiver()
    found = read(source, data, cuts=range(7, len(data), 7))
    assert list(found["fix"].longitude_deg) == pytest.approx([8.251, 8.253])
    assert source.lost["frames of UBX whose checksum is wrong"] >= 1
