"""Fixtures that every test may use."""

import faulthandler
import gc
import logging
import os
import resource
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Generator, Iterator
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

from hvt_common.runtime import plug_ins
from hvt_common.runtime.process import STOP_SIGNALS
from hvt_common.video.still_codecs import still_codec

pytest.register_assert_rewrite("media", "programs", "rigs", "studies")  # a failed assert tells its values

from media.pictures import write_scene
from media.third_party import install
from programs.golden import FLIGHTS, once
from programs.processes import Link, free_ports
from rigs.drawn_flight import DrawnFlight, fly_into_all_sinks
from rigs.watched_flight import WatchedFlight, fly_watched

STDERR = pytest.StashKey[int]()
HANGS_S = 420
ROOT = Path(__file__).resolve().parent.parent

# Hypothesis' own 200 ms for an example, and its seconds to make them, are assertions on speed: a busy machine would
# break a property that holds. Here and not in a fixture: `@settings` takes what is loaded when its module is read.
# The same examples each time, so that a commit which passed once passes again; `make nightly` searches for others.
settings.register_profile("search", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.register_profile("hvt", settings.get_profile("search"), derandomize=True)
settings.load_profile("hvt")

# Containers often forbid bytecode; each start of a program would then compile all that it imports, a second and more.
sys.dont_write_bytecode = False
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)

# A signal that is ignored (`nohup`, a job of a script in the background) stays ignored in every process that a test
# starts, and a test of how a program ends on it would wait for ever. What is handled here begins there as usual.
for ending in (signal.SIGHUP, signal.SIGINT, signal.SIGTERM):
    if signal.getsignal(ending) is signal.SIG_IGN:
        signal.signal(ending, lambda *_: None)

# Some shells give a process 256 descriptors, and five hundred connections to one page need more.
files, most_files = resource.getrlimit(resource.RLIMIT_NOFILE)
if 0 <= files < (wanted := 4096 if most_files < 0 else min(4096, most_files)):
    resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, most_files))


def pytest_addoption(parser: pytest.Parser) -> None:
    """``--nightly``."""
    parser.addoption("--nightly", action="store_true", help="run the tests marked nightly or realtime, too")


def pytest_configure(config: pytest.Config) -> None:
    """By day the golden flights alone; what is said of a hang goes past what a test writes."""
    Link.flights = None if config.getoption("nightly") else FLIGHTS
    config.stash[STDERR] = os.dup(2)


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Those that wait for other processes come first, then the long ones; what is for the night is left out."""
    items.sort(
        key=lambda item: (item.get_closest_marker("integration") is None, "study" not in item.path.parts)
    )
    for item in items:
        if item.get_closest_marker("realtime"):
            item.add_marker("nightly")
        if item.get_closest_marker("nightly") and not config.getoption("nightly"):
            item.add_marker(pytest.mark.skip(reason="`make nightly` runs it"))


def pytest_collection_finish() -> None:
    """Six thousand tests live as long as the process: the collector does not look through them again and again."""
    gc.collect()
    gc.freeze()


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call() -> Generator[None, None, None]:
    """A program that ended badly tells why: its exception alone names only command and exit code."""
    try:
        return (yield)
    except subprocess.CalledProcessError as error:
        error.add_note(f"it said: {error.stderr or error.stdout}")
        raise


pytest_runtest_setup = pytest_runtest_call


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_teardown(item: pytest.Item) -> None:
    """A test that failed has no limit any more, and what it leaves may hang: the run would never end."""
    faulthandler.dump_traceback_later(HANGS_S, exit=True, file=item.config.stash[STDERR])


@pytest.fixture(autouse=True)
def _process_as_found() -> Iterator[None]:
    """A program that a test calls in this process takes signals, log and hooks for itself: the next finds its own."""
    signals = {one: signal.getsignal(one) for one in STOP_SIGNALS}
    hooks = sys.excepthook, threading.excepthook
    priority = os.getpriority(os.PRIO_PROCESS, 0)
    threads = set(threading.enumerate())
    yield
    for thread in set(threading.enumerate()) - threads:
        if (
            thread.name.startswith("hvt-") and thread.name != "hvt-detector"
        ):  # which lives as the process does
            thread.join(20.0)
            assert not thread.is_alive(), f"{thread.name} goes on into the tests after it"
    assert os.getpriority(os.PRIO_PROCESS, 0) == priority, "all tests after it would give way"
    sys.excepthook, threading.excepthook = hooks
    for one, handler in signals.items():
        signal.signal(one, handler)
    logging.captureWarnings(capture=False)
    root = logging.getLogger()
    for held in [one for one in root.handlers if type(one).__module__.startswith("hvt_")]:
        root.removeHandler(held)
    for name, logger in root.manager.loggerDict.items():
        if name.startswith("hvt") and isinstance(logger, logging.Logger) and logger.level:
            logger.setLevel(logging.NOTSET)


@pytest.fixture(autouse=True, scope="session")
def _state_home(tmp_path_factory: pytest.TempPathFactory) -> None:
    """No test, and no process that one starts, keeps anything in the home of whoever runs it."""
    os.environ["XDG_STATE_HOME"] = str(tmp_path_factory.mktemp("state"))


@pytest.fixture(scope="session")
def data() -> Path:
    """The folder of real clips, models and tracks; a test that asks for it is skipped where it is absent."""
    folder = Path(os.environ.get("HVT_DATA", ROOT.parent / "shared" / "data"))
    if not folder.is_dir():
        pytest.skip(f"no real data at {folder}; set HVT_DATA to the folder that holds it")
    return folder


@pytest.fixture(scope="session")
def drawn(tmp_path_factory: pytest.TempPathFactory) -> DrawnFlight:
    """A flight of the drawn scene into all sinks, that tests of several files read and nobody changes."""
    return once(tmp_path_factory, "drawn", fly_into_all_sinks)


@pytest.fixture(scope="session")
def watched(long_scene: Path, tmp_path_factory: pytest.TempPathFactory) -> WatchedFlight:
    """A flight that Prometheus, a probe and a collector of logs look at, that tests of several files read."""
    return once(tmp_path_factory, "watched", lambda folder: fly_watched(folder, long_scene))


@pytest.fixture(scope="session")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of pictures that lasts 30 s at 10 a second; the drawn demo would take seconds to begin."""
    return once(tmp_path_factory, "scene", lambda folder: write_scene(folder, frames=300))


@pytest.fixture(scope="session")
def long_scene(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The pictures of the scene over and over, for five minutes."""
    folder, pictures = tmp_path_factory.mktemp("long"), sorted(scene.iterdir())
    for number in range(3000):
        (folder / f"{number:06d}.jpg").symlink_to(pictures[number % len(pictures)])
    return folder


@pytest.fixture
def packages(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., None]]:
    """Installs a third party's package for one test and this process; the arguments are those of `install`."""

    def forget() -> None:
        plug_ins.installed.cache_clear()
        still_codec.cache_clear()

    def put(parts: dict[str, str], **options: str) -> None:
        folder = str(install(tmp_path / "site", parts, **options))
        if folder not in sys.path:
            monkeypatch.syspath_prepend(folder)
        forget()

    yield put
    monkeypatch.undo()
    forget()
    for name in [name for name in sys.modules if name.startswith("acme_")]:
        del sys.modules[name]


@pytest.fixture
def free_port() -> int:
    """A TCP port that nobody listens on at this moment, and that no other test process picks."""
    return free_ports(1)[0]
