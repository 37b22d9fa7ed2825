"""The ground's end of the link, from the settings."""

from __future__ import annotations

from hvt_common.transport.zenoh_config import LinkSettings
from hvt_ground.config import GroundConfig


def make_link_settings(config: GroundConfig) -> LinkSettings:
    """The ground's settings of Zenoh."""
    return LinkSettings(
        role="ground",
        listen=config.listen,
        connect=config.connect,
        zenoh_config=config.zenoh_config,
        insecure=config.insecure,
        links=2 if config.links == 2 else 1,
    )
