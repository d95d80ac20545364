"""Live Link Face and OSC, as independent decoders read them: values, names, order, rate and time."""

from __future__ import annotations

import logging
import socket
import struct
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from pylivelinkface import FaceBlendShape, PyLiveLinkFace
from pythonosc.osc_bundle import OscBundle
from pythonosc.osc_message import OscMessage
from pythonosc.osc_packet import OscPacket
from scipy.spatial.transform import Rotation

from facediff.live.frames import Performance, open_receiver
from facediff.live.receivers.sending import Outbox
from facediff.spaces import Space
from facediff.spaces.arkit import ARKIT
from facediff.spaces.files.clips import ParameterClip
from facediff.spaces.files.csv_files import live_link_header, live_link_rows
from facediff.spaces.layouts import layout
from facediff.spaces.visemes import visemes
from tests.fakes.waiting import PATIENCE
from tests.live.conftest import FRAME_RATE, Opened, frame, weights_of

SIXTY_ONE = 61


class Listener:
    """A UDP socket of this machine, and what arrived at it."""

    def __init__(self, port: int = 0) -> None:
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind(("127.0.0.1", port))
        self.socket.settimeout(PATIENCE)
        self.port = self.socket.getsockname()[1]

    def take(self, count: int = 1) -> list[bytes]:
        return [self.socket.recv(65536) for _ in range(count)]


@pytest.fixture
def listener() -> Iterator[Listener]:
    made = Listener()
    yield made
    made.socket.close()


def decode(data: bytes) -> dict[str, object]:
    """A Live Link Face datagram, from the description of its fields alone."""
    found: dict[str, object] = {"version": data[0]}
    at = 1
    for name in ("device", "subject"):
        (length,) = struct.unpack_from(">i", data, at)
        found[name] = data[at + 4 : at + 4 + length].decode("ascii")
        at += 4 + length
    fields = struct.unpack_from(">ifiiB", data, at)
    found |= dict(zip(("number", "part", "rate", "per", "count"), fields, strict=True))
    at += struct.calcsize(">ifiiB")
    found["values"] = struct.unpack_from(">61f", data, at)
    assert len(data) == at + SIXTY_ONE * 4
    assert (found["version"], len(str(found["device"])), found["count"]) == (6, 36, SIXTY_ONE)
    return found


def test_a_public_decoder_reads_each_weight_under_its_name(opened: Opened, listener: Listener) -> None:
    receiver = opened(f"livelink://127.0.0.1:{listener.port}?subject=Bob")
    receiver.send(frame(3))
    (data,) = listener.take()
    seen, face = PyLiveLinkFace.decode(data)
    assert seen
    assert (face.name, face.fps) == ("Bob", 30)
    for name, weight in zip(ARKIT, weights_of(3), strict=True):
        shape = FaceBlendShape[name[0].upper() + name[1:]]
        assert face.get_blendshape(shape) == pytest.approx(weight, abs=1e-7), name
    rotations = [face.get_blendshape(shape) for shape in FaceBlendShape if shape.value >= len(ARKIT)]
    assert rotations == pytest.approx([0.0] * 3 + mirrored_gaze(weights_of(3)), abs=1e-6)


def mirrored_gaze(weights: NDArray[np.floating]) -> list[float]:
    """Yaw to the right, pitch down and roll of both eyes, radians."""
    look = dict(zip(ARKIT, weights.tolist(), strict=True))
    turns = []
    for side, outwards in (("Left", -1), ("Right", 1)):
        yaw = outwards * 0.60 * (look[f"eyeLookOut{side}"] - look[f"eyeLookIn{side}"])
        pitch = 0.61 * look[f"eyeLookDown{side}"] - 0.44 * look[f"eyeLookUp{side}"]
        turns += [yaw, pitch, yaw * pitch]
    return turns


