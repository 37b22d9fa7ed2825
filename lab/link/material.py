"""The source of the edge: a clip as long as the scenario, made by repeating a shorter one."""

from pathlib import Path

import av

from hvt_common.errors import UserError
from hvt_scene import Scene

_SIZE = (1280, 720)
_FPS = 15


def demo_clip(path: Path) -> Path:
    """The demo scene, drawn once and kept: drawing it beside the edge would cost the edge its processor."""
    if path.exists():
        return path
    scene = Scene(0)
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_suffix(".part.mp4")
    with av.open(str(part), "w") as container:
        stream = container.add_stream(
            "libx264", rate=_FPS, options={"crf": "14", "preset": "veryfast", "bf": "0"}
        )
        stream.width, stream.height = _SIZE
        stream.pix_fmt = "yuv420p"
        for index in range(int(scene.duration_s * _FPS)):
            picture = av.VideoFrame.from_ndarray(scene.image(index / _FPS), format="bgr24")
            container.mux(stream.encode(picture.reformat(*_SIZE, format="yuv420p")))
        container.mux(stream.encode())
    part.rename(path)
    return path


def looped(clip: Path, path: Path, *, lasts_s: float) -> Path:
    """Write a list (ffconcat) that plays the clip again and again until it lasts so long; ``path`` is overwritten.

    Raises:
        UserError: the clip cannot be read, or has no video.
    """
    try:
        with av.open(str(clip)) as source:
            stream = source.streams.video[0]
            packets = [packet for packet in source.demux(stream) if packet.size]
            span = max(p.pts + (p.duration or 1) for p in packets) - min(p.pts for p in packets)
            turns = int(lasts_s / float(span * stream.time_base)) + 1
    except (av.FFmpegError, IndexError, ValueError, OSError) as error:
        raise UserError(f"CLIP {clip} cannot be played: {error}") from None
    path.parent.mkdir(parents=True, exist_ok=True)
    # FFmpeg takes only plain names beside the list.
    beside = path.with_name(f"{path.stem}-once{clip.suffix}")
    beside.unlink(missing_ok=True)
    beside.symlink_to(clip.resolve())
    path.write_text("ffconcat version 1.0\n" + f"file {beside.name}\n" * turns, encoding="ascii")
    return path
