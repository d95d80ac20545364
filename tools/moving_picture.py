"""Turn a video into a moving picture that code hosts show in a README: an animated WebP, without sound, in a loop.

facediff demo
python tools/moving_picture.py demo/truth_and_prediction_test_b.mp4 docs/images/talking_face.webp
"""

from __future__ import annotations

import argparse
from pathlib import Path

import av
from PIL import Image


def moving_picture(video: Path, output: Path, *, width: int = 640, quality: int = 60) -> int:
    """Write the frames of a video as an animated WebP and return the number of bytes.

    Args:
        video: any video that PyAV reads.
        output: the picture, ``.webp``.
        width: in pixels; the height follows.
        quality: of the lossy compression, from 0 to 100.
    """
    with av.open(str(video)) as container:
        stream = container.streams.video[0]
        rate = float(stream.average_rate or 25)
        frames = [frame.to_image() for frame in container.decode(stream)]
    height = round(width * frames[0].height / frames[0].width)
    small = [frame.resize((width, height), Image.Resampling.LANCZOS) for frame in frames]
    # Times are whole milliseconds: rounded ends of frames, and not rounded lengths, keep the pace at every rate.
    ends = [round(1000 * (index + 1) / rate) for index in range(len(small))]
    durations = [end - start for start, end in zip([0, *ends], ends, strict=False)]
    first, *others = small
    first.save(output, save_all=True, append_images=others, duration=durations, loop=0, quality=quality, method=6)
    return output.stat().st_size


def main() -> None:
    """Run as a program."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("video", type=Path)
    parser.add_argument("output", type=Path)
    options = parser.parse_args()
    size = moving_picture(options.video, options.output)
    print(f"{options.output}: {size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
