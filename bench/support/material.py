"""Where benchmarks find clips and models: the folder that HVT_DATA names."""

import os
from pathlib import Path

from hvt_common.values import Frame
from hvt_edge.source.opening import open_source
from hvt_edge.video.encoder import encoder_settings
from hvt_edge.video.x265 import BaseEncoder

ROOT = Path(__file__).resolve().parents[2]
SIZE, FPS = (1280, 720), 15.0


def data() -> Path:
    folder = Path(os.environ.get("HVT_DATA", ROOT.parent / "shared" / "data"))
    if not folder.is_dir():
        raise ImportError(f"no clips and models at {folder}; HVT_DATA names the folder")
    return folder


def clip() -> Path:
    return data() / "clips" / "drone_carpark.mp4"


def nano() -> Path:
    return data() / "models" / "yolox_nano.onnx"


def frames(count: int) -> list[Frame]:
    with open_source(str(clip()), size=SIZE, fps=FPS, max_frames=count) as source:
        return list(source.frames(start_ns=0))


def encoder(
    *, base_bps: int = 650_000, total_bps: int = 800_000, size: tuple[int, int] = SIZE, fps: float = FPS
) -> BaseEncoder:
    """x265 as hvt-edge has it at this budget."""
    rates = {"total_bps": total_bps, "base_bps": base_bps}
    return BaseEncoder(encoder_settings(size=size, fps=fps, preset="veryfast", **rates, edge_id="edge-1"))
