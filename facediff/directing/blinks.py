"""Procedural blinks.

How often people blink is from Bentivoglio et al., "Analysis of blink rate patterns in normal subjects", Movement
Disorders 12(6), 1997: 17 times a minute at rest, 26 in conversation, 4.5 when reading.
"""

from __future__ import annotations

import numpy as np

from facediff.directing.eyes import Eyes
from facediff.directing.layers import PROCEDURAL, Array, copied, noted, random_of, smooth_step
from facediff.errors import FaceDiffError
from facediff.takes import Take

RATE = 17.0
"""Blinks a minute of somebody at rest."""
RATES = (1.0, 40.0)
CLOSE, SHUT, OPEN = 0.10, 0.03, 0.20
"""Seconds that the lids take to shut, stay shut, and take to open: about a third of a second, quicker down than up."""
SPREAD = (0.85, 1.2)
"""How much shorter and longer than that a blink may be."""
GAP = 0.15
"""Seconds from one blink's end to the next one's start at least."""
DOUBLE = 0.12
"""Share of blinks that another one follows at once."""
WIDENED = -0.5
"""How far an eye may be open beyond the neutral face, in closings, that a blink still makes up for."""


def add_blinks(take: Take, eyes: Eyes, *, rate: float = RATE, seed: int = 0) -> Take:
    """Let the eyes blink, beside whatever blinks the take has.

    The lids' own closing a and the blink's b make a + b (1 − a): at b = 0 the take's own, at b = 1 shut, never more. An
    eye that is shut already stays just so.

    Args:
        take: its head must not sway yet.
        eyes: of the take's topology.
        rate: blinks a minute, 1 to 40.
        seed: equal seeds give equal blinks.

    Raises:
        FaceDiffError: if the rate is impossible, or the eyes' lids are not known.
    """
    lids, closing = eyes.lids()
    curve = blink_curve(len(take.vertices), take.frame_rate, rate=rate, seed=seed)
    vertices = copied(take.vertices)
    size = (closing**2).sum(axis=-1)
    for index in np.flatnonzero(curve):
        offsets = vertices[index, lids] - take.template[lids]
        shut = np.clip((offsets * closing).sum(axis=-1) / size, WIDENED, 1.0)
        vertices[index, lids] += ((1.0 - shut) * np.float32(curve[index]))[:, None] * closing
    return noted(take, vertices, PROCEDURAL, f"blinks ({rate:g} a minute, seed {seed})")


def blink_curve(frames: int, frame_rate: float, *, rate: float = RATE, seed: int = 0) -> Array:
    """How far the eyes are shut in every frame (T,), 0 to 1.

    Intervals are a gamma distribution of shape 2 above the shortest possible one, with the mean that the rate asks for.
    No two blinks overlap, none begins before the first frame or ends after the last, each is fully shut for a frame.

    Raises:
        FaceDiffError: if the rate is not in 1 … 40.
    """
    if not RATES[0] <= rate <= RATES[1]:
        raise FaceDiffError(
            f"--blinks {rate:g}: expected blinks a minute, {RATES[0]:g} to {RATES[1]:g} (17 at rest, 26 in talk)"
        )
    random = random_of("blinks", seed)
    times = np.arange(frames) / frame_rate
    last = times[-1] if frames else 0.0
    hold = max(SHUT, 1.0 / frame_rate)  # so that one frame at least falls into it
    usual = CLOSE + hold + OPEN
    least = usual * SPREAD[1] + GAP
    # A double blink is two for one interval; the mean of all intervals from start to start stays 60 / rate.
    mean = 60.0 * (1.0 + DOUBLE) / rate - DOUBLE * (usual + GAP)
    curve = np.zeros(frames)
    start = random.uniform(0.0, 1.0) * mean
    while start < last:
        for _ in range(2 if random.random() < DOUBLE else 1):
            length = float(random.uniform(*SPREAD))
            down, up = CLOSE * length, OPEN * length
            end = start + down + hold + up
            if end <= last:
                span = slice(int(start * frame_rate), int(end * frame_rate) + 2)
                now = times[span]
                curve[span] = np.maximum(curve[span], smooth_step((now - start) / down) * smooth_step((end - now) / up))
            following, start = start, end + GAP
        start = following + least + float(random.gamma(2.0, max(mean - least, 0.05) / 2.0))
    return curve