def test_a_head_that_turns_is_sent_as_a_table_has_it(opened: Opened, listener: Listener) -> None:
    yaw, pitch, roll = 0.3, -0.2, 0.1
    turn = Rotation.from_euler("YXZ", [yaw, pitch, roll]).as_rotvec()
    moved = replace(frame(3), head=np.array([*turn, 0.01, 0.02, 0.03]))
    opened(f"livelink://127.0.0.1:{listener.port}").send(moved)
    values = decode(listener.take()[0])["values"]
    expected = ParameterClip("nod", np.array([[*weights_of(3), yaw, pitch, roll, *[0] * 6]]), layout("live_link"), 30)
    written = dict(zip(live_link_header(), next(iter(live_link_rows(expected))), strict=True))
    columns = [float(written[name]) for name in ("HeadYaw", "HeadPitch", "HeadRoll")]
    assert values[len(ARKIT) : len(ARKIT) + 3] == pytest.approx(columns, abs=1e-6)  # type: ignore[index]
    assert abs(columns[0]) == pytest.approx(yaw, abs=1e-6)
    opened(f"osc://127.0.0.1:{listener.port}").send(moved)
    found = {each.address: each.params for each in messages(listener.take(2))}
    assert found["/facediff/head"] == pytest.approx([yaw, pitch, roll], abs=1e-6)


def test_timecodes_are_the_time_of_day_and_miss_dropped_frames(opened: Opened, listener: Listener) -> None:
    receiver = opened(f"livelink://127.0.0.1:{listener.port}")
    local = time.localtime()
    began = local.tm_hour * 3600 + local.tm_min * 60 + local.tm_sec
    for index in (10, 11, 15, 16):
        receiver.send(frame(index))
    numbers = [int(str(decode(data)["number"])) for data in listener.take(4)]
    assert np.diff(numbers).tolist() == [1, 4, 1]
    assert 0 <= numbers[0] / FRAME_RATE - began < 3 or began > 24 * 3600 - 5


