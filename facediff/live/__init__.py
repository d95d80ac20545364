"""Live performance: a face animated from live speech, in engines, browsers and other programs.

Needs no PyTorch: an exported model (:mod:`facediff.runtime`) animates, or any other source of frames for speech.
"""

from typing import TYPE_CHECKING

from facediff.utils.lazy import lazy_names

if TYPE_CHECKING:
    from facediff.live.frames import Address as Address
    from facediff.live.frames import LiveFrame as LiveFrame
    from facediff.live.frames import Performance as Performance
    from facediff.live.frames import Receiver as Receiver
    from facediff.live.frames import open_receiver as open_receiver

__getattr__, __dir__, __all__ = lazy_names(
    __name__, {"frames": "Address LiveFrame Performance Receiver open_receiver read_address"}
)
