"""What several tests of the study share, made once."""

import pytest

from studies.small_study import write_scene


@pytest.fixture(scope="session")
def scene(tmp_path_factory):
    """URI of one drawn sequence, two seconds long, which nobody changes."""
    return write_scene(tmp_path_factory.mktemp("scene"), "street")
