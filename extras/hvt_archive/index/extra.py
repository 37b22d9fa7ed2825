"""The settings of the index of recordings, and how the ground comes to write it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

from hvt_common.config import Group, SettingType
from hvt_common.errors import UserError
from hvt_common.units import Limit, parse_age_s, parse_limit
from hvt_ground.config import GroundConfig
from hvt_ground.extras import Extra, Service

if TYPE_CHECKING:  # ``--help`` is to open no index
    from hvt_common.runtime.failures import Failures


_LIMIT = SettingType("LIMIT", parse_limit)
_AGE = SettingType("AGE", lambda text, *, name: Limit(seconds=parse_age_s(text, name=name)))
_STORE = Group("retention of recordings")


@dataclass(frozen=True)
class IndexOptions(GroundConfig):
    """The settings of ``hvt-ground`` for it."""

    keep: tuple[Limit, ...] = _STORE.option(
        _LIMIT,
        (),
        "remove recordings in the folder of --record older than this, or the oldest while all exceed this size",
        many=True,
        shown_default="all are kept",
    )
    keep_video: Limit | None = _STORE.option(
        _AGE, None, "remove the video of older recordings; stills, boxes and events stay until --keep"
    )


class IndexExtra(Extra[IndexOptions]):
    """The index of the folder of ``--record``, and its limits."""

    options = IndexOptions

    def check(self, config: IndexOptions) -> None:
        """Refuse limits that contradict, or that are of no folder."""
        ages = [one for one in config.keep if one.seconds is not None]
        for same in (ages, [one for one in config.keep if one not in ages]):
            if len(same) > 1:
                raise UserError(
                    f"--keep {same[0]} and --keep {same[1]} are both given: give one time and one size"
                )
        for name, given in (("--keep", config.keep[:1]), ("--keep-video", (config.keep_video,))):
            if any(given) and config.record_folder is None:
                raise UserError(
                    f"{name} {given[0]} needs a folder of recordings, and --record {config.record or 'is not given'}"
                    f"{' is a file' if config.record else ''}: give --record FOLDER/"
                )

    def serve(self, config: IndexOptions, *, clock: Callable[[], int], failures: Failures) -> Service | None:  # noqa: ARG002
        if config.record_folder is None:
            return None
        from hvt_archive.index.folder import RecordingsFolder  # noqa: PLC0415
        from hvt_archive.index.retention import Retention  # noqa: PLC0415

        limits = Retention(config.keep, config.keep_video)
        return RecordingsFolder(config.record_folder, limits, failures=failures)