def test_a_timecode_starts_again_at_midnight(
    opened: Opened, listener: Listener, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("facediff.live.receivers.live_link.seconds_of_day", lambda: 24 * 3600 - 0.05)
    receiver = opened(f"livelink://127.0.0.1:{listener.port}")
    for index in range(3):
        receiver.send(frame(index))
    last = 24 * 3600 * 30
    assert [decode(data)["number"] for data in listener.take(3)] == [last - 2, last - 1, 0]


def test_a_broadcast_frame_rate_is_a_fraction(listener: Listener, performance: Performance) -> None:
    receiver = open_receiver(f"livelink://127.0.0.1:{listener.port}")
    receiver.open(replace(performance, frame_rate=30000 / 1001))
    receiver.send(frame(0))
    found = decode(listener.take()[0])
    receiver.close()
    assert (found["rate"], found["per"]) == (30000, 1001)


def messages(packets: list[bytes]) -> list[OscMessage]:
    """All messages, in their order."""
    found: list[OscMessage] = []
    for packet in packets:
        assert len(packet) <= 1400
        assert OscBundle.dgram_is_bundle(packet)
        found += [timed.message for timed in OscPacket(packet).messages]
    return found


def test_a_vmc_frame_is_ready_time_weights_and_apply(opened: Opened, listener: Listener) -> None:
    receiver = opened(f"vmc://127.0.0.1:{listener.port}")
    receiver.send(frame(7))
    found = messages(listener.take(2))
    assert [(each.address, each.params) for each in found[:1]] == [("/VMC/Ext/OK", [1])]
    assert found[1].address == "/VMC/Ext/T"
    assert found[1].params == [pytest.approx(7 / FRAME_RATE)]
    assert (found[-1].address, found[-1].params) == ("/VMC/Ext/Blend/Apply", [])
    values = found[2:-1]
    assert {each.address for each in values} == {"/VMC/Ext/Blend/Val"}
    assert [each.params[0] for each in values] == [name[0].upper() + name[1:] for name in ARKIT]
    np.testing.assert_allclose([each.params[1] for each in values], weights_of(7), atol=1e-7)


def test_vmc_names_may_be_vrms_vowels_and_blinks(opened: Opened, listener: Listener) -> None:
    opened(f"vmc://127.0.0.1:{listener.port}?names=vrm").send(frame(3))
    values = {each.params[0]: each.params[1] for each in messages(listener.take(1))[2:-1]}
    assert list(values) == ["A", "I", "U", "E", "O", "Blink", "Blink_L", "Blink_R"]
    expected = visemes(weights_of(3)[None], Space("arkit", ARKIT), "vrm")[0][0]
    np.testing.assert_allclose(list(values.values()), expected, atol=1e-6)


def test_plain_osc_has_an_address_for_each_weight(opened: Opened, listener: Listener) -> None:
    opened(f"osc://127.0.0.1:{listener.port}").send(frame(5, dropped=2))
    found = {each.address: each.params for each in messages(listener.take(2))}
    index, seconds, lag, dropped = found.pop("/facediff/frame")
    assert found.pop("/facediff/head") == [0.0, 0.0, 0.0]
    assert (index, dropped) == (5, 2)
    assert seconds == pytest.approx(5 / FRAME_RATE)
    assert 0.1 <= lag < 5
    assert found == {
        f"/facediff/weight/{name}": [pytest.approx(weight)] for name, weight in zip(ARKIT, weights_of(5), strict=True)
    }


NUMBER: dict[str, Callable[[bytes], int | None]] = {
    "livelink": lambda data: int(str(decode(data)["number"])),
    "vmc": lambda data: next((round(m.params[0] * FRAME_RATE) for m in messages([data]) if "Ext/T" in m.address), None),
    "osc": lambda data: next((m.params[0] for m in messages([data]) if m.address.endswith("/frame")), None),
}


@pytest.mark.parametrize("scheme", ["livelink", "vmc", "osc"])
def test_each_frame_arrives_before_the_next_one_is_sent(opened: Opened, listener: Listener, scheme: str) -> None:
    receiver = opened(f"{scheme}://127.0.0.1:{listener.port}")
    arrived: list[int] = []
    for index in range(60):
        receiver.send(frame(index))
        while (number := NUMBER[scheme](listener.take()[0])) is None:
            pass  # a datagram without the frame's number
        arrived.append(number)
    assert (np.diff(arrived) == 1).all()


def test_a_receiver_that_is_gone_is_counted_and_found_again(opened: Opened, caplog: pytest.LogCaptureFixture) -> None:
    listener = Listener()
    receiver = opened(f"livelink://127.0.0.1:{listener.port}")
    receiver.send(frame(0))
    listener.take()
    listener.socket.close()
    for index in range(1, 20):
        receiver.send(frame(index))
    assert "refused" in receiver.status()
    assert len([record for record in caplog.records if "no program listens" in record.message]) == 1
    back = Listener(listener.port)
    for index in range(20, 24):
        receiver.send(frame(index))
    assert decode(back.take()[0])["subject"] == "Ann"
    back.socket.close()
    receiver.close()
    receiver.send(frame(24))  # after the end: nothing
    receiver.close()


def test_another_machine_is_warned_of_and_this_one_is_not(caplog: pytest.LogCaptureFixture) -> None:
    for text in ("livelink", "vmc", "osc", "livelink://localhost", "vmc://[::1]:39539"):
        open_receiver(text)
    assert not caplog.records
    with caplog.at_level(logging.WARNING):
        open_receiver("vmc://192.0.2.1")
    assert ["leave this machine" in record.message for record in caplog.records] == [True]


def test_shapes_that_a_face_lacks_stay_at_zero_and_others_are_left_out(
    listener: Listener, performance: Performance
) -> None:
    receiver = open_receiver(f"osc://127.0.0.1:{listener.port}")
    receiver.open(replace(performance, shapes=("wink", "jawOpen", "HeadYaw", "HeadPitch", "HeadRoll")))
    receiver.send(replace(frame(0), weights=np.array([0.9, 0.25, 0.3, -0.2, 0.1], np.float32)))
    found = {each.address: each.params for each in messages(listener.take(2))}
    receiver.close()
    assert found.pop("/facediff/weight/jawOpen") == [0.25]
    found.pop("/facediff/frame")
    assert found.pop("/facediff/head") == pytest.approx([0.3, -0.2, 0.1])  # of a model of channels
    assert len(found) == 51
    assert all(value == [0.0] for value in found.values())


def test_a_slow_writer_loses_the_oldest_and_never_blocks() -> None:
    taken: list[int] = []
    begun, go = threading.Event(), threading.Event()

    def slowly(item: int) -> None:
        begun.set()
        go.wait()
        taken.append(item)

    outbox = Outbox(slowly, 3, "test")
    outbox.put(-1)
    begun.wait(PATIENCE)
    for item in range(100):
        outbox.put(item)
    go.set()
    outbox.close(PATIENCE)
    assert taken == [-1, 97, 98, 99]
    assert outbox.dropped == 97
