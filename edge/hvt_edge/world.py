"""The edge's world: camera or clip, detector, link and clock. A study passes its own in their place."""

from __future__ import annotations

import secrets
from collections.abc import Callable
from concurrent.futures import Executor
from contextlib import ExitStack
from typing import cast

from hvt_common.errors import UserError
from hvt_common.inference.detect import Detector
from hvt_common.runtime.clock import SteadyClock
from hvt_common.runtime.failures import Failures
from hvt_common.values import Fit
from hvt_edge.config import EdgeConfig
from hvt_edge.link.feedback import FeedbackInbox
from hvt_edge.link.publisher import EdgeLink, ZenohLink
from hvt_edge.loop.pose import PoseSource, PoseTable, open_pose
from hvt_edge.source.contract import DrawnSource
from hvt_edge.source.opening import Source, open_source, shown
from hvt_edge.wiring import base_size, make_detector, make_link_settings, passthrough, warm_up_for


class World:
    """The world of a real flight."""

    def __init__(self) -> None:
        self.session_id = 1 << 31 | secrets.randbits(31)  # 5 bytes in each header, where 64 bits take 9
        self.clock: Callable[[], int] = SteadyClock()
        self.failures = Failures(self.clock)
        self.inbox = FeedbackInbox()
        self.executor: Executor | None = None
        """Runs perception in lockstep; None: a thread of its own."""

    def open_detector(self, config: EdgeConfig) -> Detector:
        """Open the detector. Raises `UserError` where there is none of that name."""
        return make_detector(config, None if config.pace == "lockstep" else self.failures)

    def warm_up(self, config: EdgeConfig, detector: Detector, source: Source) -> None:
        """Prepare the detector before the first frame: a runtime may compile for the size of the pictures."""
        warm_up_for(config, detector, source.view)

    def open_source(self, config: EdgeConfig) -> Source:
        """Open ``--source``; errors are those of `hvt_edge.source.opening.open_source`."""
        assert config.source is not None, "check() refuses a missing source"
        opener = passthrough().open_source if config.passes_through else open_source
        return opener(
            config.source,
            size=base_size(config),
            fps=config.nominal_fps,
            fit=cast("Fit", config.fit),
            seed=config.seed,
            max_frames=config.max_frames,
            source_fps=config.source_fps,
            growing=config.follow,
            clock=self.clock,
            failures=self.failures,
        )

    def open_pose(self, config: EdgeConfig, source: Source) -> PoseSource | None:
        """Open ``--pose``; None without. Raises `UserError` if nothing usable is there."""
        if config.pose is None:
            return None
        if config.pose == "demo":
            if not isinstance(source, DrawnSource):
                raise UserError(
                    f"--pose demo is of the drawn scene, and --source is {shown(str(config.source))}"
                )
            return PoseTable(source.poses())
        opened = open_pose(config.pose, hfov_deg=config.fov, clock=self.clock)
        if isinstance(opened, PoseTable) and source.frame_count and config.max_frames is None:
            opened.compare(clip_s=source.frame_count / source.fps)
        return opened

    def open_link(self, stack: ExitStack, config: EdgeConfig) -> EdgeLink:
        """Open the link until ``stack`` closes. Raises `UserError` for a bad port, endpoint or edge id."""
        return stack.enter_context(
            ZenohLink(
                make_link_settings(config), edge_id=config.edge_id, failures=self.failures, clock=self.clock
            )
        )
