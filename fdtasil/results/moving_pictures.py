"""Pictures that move: what stands above each, and the formats that they are written in."""

from collections.abc import Callable, Iterator
from contextlib import closing
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from fdtasil.errors import ExportError

__all__ = ["WRITERS", "panel"]

_BAR, _MARGIN = 40, 8  # pixels above a picture, and around its text
_INK, _PAPER, _FADED = (20, 20, 20), (255, 255, 255), 0.45
_LAST = 1.0  # seconds that the last picture stands


def panel(picture: np.ndarray, height: int, name: str, told: str, *, faded: bool) -> np.ndarray:
    """Return a picture with two texts above it; both sides even, as codecs want it.

    Args:
        picture: (h, w, 3) bytes.
        height: Of the picture below the texts, in pixels.
        name: On the left.
        told: On the right.
        faded: Whether it is over.
    """
    height -= height % 2
    width = 2 * round(height * picture.shape[1] / picture.shape[0] / 2)
    shown = Image.fromarray(picture).resize((width, height), Image.Resampling.LANCZOS)
    if faded:
        shown = Image.blend(shown, Image.new("RGB", shown.size, _PAPER), _FADED)
    whole = Image.new("RGB", (width, height + _BAR), _PAPER)
    whole.paste(shown, (0, _BAR))
    pen, font = ImageDraw.Draw(whole), ImageFont.load_default(15)
    pen.text((_MARGIN, _MARGIN), name, _INK, font)
    pen.text((width - _MARGIN, _MARGIN), told, _INK, font, anchor="ra")
    return np.asarray(whole)


def _mp4(pictures: Iterator[np.ndarray], fps: float) -> bytes:
    try:
        import imageio_ffmpeg
    except ImportError as error:
        raise ExportError(
            "an .mp4 without the package imageio-ffmpeg", "it", 'pip install "fdtasil[video]"'
        ) from error
    from tempfile import TemporaryDirectory

    first = next(pictures)
    _check_sides(first, "MP4", 2**14)
    with TemporaryDirectory() as folder:
        file = Path(folder, "film.mp4")
        writer = imageio_ffmpeg.write_frames(
            str(file),
            (first.shape[1], first.shape[0]),
            fps=fps,  # pyright: ignore[reportArgumentType]
            macro_block_size=2,
            quality=7,
        )
        with closing(writer):
            writer.send(None)
            last = first
            writer.send(np.ascontiguousarray(first))
            for last in pictures:
                writer.send(np.ascontiguousarray(last))
            for _ in range(round(_LAST * fps)):
                writer.send(np.ascontiguousarray(last))
        return file.read_bytes()


def _still(
    kind: str, grain: int, least: int, most: int, **options: Any
) -> Callable[[Iterator[np.ndarray], float], bytes]:
    """Return what writes a format of pictures that move.

    Args:
        kind: What Pillow calls it.
        grain: Milliseconds that it counts in.
        least: Milliseconds that viewers show a picture for at least.
        most: Pixels of a side.
        **options: Of Pillow.
    """

    def write(pictures: Iterator[np.ndarray], fps: float) -> bytes:
        kept, times = [], []
        last = None
        for number, last in enumerate(pictures):
            if not number:
                _check_sides(last, kind, most)
            time = grain * round(1000 * number / fps / grain)
            if not times or time - times[-1] >= least:
                kept.append(Image.fromarray(last))
                times.append(time)
        if last is not None:  # how it ends is seen, whatever is left out
            kept[-1] = Image.fromarray(last)
        first, *rest = kept
        durations = [*np.diff(times).tolist(), round(1000 * _LAST)]
        target = BytesIO()
        about = {"save_all": True, "append_images": rest, "duration": durations, "loop": 0}
        first.save(target, kind, **about, **options)
        return target.getvalue()

    return write


def _check_sides(picture: np.ndarray, kind: str, most: int) -> None:
    height, width, _ = picture.shape
    if max(height, width) > most:
        raise ExportError(
            f"a film of {width:,} x {height:,} pixels",
            f"at most {most:,} a side in a {kind}",
            "pass a smaller height=, or fewer policies",
        )


WRITERS: dict[str, Callable[[Iterator[np.ndarray], float], bytes]] = {
    ".mp4": _mp4,
    ".webp": _still("WEBP", 1, 1, 2**14 - 1, quality=60, method=4),
    ".gif": _still("GIF", 10, 20, 2**16 - 1, optimize=True),  # many take a shorter time for 100
}
"""Every format by the suffix of its file."""
