"""Live Link Face: the datagrams that Epic's app of this name sends to Unreal Engine.

One datagram for each frame; numbers are big-endian (network order), as senders and decoders in public state them:

======================  ==========  ===================================================================
field                   bytes       meaning
======================  ==========  ===================================================================
version                 1           6
device                  4 + n       length, and a text that tells senders apart, here a UUID
subject                 4 + n       length, and the name of the face in Live Link
frame number            4           of the timecode: frames since midnight
part of a frame         4           float from 0 to below 1
frame rate              4 + 4       numerator and denominator
count                   1           61
values                  61 × 4      floats: 52 weights from 0 to 1, yaw, pitch and roll of head and eyes in radians
======================  ==========  ===================================================================
"""

from __future__ import annotations

import struct
import uuid
from datetime import datetime
from fractions import Fraction

import numpy as np

from facediff.errors import FaceDiffError
from facediff.live.frames import OPTION, Address, LiveFrame, Performance
from facediff.live.receivers.sending import ArkitWeights, UdpReceiver
from facediff.registry import receiver
from facediff.spaces.arkit import ARKIT, ROTATIONS, left_first
from facediff.spaces.files.csv_files import gaze, mirrored

VERSION = 6
LONGEST_NAME = 64
DAY = 24 * 3600

ORDER = left_first(ARKIT)
"""Names of the 52 weights in the order of the values. The app's recordings (.csv) have another one."""


@receiver.register("livelink")
class LiveLink(UdpReceiver):
    """Unreal Engine's Live Link Face: weights of ARKit's shapes by UDP.

    The timecode begins at the time of day at which the first frame is sent and goes on with the numbers of the frames:
    where frames were dropped, numbers are missing. Rotations of head and eyes come from a model of channels, in the
    app's mirrored frame. Elsewhere the eyes' follow the weights of the ``eyeLook`` shapes as in the app's
    recordings, and the head's come from controls and acting.

    Args:
        address: ``livelink://HOST:PORT``; this machine's port 11111 by default.
        subject: name of the face in Live Link; the performance's if empty.
    """

    default_port = 11_111

    def __init__(self, address: Address, *, subject: str = "") -> None:
        super().__init__(address)
        self.subject = subject
        self._first: int | None = None

    def open(self, performance: Performance) -> None:
        """Make the socket and the parts of the datagram that stay the same."""
        self._weights = ArkitWeights(performance, self.address, (*ORDER, *ROTATIONS))
        self._turning = any(name in performance.shapes for name in ROTATIONS)
        subject = self.subject or performance.subject
        if not subject.isascii() or not subject.isprintable() or len(subject) > LONGEST_NAME:
            raise FaceDiffError(
                f"{OPTION} {self.name}: subject is {subject!r}; expected up to {LONGEST_NAME} characters of ASCII"
            )
        device = str(uuid.uuid5(uuid.NAMESPACE_DNS, f"{subject}.facediff"))
        self._rate = Fraction(performance.frame_rate).limit_denominator(1001)
        self._head = bytes([VERSION])
        for text in (device, subject):
            self._head += struct.pack(">i", len(text)) + text.encode("ascii")
        self._first = None
        super().open(performance)

    def datagrams(self, frame: LiveFrame) -> list[bytes]:
        """The datagram of a frame."""
        if self._first is None:
            self._first = int(seconds_of_day() * self._rate) - frame.index
        number = (self._first + frame.index) % int(DAY * self._rate)
        weights, rotations = np.split(self._weights.of(frame), [len(ORDER)])
        if not self._turning:
            rotations = np.concatenate([frame.turned, gaze(ORDER, weights[None])[0]])
        values = [*weights.tolist(), *mirrored(rotations).tolist()]
        rate = self._rate.numerator, self._rate.denominator
        return [self._head + struct.pack(f">ifiiB{len(values)}f", number, 0.0, *rate, len(values), *values)]


def seconds_of_day() -> float:
    """Seconds since midnight by this machine's clock, in its time zone."""
    now = datetime.now()  # noqa: DTZ005 - the zone of this machine
    return (now - now.replace(hour=0, minute=0, second=0, microsecond=0)).total_seconds()
