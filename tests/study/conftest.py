"""What several tests of the study share, made once."""

import pytest
from matplotlib.figure import Figure

from studies.small_study import write_scene


@pytest.fixture(scope="session")
def scene(tmp_path_factory):
    """URI of one drawn sequence, two seconds long, which nobody changes."""
    return write_scene(tmp_path_factory.mktemp("scene"), "street")


@pytest.fixture(autouse=True, scope="module")
def savefig():
    """What writes PDF too, for the test of that: it takes three quarters of the time of a figure."""
    real = Figure.savefig
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Figure, "savefig", lambda *to, **as_: as_.get("format") == "pdf" or real(*to, **as_))
        yield real
