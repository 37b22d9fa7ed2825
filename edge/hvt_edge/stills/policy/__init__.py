"""Scheduling policies: which tracks deserve a still at this step."""

from __future__ import annotations

from hvt_edge.stills.policy.base import Method, Request, Step
from hvt_edge.stills.policy.cost import CostEstimate, CostModel
from hvt_edge.stills.policy.registry import METHODS, MethodEntry, method, tuning
from hvt_edge.stills.policy.selectors import SELECTORS, Selector, select

__all__ = [
    "METHODS",
    "SELECTORS",
    "CostEstimate",
    "CostModel",
    "Method",
    "MethodEntry",
    "Request",
    "Selector",
    "Step",
    "method",
    "select",
    "tuning",
]
