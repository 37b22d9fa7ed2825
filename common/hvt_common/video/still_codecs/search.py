"""The quality at which a crop is coded, found by trying: the best within some bytes, or the least for some PSNR.

Fidelity and the logarithm of the size rise about evenly with the quality, so that each try tells where the next is
best made; and no coding is tried twice, where a codec has fewer than a hundred (``step_of``). Codecs promise no exact
order, only that more quality is no worse and nearly always more bytes; the returned coding was tried, so it fits the
bytes or reaches the PSNR in any case.
"""

import itertools
import math
from collections.abc import Callable

import cv2
import numpy as np

from hvt_common.values import Image
from hvt_common.video.still_codecs.contract import CodedCrop, StillCodec

_BT601_BGR = np.array([[0.114, 0.587, 0.299]], np.float32)
_WHOLE_DB, _WHOLE_SIZE = 28.0, 4.0
"""By how much fidelity in dB and the logarithm of the size rise from the least quality to the best: a first guess."""
_GUESSES = 5
"""After this many tries the range is halved: the crop does not rise evenly."""


def best_fitting(
    codec: StillCodec,
    crop_bgr: Image,
    *,
    limit_bytes: int,
    low_pct: int,
    high_pct: int,
    base_bgr: Image | None = None,
    tried: dict[int, CodedCrop] | None = None,
    enough: float = math.inf,
) -> tuple[CodedCrop, int] | None:
    """The best quality from ``low_pct`` to ``high_pct`` (both included) whose data is at most ``limit_bytes``.

    With that quality in percent; None where nothing fits. ``base_bgr``: see `StillCodec.encode`. ``tried`` are
    codings of this crop by quality: none is made again, and those that are made come in. One that
    takes ``enough`` of the limit, a share, is as good as the best.
    """
    best = [steps[-1] for steps in _steps(codec, low_pct, high_pct)]
    tried = {} if tried is None else tried

    def excess(place: int) -> float:
        """Excess of the size's logarithm; above 0 where it does not fit."""
        quality_pct = best[place]
        if quality_pct not in tried:
            tried[quality_pct] = codec.encode(crop_bgr, quality_pct=quality_pct, base_bgr=base_bgr)
        return math.log((len(tried[quality_pct].data) + 0.5) / (limit_bytes + 1))

    # Most often the best fits at once.
    rise = _WHOLE_SIZE / max(1, len(best))
    found = _first_above(excess, len(best), first=len(best) - 1, rise=rise, near=math.log(enough)) - 1
    return (tried[best[found]], best[found]) if found >= 0 else None


def smallest_reaching(
    codec: StillCodec,
    crop_bgr: Image,
    *,
    target_db: float,
    low_pct: int,
    high_pct: int,
    base_bgr: Image | None = None,
) -> tuple[CodedCrop, int, Image, float] | None:
    """The least quality from ``low_pct`` to ``high_pct`` (both included) whose Y-PSNR is at least ``target_db``.

    With that quality in percent, the picture as the ground will see it (BGR, the crop's size), and its Y-PSNR in dB;
    None where the best does not reach it.
    """
    size = (crop_bgr.shape[1], crop_bgr.shape[0])
    least = [steps[0] for steps in _steps(codec, low_pct, high_pct)]
    tried: dict[int, tuple[CodedCrop, int, Image, float]] = {}

    def gain_db(place: int) -> float:
        """Over the target, which itself counts as reached."""
        coded = codec.encode(crop_bgr, quality_pct=least[place], base_bgr=base_bgr)
        image = codec.decode(coded.data, size=size, parameters=coded.parameters, base_bgr=base_bgr)
        reached_db = psnr_y_db(image, crop_bgr)
        tried[place] = coded, least[place], image, reached_db
        return reached_db - target_db if reached_db != target_db else math.ulp(1.0)

    rise = _WHOLE_DB / max(1, len(least))
    return tried.get(_first_above(gain_db, len(least), first=2 * len(least) // 3, rise=rise))


def _steps(codec: StillCodec, low_pct: int, high_pct: int) -> list[list[int]]:
    # The qualities, those together that code alike: ``step_of`` of a codec says which, where it has it.
    step_of: Callable[[int], int] = getattr(codec, "step_of", lambda quality_pct: quality_pct)
    return [list(alike) for _, alike in itertools.groupby(range(low_pct, high_pct + 1), key=step_of)]


def _first_above(
    value: Callable[[int], float], count: int, *, first: int, rise: float, near: float = math.inf
) -> int:
    # Of values that rise; ``count`` where none is above 0. That place and the one before it were tried. A value of
    # ``near`` or more that is not above 0 counts as the last before it.
    below, above = (-1, -math.inf), (count, math.inf)
    place, tries, last = first, 0, None
    while above[0] - below[0] > 1 and below[1] < near:
        here = (place, value(place))
        below, above = (below, here) if here[1] > 0 else (here, above)
        tries += 1
        if tries >= _GUESSES or not math.isfinite(here[1]):
            zero = (below[0] + above[0]) / 2
        elif math.isfinite(below[1]) and math.isfinite(above[1]):
            zero = below[0] - below[1] * (above[0] - below[0]) / (above[1] - below[1])
        else:
            if last is not None and (here[1] - last[1]) * (here[0] - last[0]) > 0:
                rise = (here[1] - last[1]) / (here[0] - last[0])
            zero = here[0] - here[1] / rise
        last = here
        # Where it is guessed to be above 0 first, or just before, where that has been tried.
        guess = math.ceil(min(count, max(-1.0, zero)))
        place = min(above[0] - 1, max(below[0] + 1, guess))
    return below[0] + 1


def psnr_y_db(image_bgr: Image, source_bgr: Image) -> float:
    """PSNR of the luma of the difference (BT.601, full range), in dB; infinite where there is none."""
    # Not the difference of two lumas: rounded to bytes these would be off by up to 5 %.
    luma = cv2.transform(cv2.subtract(image_bgr, source_bgr, dtype=cv2.CV_32F), _BT601_BGR)
    error = cv2.norm(luma, cv2.NORM_L2SQR) / luma.size
    return 10 * math.log10(255**2 / error) if error else math.inf
