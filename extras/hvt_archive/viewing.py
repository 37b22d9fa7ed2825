"""The settings of the Rerun viewer, and how the ground comes to show itself there."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

from hvt_common.config import Group
from hvt_common.errors import UserError
from hvt_ground.config import GroundConfig
from hvt_ground.extras import Extra, Service

if TYPE_CHECKING:
    from hvt_common.runtime.failures import Failures

_VIEWER = Group("viewer")


@dataclass(frozen=True)
class ViewerOptions(GroundConfig):
    """The settings of ``hvt-ground`` for it."""

    view: bool = _VIEWER.switch("also open the Rerun viewer")
    serve: bool = _VIEWER.switch("also serve the Rerun web viewer on this machine")


class ViewerExtra(Extra[ViewerOptions]):
    """One viewer for all edges."""

    options = ViewerOptions

    def check(self, config: ViewerOptions) -> None:
        if config.view and config.serve:
            raise UserError(
                "--view and --serve are both given: choose the viewer here or the one in a browser"
            )

    def serve(
        self,
        config: ViewerOptions,
        *,
        clock: Callable[[], int],  # noqa: ARG002
        failures: Failures,  # noqa: ARG002
    ) -> Service | None:
        return viewing(config, later=True)


def viewing(config: ViewerOptions, *, later: bool = False) -> Service | None:
    """The service of a viewer, as of `hvt_archive.viewer.LiveView`; None where none is wanted."""
    if not (config.view or config.serve):
        return None
    from hvt_archive.viewer import Viewing  # noqa: PLC0415 - ``--help`` is to open no recording

    return Viewing("spawn" if config.view else "serve", later=later)
