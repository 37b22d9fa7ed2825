"""The gate: whether the base already shows a candidate well enough, so that no still of it is sent.

The edge decodes its own stream and knows what the base lost of each candidate (`base_loss`). Both conditions have to
hold, because each has its blind spot: PSNR is high on a dark or smooth object whatever became of its edges, and lost
detail is small on a coarse object that is plainly wrong in colour. docs/stills.md has the figures.
"""

from __future__ import annotations

from dataclasses import dataclass

from hvt_edge.perception.base_loss import BaseLoss

__all__ = ["Gate"]


@dataclass(frozen=True, slots=True)
class Gate:
    """Shut where the base is good; open for everything at 0 dB. Frozen, without state."""

    psnr_y_db: float = 0.0
    """Luma PSNR of the base crop from which on the base counts as good; 0: no gate."""
    most_detail_lost: float = 0.4
    """Nor may the base have lost more than this share of the crop's detail (`BaseLoss.detail_lost`)."""

    @property
    def on(self) -> bool:
        """Whether anything is ever held back."""
        return self.psnr_y_db > 0

    def good_enough(self, loss: BaseLoss) -> bool:
        """Whether a still of what the base shows so well is not worth its bits."""
        return self.on and loss.psnr_y_db >= self.psnr_y_db and loss.detail_lost <= self.most_detail_lost
