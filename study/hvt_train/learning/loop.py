"""The training loop of both networks: AdamW, warm-up and cosine, averaged weights, bfloat16 where the CPU has it."""

from __future__ import annotations

import copy
import json
import math
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

Loss = tuple[Tensor, dict[str, Tensor]]


@dataclass(frozen=True, slots=True)
class LoopSettings:
    """How long and how fast."""

    steps: int
    rate: float = 2e-3
    warm_up: int = 200
    decay: float = 0.02
    average: float = 0.998
    clip: float = 10.0
    check_every: int = 1000
    """Steps between two calls of ``check``."""
    bfloat16: bool = True
    budget_s: float | None = None
    """Wall time after which the schedule is shortened so that it ends in time; None: all steps."""
    device: str = "cpu"
    """``cuda`` where PyTorch has one."""


class Average:
    """Exponential moving average of a network's weights (Polyak), for export and measures."""

    def __init__(self, net: nn.Module, decay: float) -> None:
        self.net = copy.deepcopy(net).eval()
        self._decay, self._count = decay, 0
        self._mine = list(self.net.state_dict().values())

    def update(self, net: nn.Module) -> None:
        """Take a step towards ``net``; faster in the beginning."""
        self._count += 1
        decay = min(self._decay, (1 + self._count) / (10 + self._count))
        pairs = list(zip(self._mine, net.state_dict().values(), strict=True))
        real = [pair for pair in pairs if pair[0].dtype.is_floating_point]
        with torch.no_grad():
            torch._foreach_lerp_([mine for mine, _ in real], [theirs for _, theirs in real], 1 - decay)
            for mine, theirs in pairs:
                if not mine.dtype.is_floating_point:
                    mine.copy_(theirs)


def train(
    net: nn.Module,
    batches: Iterable[Any],
    *,
    loss_of: Callable[[nn.Module, Any], Loss],
    settings: LoopSettings,
    log: Path,
    check: Callable[[nn.Module, int], dict[str, float]] | None = None,
) -> nn.Module:
    """Train the network in place on batches without end, and return the averaged one.

    ``loss_of`` makes of (network, batch) a loss and its parts, ``check`` measures the averaged network at a step. The
    log has one JSON object a line: step, seconds, rate and parts every 50 steps, and the results of ``check``.
    """
    net.to(settings.device)
    optimizer = torch.optim.AdamW(
        _groups(net, settings.decay), lr=settings.rate, betas=(0.9, 0.99), fused=settings.device != "cpu"
    )
    average = Average(net, settings.average)
    stream, start = iter(batches), time.monotonic()
    sums: dict[str, Tensor] = {}
    net.train().to(memory_format=torch.channels_last)
    with log.open("a", encoding="utf-8") as lines:
        for step, share in _progress(settings):
            rate = _rate(settings, step, share)
            for group in optimizer.param_groups:
                group["lr"] = rate
            with torch.autocast(settings.device, torch.bfloat16, enabled=settings.bfloat16):
                loss, parts = loss_of(net, next(stream))
            optimizer.zero_grad(set_to_none=True)
            loss.backward()
            nn.utils.clip_grad_norm_(net.parameters(), settings.clip)
            optimizer.step()
            average.update(net)
            for name, value in {"loss": loss.detach(), **parts}.items():
                sums[name] = sums[name] + value if name in sums else torch.as_tensor(value)
            if step % 50 == 0:
                means = {name: round(float(value) / 50, 4) for name, value in sums.items()}
                sums.clear()
                _write(
                    lines, {"step": step, "seconds": round(time.monotonic() - start), "rate": rate, **means}
                )
            if check is not None and (step % settings.check_every == 0 or share >= 1):
                _write(lines, {"step": step, **check(average.net, step)})
            if share >= 1:
                break
    return average.net


def _progress(settings: LoopSettings) -> Iterator[tuple[int, float]]:
    """(step, share of the schedule done), by steps or by the clock, whichever is further."""
    start = time.monotonic()
    for step in range(1, settings.steps + 1):
        spent = (time.monotonic() - start) / settings.budget_s if settings.budget_s else 0.0
        yield step, min(1.0, max(step / settings.steps, spent))


def _rate(settings: LoopSettings, step: int, share: float) -> float:
    cosine = 0.02 + 0.98 * (1 + math.cos(math.pi * share)) / 2
    return settings.rate * cosine * min(1.0, step / settings.warm_up)


def _groups(net: nn.Module, decay: float) -> list[dict[str, Any]]:
    """Weights of convolutions decay, biases and norms do not."""
    heavy = [p for p in net.parameters() if p.ndim > 1]
    light = [p for p in net.parameters() if p.ndim <= 1]
    return [{"params": heavy, "weight_decay": decay}, {"params": light, "weight_decay": 0.0}]


def _write(lines: Any, row: dict[str, float]) -> None:
    lines.write(json.dumps(row) + "\n")
    lines.flush()
