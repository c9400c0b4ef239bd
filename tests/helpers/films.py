"""Frames for tests of capture: cut-outs of a textured wall, and images with black squares."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from scgs_warp.storage.png_files import write_png


def wall(seed: int = 0, height: int = 200, width: int = 700) -> np.ndarray:
    """[height, width, 3] uint8, patterned at several scales."""
    rng = np.random.default_rng(seed)
    total = np.zeros((height, width, 3), np.float32)
    for size in (4, 12, 40):
        coarse = rng.uniform(-1, 1, (height // size + 2, width // size + 2, 3)).astype(np.float32)
        total += cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC)
    return np.rint(128 + 60 * total).clip(0, 255).astype(np.uint8)


def pan(shifts, height: int = 120, width: int = 160) -> list[np.ndarray]:
    """Cut-outs of the wall; ``shifts`` in pixels."""
    background = wall(height=height)
    return [background[:, shift : shift + width].copy() for shift in shifts]


def mask_images(folder, count: int, size=(160, 120), name="{:03d}.png"):
    """Masks, each with a black square in a place of its own."""
    folder.mkdir()
    for index in range(count):
        picture = np.full((size[1], size[0], 3), 255, np.uint8)
        picture[10:30, 5 * index : 5 * index + 20] = 0
        write_png(folder / name.format(index), picture)
    return folder


def stream(pictures: list[np.ndarray]) -> bytes:
    """Pictures as an H.264 stream without a container; streams may follow each other."""
    import av

    height, width = pictures[0].shape[:2]
    encoder = av.CodecContext.create("libx264", "w")
    encoder.width, encoder.height, encoder.pix_fmt, encoder.framerate = width, height, "yuv420p", 10
    frames = [av.VideoFrame.from_ndarray(picture, format="rgb24") for picture in pictures]
    return b"".join(bytes(packet) for frame in [*frames, None] for packet in encoder.encode(frame))


def cut_film(path: Path, to: Path, count: int) -> None:
    """Cut a film's first ``count`` frames off without encoding it anew, as phones do: they stay, but are not shown."""
    import av

    options = {"use_editlist": "1", "avoid_negative_ts": "disabled"}
    with av.open(str(path)) as film, av.open(str(to), "w", options=options) as out:
        source = film.streams.video[0]
        target = out.add_stream_from_template(source)
        shift = round(count / source.average_rate / source.time_base)
        for packet in film.demux(source):
            if packet.size:
                packet.pts, packet.dts, packet.stream = packet.pts - shift, packet.dts - shift, target
                out.mux(packet)


def without_beginning(path: Path, to: Path, count: int) -> None:
    """Copy a film without its first ``count`` stored pictures, as recordings of broadcasts begin."""
    import av

    with av.open(str(path)) as film, av.open(str(to), "w") as out:
        source = film.streams.video[0]
        target = out.add_stream_from_template(source)
        for packet in [packet for packet in film.demux(source) if packet.size][count:]:
            packet.stream = target
            out.mux(packet)


def encoded(
    path: Path,
    count: int,
    options: dict[str, str] | None = None,
    sound: float = 0.0,
    gop: int | None = None,
    codec: str = "libx264",
    size: tuple[int, int] = (160, 120),
) -> None:
    """Write a film of H.264 with reordered frames, or of another codec, 25 a second, of a noisy pan over the wall.

    Args:
        options: of the container.
        sound: length of a silent sound track, seconds; 0 for none.
        gop: number of frames from one key frame to the next; None: as the encoder chooses.
        size: width and height, to which the frames are enlarged.
    """
    import av

    rng = np.random.default_rng(0)
    with av.open(str(path), "w", options=options or {}) as out:
        keys = {} if gop is None else {"g": str(gop), "keyint_min": str(gop), "sc_threshold": "0"}
        stream = out.add_stream(codec, rate=25, options=keys)
        (stream.width, stream.height), stream.pix_fmt = size, "yuv420p"
        track = out.add_stream("aac", rate=48000) if sound else None
        for picture in pan(range(0, 2 * count, 2)):
            noisy = (picture + rng.integers(-9, 9, picture.shape)).clip(0, 255).astype(np.uint8)
            large = cv2.resize(noisy, size, interpolation=cv2.INTER_CUBIC)
            out.mux(stream.encode(av.VideoFrame.from_ndarray(large, format="rgb24")))
        out.mux(stream.encode())
        if track is not None:
            for index in range(int(sound * 48000 / 1024)):
                silence = av.AudioFrame.from_ndarray(np.zeros((1, 1024), np.float32), format="fltp", layout="mono")
                silence.sample_rate, silence.pts = 48000, 1024 * index
                out.mux(track.encode(silence))
            out.mux(track.encode())


def spoil(path: Path, begin: float, share: float) -> None:
    """Overwrite a share of a film's bytes, beginning at another."""
    content = bytearray(path.read_bytes())
    at, length = int(begin * len(content)), int(share * len(content))
    content[at : at + length] = np.random.default_rng(1).bytes(length)
    path.write_bytes(content)


def cut_copy(path: Path, to: Path, share: float) -> None:
    """Copy a film, its header first, and cut the copy off after a share of its bytes."""
    import av

    with av.open(str(path)) as film, av.open(str(to), "w", options={"movflags": "faststart"}) as out:
        streams = {stream.index: out.add_stream_from_template(stream) for stream in film.streams}
        for packet in film.demux():
            if packet.size:
                packet.stream = streams[packet.stream.index]
                out.mux(packet)
    content = to.read_bytes()
    to.write_bytes(content[: int(share * len(content))])
