"""Models by name: fetched from a real HTTP server on loopback, brought by hand, checked before use."""

import hashlib
import re
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from functools import partial
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import numpy as np
import pytest
import tomli_w

from hvt_common.errors import UserError
from hvt_common.inference.classify import OnnxClassifier, open_classifier
from hvt_common.inference.detect import OnnxDetector, open_detector
from hvt_common.inference.runtimes.model import open_model
from hvt_common.inference.store import embedded_models, resolve_model
from hvt_models.command import main
from hvt_models.heads import KINDS
from hvt_models.inspect import inspect_model
from hvt_models.manifest import builtin_manifest
from hvt_models.store import Store, cache_folder, file_digest
from media.onnx_models import colour_classifier, colour_detector, constant_model
from programs.small_disk import files_at_most

CONTENT = np.random.default_rng(7).bytes(300_000)
DIGEST = hashlib.sha256(CONTENT).hexdigest()
ONE_TRY: tuple[float, ...] = ()


class Origin(ThreadingHTTPServer):
    """Serves ``CONTENT``; ``plan`` says how each request in turn is treated, and the last entry all that follow."""

    daemon_threads = True

    def __init__(self) -> None:
        super().__init__(("127.0.0.1", 0), _Handler)
        self.content = CONTENT
        self.plan: list[str] = ["ok"]
        self.asked: list[tuple[str, str | None]] = []
        """(path, Range header) of each request."""
        self.begun = threading.Event()
        self.go_on = threading.Event()

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.server_port}/model.onnx"


class _Handler(BaseHTTPRequestHandler):
    server: Origin

    def do_GET(self) -> None:  # noqa: C901  (one line a kind of answer)
        origin = self.server
        wanted = self.headers.get("Range")
        origin.asked.append((self.path, wanted))
        deed, _, number = (origin.plan.pop(0) if len(origin.plan) > 1 else origin.plan[0]).partition(":")
        start = int(wanted.removeprefix("bytes=").removesuffix("-")) if wanted else 0
        body = origin.content
        if deed == "status":
            self.send_error(int(number))
        elif deed == "redirect":
            self.send_response(302)
            self.send_header("Location", "/elsewhere.onnx")
            self.end_headers()
        elif deed == "wrong":
            self._send(200, b"x" * len(body))
        elif deed == "other-size":
            self._send(200, body + b"more")
        elif deed == "endless":
            self._send(200, body + b"more", length=False)
        elif deed == "no-range":
            self._send(200, body[: int(number)] if number else body, of=len(body))
        elif deed == "other-range":
            self._send(206, body[start:], span=f"bytes 0-{len(body) - 1}/{len(body)}")
        elif deed == "grown":
            self._send(206, body[start:], span=f"bytes {start}-{len(body)}/{len(body) + 1}")
        else:
            if deed == "hold":
                origin.begun.set()
                origin.go_on.wait(60)
            rest = body[start:]
            sent = rest[: int(number)] if deed == "cut" else rest
            if start:
                self._send(206, sent, of=len(rest), span=f"bytes {start}-{len(body) - 1}/{len(body)}")
            else:
                self._send(200, sent, of=len(rest))

    def _send(
        self, status: int, data: bytes, *, of: int | None = None, span: str = "", length: bool = True
    ) -> None:
        self.send_response(status)
        if length:
            self.send_header("Content-Length", str(len(data) if of is None else of))
        if span:
            self.send_header("Content-Range", span)
        self.end_headers()
        self.wfile.write(data)

    def log_message(self, *_: object) -> None:
        pass


@pytest.fixture
def origin(monkeypatch: pytest.MonkeyPatch) -> Iterator[Origin]:
    monkeypatch.setenv("no_proxy", "127.0.0.1")
    server = Origin()
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.02})
    thread.start()
    yield server
    server.shutdown()
    thread.join()
    server.server_close()


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The cache folder, made the user's own."""
    monkeypatch.setenv("HVT_MODELS", str(tmp_path / "cache"))
    return tmp_path / "cache"


def known(folder: Path, *urls: str, name: str = "made", content: bytes = CONTENT) -> Store:
    """A store that knows one more model, from these addresses."""
    folder.mkdir(parents=True, exist_ok=True)
    table = {"size_bytes": len(content), "sha256": hashlib.sha256(content).hexdigest(), "urls": list(urls)}
    (folder / "added.toml").write_text(tomli_w.dumps({name: table}))
    return Store(folder)


def test_a_fetched_model_is_whole_checked_and_fetched_once(origin: Origin, folder: Path) -> None:
    """Nothing could be fetched, or each start of a drone would download again."""
    store = known(folder, origin.url)
    held: list[int] = []
    path = store.fetch("made", progress=held.append)
    assert path == folder / "made.onnx"
    assert path.read_bytes() == CONTENT
    assert held == sorted(held)
    assert held[-1] == len(CONTENT)
    assert store.fetch("made") == store.verified("made") == path
    assert origin.asked == [("/model.onnx", None)]
    assert [one.name for one in folder.iterdir() if one.suffix == ".part"] == []


@pytest.mark.parametrize(
    ("plan", "asked"),
    [
        ("cut:100000 cut:50000 ok", ["model", "model 100000", "model 150000"]),
        ("no-range:1000 no-range", ["model", "model 1000"]),  # else the second half behind the whole file
        ("cut:1000 status:416 ok", ["model", "model 1000", "model"]),  # else it fails for ever
        (
            "redirect cut:500 redirect ok",
            ["model", "elsewhere", "model 500", "elsewhere 500"],
        ),  # as of release pages
        ("status:404 cut:700 ok", ["gone", "model", "model 700"]),
    ],
)
def test_a_transfer_goes_on_where_it_broke_off(
    origin: Origin, folder: Path, plan: str, asked: list[str]
) -> None:
    """On a thin link 100 MB would never arrive; a host that takes a model down would take HVT's users with it."""
    origin.plan = plan.split()
    urls = [origin.url.replace("model", "gone"), origin.url][asked[0] != "gone" :]
    assert known(folder, *urls).fetch("made", pauses_s=(0, 0)).read_bytes() == CONTENT
    spans = [
        (f"/{path}.onnx", at and f"bytes={at}-") for path, _, at in (one.partition(" ") for one in asked)
    ]
    assert [(path, span or "") for path, span in origin.asked] == spans


def test_a_later_command_goes_on_where_an_earlier_one_broke_off(origin: Origin, folder: Path) -> None:
    """After a power cut, or Ctrl-C, everything would be downloaded again."""
    store = known(folder, origin.url)
    origin.plan = ["cut:1000"]
    with pytest.raises(
        UserError, match=r"broke off after 1000 of 300000 bytes.*1000 bytes are kept"
    ) as caught:
        store.fetch("made", pauses_s=ONE_TRY)
    assert "hvt-models add FILE --name made" in str(caught.value)
    assert not store.is_there("made")
    assert store.held_bytes("made") == 1000
    origin.plan = ["ok"]
    assert Store(folder).fetch("made").read_bytes() == CONTENT
    assert origin.asked[-1] == ("/model.onnx", "bytes=1000-")


@pytest.mark.parametrize("answer", ["other-range", "grown"])
def test_a_range_that_was_not_asked_for_is_not_appended(origin: Origin, folder: Path, answer: str) -> None:
    """A proxy that answers with another range would garble the file."""
    store = known(folder, origin.url)
    origin.plan = ["cut:1000", answer]
    with pytest.raises(UserError, match=r"was not asked for|has 300001 bytes, not the 300000"):
        store.fetch("made", pauses_s=(0,))
    assert store.held_bytes("made") == 1000
    origin.plan = ["ok"]
    assert store.fetch("made").read_bytes() == CONTENT


@pytest.mark.parametrize("garbage", [b"\0" * 2000, b"\0" * len(CONTENT), b"\0" * (len(CONTENT) + 5)])
def test_garbage_in_a_part_costs_one_fetch_and_no_more(origin: Origin, folder: Path, garbage: bytes) -> None:
    """A part that a worn memory card damaged would make every further fetch fail."""
    store = known(folder, origin.url)
    (folder / f"made-{DIGEST[:12]}.part").write_bytes(garbage)
    assert store.fetch("made", pauses_s=ONE_TRY).read_bytes() == CONTENT


@pytest.mark.parametrize(
    ("answer", "words"),
    [
        ("wrong", rf"SHA-256 {'[0-9a-f]' * 12}…, not the pinned {DIGEST[:12]}…"),
        ("other-size", "has 300004 bytes.*300000"),
        ("endless", "sends more.*300000"),
    ],
)
def test_what_is_not_pinned_is_never_put_in_place(
    origin: Origin, folder: Path, answer: str, words: str
) -> None:
    """A model that someone swapped on the server would fly, or an error page of gigabytes fill the disk."""
    store = known(folder, origin.url)
    origin.plan = [answer]
    with pytest.raises(UserError, match=words):
        store.fetch("made", pauses_s=ONE_TRY)
    assert not store.is_there("made")
    assert store.held_bytes("made") <= (0 if answer == "wrong" else len(CONTENT))
    assert len(origin.asked) == 1


def test_a_missing_file_and_a_dead_host_are_one_sentence(origin: Origin, folder: Path) -> None:
    """A user without a network would read a traceback."""
    origin.plan = ["status:404"]
    with ThreadingHTTPServer(("127.0.0.1", 0), _Handler) as closed:
        dead = f"http://127.0.0.1:{closed.server_port}/m.onnx"
    with pytest.raises(UserError, match=r"answers 404 Not Found; .* cannot be reached .*add FILE") as caught:
        known(folder, origin.url, dead).fetch("made")
    assert "\n" not in str(caught.value)
    assert len(origin.asked) == 1  # 404 is an answer: asking again brings nothing


def test_a_busy_server_is_asked_again_but_not_for_ever(origin: Origin, folder: Path) -> None:
    """One hiccup of a server would end the fetch, or a dead one would hold it for ever."""
    origin.plan = ["status:503", "status:503", "ok"]
    assert known(folder, origin.url).fetch("made", pauses_s=(0, 0, 0)).exists()
    origin.plan, origin.asked = ["status:503"], []
    store = known(folder, origin.url, name="other")
    with pytest.raises(UserError, match="answers 503"):
        store.fetch("other", pauses_s=(0, 0, 0))
    assert len(origin.asked) == 3


def test_a_file_that_was_tampered_with_is_not_used(origin: Origin, folder: Path) -> None:
    """Whoever can write into the cache could choose what a drone sees."""
    store = known(folder, origin.url)
    path = store.fetch("made")
    assert resolve_model("made") == path
    changed = bytearray(CONTENT)
    changed[123] ^= 1
    for content, words in ((bytes(changed), "has SHA-256"), (CONTENT[:-1], "has 299999 bytes")):
        path.write_bytes(content)
        for use in (lambda: resolve_model("made"), lambda: open_detector("made")):
            with pytest.raises(UserError, match=f"made.onnx {words}.*not used.*hvt-models fetch made"):
                use()
    assert store.fetch("made").read_bytes() == CONTENT


def test_a_folder_that_cannot_be_written_is_one_sentence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A read-only card in a drone would end in a traceback."""
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("HVT_MODELS", str(tmp_path / "file" / "cache"))
    digest = hashlib.sha256(Path(__file__).read_bytes()).hexdigest()
    for words in (["fetch", "yolox-nano"], ["add", __file__, "--name", "x", "--sha256", digest]):
        assert main(words) == 2
        assert "cannot be written (Not a directory): set HVT_MODELS" in capsys.readouterr().err
    assert main(["list"]) == 0


def test_a_full_disk_is_one_sentence_and_keeps_what_came(origin: Origin, folder: Path) -> None:
    """A fetch that fills the disk would leave a file that looks whole."""
    store = known(folder, origin.url)
    # -B: a .pyc that the limit cut off would break every later Python of this environment.
    command = f"ulimit -f 200; exec {sys.executable} -B -m hvt_models.command fetch made"
    done = subprocess.run(["sh", "-c", command], capture_output=True, text=True, check=False)
    assert done.returncode == 2, done.stderr
    assert "made-" in done.stderr
    assert "cannot be written (File too large): free" in done.stderr
    assert "Traceback" not in done.stderr
    assert not store.is_there("made")
    assert 0 < store.held_bytes("made") < len(CONTENT)
    assert store.fetch("made").read_bytes() == CONTENT


def test_two_processes_fetch_one_model_once(origin: Origin, folder: Path) -> None:
    """Edge and ground started together would write into each other's file."""
    known(folder, origin.url)
    origin.plan = ["hold"]

    def start() -> subprocess.Popen[str]:
        command = [sys.executable, "-m", "hvt_models.command", "fetch", "made"]
        return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)

    first = start()
    assert origin.begun.wait(60)
    second = start()
    assert second.stderr is not None
    assert any("another process fetches made" in line for line in iter(second.stderr.readline, ""))
    origin.go_on.set()
    (one, failed), (two, also_failed) = first.communicate(), second.communicate()
    assert [first.returncode, second.returncode] == [0, 0], failed + also_failed
    assert [one.strip(), two.strip()] == [str(folder / "made.onnx")] * 2
    assert len(origin.asked) == 1
    assert (folder / "made.onnx").read_bytes() == CONTENT


def test_a_missing_model_says_how_to_get_it(folder: Path) -> None:
    """A newcomer who names a model would not know where it comes from, or find it fetched without a word."""
    for use in (lambda: open_detector("yolox-s"), lambda: open_classifier("resnet50")):
        with pytest.raises(UserError) as caught:
            use()
        sentence = str(caught.value)
        assert "\n" not in sentence
        assert "is not on this machine: run 'hvt-models fetch " in sentence
        assert "where there is no network, bring https://" in sentence
        assert "run 'hvt-models add FILE --name " in sentence
    assert not folder.exists()


def test_a_name_that_nobody_knows_says_the_near_one(folder: Path, tmp_path: Path) -> None:
    """A typing mistake would be answered with a riddle."""
    with pytest.raises(UserError, match=r"detector 'yolox-ss' is not known \(did you mean yolox-s.*motion"):
        open_detector("yolox-ss")
    with pytest.raises(UserError, match=r"model x/none\.onnx does not exist"):
        resolve_model("x/none.onnx")
    plain = tmp_path / "plain.onnx"
    plain.write_bytes(b"")
    assert resolve_model(str(plain)) == plain


def test_a_file_brought_by_hand_is_taken_in_if_its_digest_is_right(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A machine without a network could not get a model, or would take any file for it."""
    file = colour_detector(tmp_path / "mine.onnx", "yolox")
    digest = hashlib.sha256(file.read_bytes()).hexdigest()

    def add(name: str = "mine", sha256: str = digest, *, path: Path = file) -> int:
        return main(["add", str(path), "--name", name, *(["--sha256", sha256] if sha256 else [])])

    for words, said in (
        (("mine", ""), f"give --sha256 {digest} if its origin says the same"),
        (("mine", "0" * 64), f"has SHA-256 {digest}, but --sha256 is {'0' * 64}"),
        (("yolox-s",), "is pinned for yolox-s"),
        (("Mine",), "model name 'Mine' is not accepted"),
        *(((taken,), f"model name '{taken}' is HVT's own") for taken in ("aerial-nano", "motion", "none")),
    ):
        assert add(*words) == 2
        assert said in capsys.readouterr().err
    assert add(path=tmp_path / "none") == 2
    assert "cannot be read (No such file" in capsys.readouterr().err
    assert not (folder / "mine.onnx").exists()
    assert add(sha256=digest.upper()) == main(["path", "mine"]) == 0
    assert capsys.readouterr().out.split() == [str(folder / "mine.onnx")] * 2
    assert isinstance(open_detector("mine"), OnnxDetector)
    assert add(sha256="") == 0, "its pin is known by now"
    file.write_bytes(file.read_bytes() + b"\x30\x01")
    assert add(sha256="") == add() == 2
    assert (folder / "mine.onnx").read_bytes() != file.read_bytes()


def test_a_full_disk_leaves_the_model_of_before(folder: Path, tmp_path: Path) -> None:
    """Its new pin would stand beside the old file, which is then refused."""
    store = Store(folder)
    small, large = tmp_path / "small.onnx", tmp_path / "large.onnx"
    small.write_bytes(b"1")
    large.write_bytes(bytes(2**16))
    store.add(small, name="mine", sha256=file_digest(small))
    with files_at_most(2**15), pytest.raises(UserError, match="cannot be copied"):
        store.add(large, name="mine", sha256=file_digest(large))
    with files_at_most(1), pytest.raises(UserError, match=r"added.toml cannot be written"):
        store.add(small, name="other", sha256=file_digest(small))
    assert store.verified("mine").read_bytes() == b"1"


def two_files(folder: Path, origin: Origin) -> Store:
    """A store that knows an OpenVINO model; the server gives the same bytes for both of its files."""
    folder.mkdir(parents=True, exist_ok=True)
    pin = {"size_bytes": len(CONTENT), "sha256": DIGEST}
    weights = {**pin, "urls": [origin.url.replace("onnx", "bin")]}
    table = {**pin, "urls": [origin.url.replace("onnx", "xml")], "weights": weights}
    (folder / "added.toml").write_text(tomli_w.dumps({"made": table}))
    return Store(folder)


def test_an_openvino_model_is_fetched_and_checked_in_both_files(origin: Origin, folder: Path) -> None:
    """Its weights would be missing, or be anybody's."""
    store = two_files(folder, origin)
    origin.plan = ["ok", "cut:1000", "ok"]
    held: list[int] = []
    with pytest.raises(UserError, match=r"301000 bytes are kept.*model\.xml and http.*model\.bin and run"):
        store.fetch("made", pauses_s=ONE_TRY)
    assert not store.is_there("made")
    assert store.held_bytes("made") == len(CONTENT) + 1000
    assert store.fetch("made", progress=held.append) == folder / "made.xml"
    assert origin.asked == [("/model.xml", None), ("/model.bin", None), ("/model.bin", "bytes=1000-")]
    assert held[-1] == 2 * len(CONTENT)
    (folder / "made.bin").write_bytes(CONTENT[::-1])
    with pytest.raises(UserError, match=r"made\.bin has SHA-256 .* and is not used"):
        resolve_model("made")


def test_an_openvino_model_is_brought_by_hand_with_its_weights(folder: Path, tmp_path: Path) -> None:
    """The .bin would stay behind, unpinned."""
    file, weights = tmp_path / "theirs.xml", tmp_path / "theirs.bin"
    file.write_bytes(b"<net/>")
    store = Store(folder)
    with pytest.raises(UserError, match=r"theirs\.bin cannot be read"):
        store.add(file, name="own", sha256=DIGEST)
    weights.write_bytes(b"weights")
    digests = ",".join(hashlib.sha256(one.read_bytes()).hexdigest() for one in (file, weights))
    for said in (None, digests.partition(",")[0], digests[::-1]):
        with pytest.raises(UserError, match="SHA-256"):
            store.add(file, name="own", sha256=said)
    assert not folder.exists()
    assert store.add(file, name="own", sha256=digests) == Store(folder).verified("own")
    assert (folder / "own.bin").read_bytes() == b"weights"
    weights.write_bytes(b"changed")
    with pytest.raises(UserError, match="is pinned for own"):
        store.add(file, name="own")
    other = tmp_path / "theirs.onnx"
    other.write_bytes(b"onnx")
    Store(folder).add(other, name="own", sha256=hashlib.sha256(b"onnx").hexdigest())
    left = sorted(one.name for one in folder.iterdir() if one.name.startswith("own."))
    assert left == ["own.onnx"], "nothing of the format before"


@pytest.mark.realdata
def test_the_open_model_zoo_is_known_by_name(data: Path, folder: Path) -> None:
    """A digit of a pin, or the order of the classes, would be wrong for everybody."""
    pytest.importorskip("openvino")
    for name, first in (("pvb-2003", "vehicle"), ("pvb-2001", "vehicle"), ("crossroad-1016", "bike")):
        file = f"{name}-int8" if name == "crossroad-1016" else name
        Store().add(data / f"models/omz/{file}.xml", name=name)
        assert open_detector(name).class_names[0] == first


def test_list_and_verify_say_what_is_here(
    origin: Origin, folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Before a flight nobody could see which models are aboard, and whether they are whole."""
    monkeypatch.setenv("COLUMNS", "140")
    assert main(["verify"]) == 0
    assert "no models in" in capsys.readouterr().out
    store = known(folder, origin.url)
    origin.plan = ["cut:150000", "ok"]
    with pytest.raises(UserError):
        store.fetch("made", pauses_s=ONE_TRY)
    assert main(["list"]) == 0
    shown = capsys.readouterr().out
    assert "50 %" in shown
    assert all(name in shown for name in builtin_manifest())
    assert main(["fetch", "made"]) == 0
    assert main(["verify"]) == 0
    assert "made: size and SHA-256 are right" in capsys.readouterr().out
    (folder / "made.onnx").write_bytes(b"short")
    assert main(["verify", "made", "yolox-s"]) == 2
    captured = capsys.readouterr().err
    assert "made.onnx has 5 bytes" in captured
    assert "yolox-s is not on this machine" in captured


@pytest.mark.parametrize(
    "argv",
    [
        [],
        ["fetch"],
        ["fetch", "yolox-q"],
        ["path", "nothing"],
        ["info", "no.onnx"],
        ["x"],
        ["verify", "a\n", "b"],
    ],
)
def test_wrong_arguments_are_one_sentence(
    folder: Path, argv: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    """A mistyped command would print a page of usage or a traceback."""
    assert main(argv) == 2
    assert len(capsys.readouterr().err.strip().splitlines()) == 1
    assert not folder.exists()


def test_the_manifest_pins_the_files_that_are_known(folder: Path, origin: Origin) -> None:
    """A slip in a digit would make a model unfetchable; a file in the cache put another under a known name."""
    facts = {
        "yolox-s": (35858002, "c5c2d13e59ae883e6af3b45daea64af4833a4951c92d116ec270d9ddbe998063"),
        "yolox-s-int8": (9143614, "b8c1766fb329f0bd2845a53f5e2ed1f9b555f65ee9a5fd5231ebd367927588ce"),
        "resnet50": (102576419, "ab65bdc02c5b3123eb3cdf6dac01742438517d8635d4f233913b2be1c70db3b6"),
        "resnet50-int8": (25816052, "c234f30975989788b4405f25253275aae247ab6dbdd34aaa69ab0a59ff76f6d0"),
    }
    manifest, of_openvino = builtin_manifest(), {"pvb-2003", "pvb-2001", "crossroad-1016"}
    assert {"yolox-nano", "yolox-tiny", *facts, *of_openvino} == manifest.keys()
    assert {name for name, entry in manifest.items() if entry.weights is not None} == of_openvino
    assert {name: (manifest[name].size_bytes, manifest[name].sha256) for name in facts} == facts
    assert {entry.licence for entry in manifest.values()} == {"Apache-2.0"}
    for entry in manifest.values():
        assert entry.task in ("detector", "classifier")
        assert entry.preprocessing is not None
        for file in entry.files.values():
            assert {url.partition("://")[0] for url in file.urls} == {"https"}
    assert known(folder, origin.url, name="yolox-s").entry("yolox-s") == manifest["yolox-s"]


def test_the_manifest_and_the_adapters_prepare_pixels_alike(tmp_path: Path) -> None:
    """Whoever follows the manifest elsewhere would feed the network other pixels than HVT does."""
    head = OnnxDetector(open_model(colour_detector(tmp_path / "d.onnx", "yolox"))).head
    classifier = open_classifier(str(colour_classifier(tmp_path / "c.onnx", classes=1000)))
    assert isinstance(classifier, OnnxClassifier)
    preparation = classifier.preparation
    for entry in builtin_manifest().values():
        said = entry.preprocessing
        assert said is not None
        if entry.weights is not None:
            own = KINDS[{"crossroad-1016": "ssd", "pvb-2001": "ssd", "pvb-2003": "atss"}[entry.name]]
            assert (said["fit"], said["channels"], said["mean"]) == (own.anchor, "BGR", [0])
        elif entry.task == "detector":
            assert said["fit"] == f"letterbox, {head.anchor}, 114"
            assert (said["channels"] == "RGB", said["mean"], said["scale"]) == (
                head.preparation.rgb,
                [0],
                [head.preparation.scale[0]],
            )
        else:
            assert said["channels"] == ("RGB" if preparation.rgb else "BGR")
            assert said["mean"] == list(preparation.mean)
            np.testing.assert_allclose(said["scale"], preparation.scale, rtol=1e-5)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[", "not valid TOML"),
        ("a = 1", "model 'a' that needs size_bytes and sha256"),
        ("[a]\nsize_bytes = 1", "needs size_bytes and sha256"),
        (f"[a]\nsize_bytes = 1\nsha256 = '{DIGEST}'\nurl = 'x'", "takes about, classes"),
        (f"[a]\nsize_bytes = 0\nsha256 = '{DIGEST}'", "size_bytes 0 of 'a'"),
        (f"[a]\nsize_bytes = 1\nsha256 = '{DIGEST[1:]}'", "64 hexadecimal digits"),
        (
            f"[a]\nsize_bytes = 1\nsha256 = '{DIGEST}'\nurls = ['file:///etc/passwd']",
            "http and https addresses",
        ),
        (f"['../a']\nsize_bytes = 1\nsha256 = '{DIGEST}'", "model name '../a'"),
    ],
)
def test_a_wrong_manifest_of_the_user_is_one_sentence(folder: Path, text: str, words: str) -> None:
    """A hand-written added.toml could write outside the folder, read local files, or end in a traceback."""
    folder.mkdir()
    (folder / "added.toml").write_text(text)
    with pytest.raises(UserError, match=words):
        _ = Store(folder).entries


def test_the_cache_is_the_platforms_unless_the_user_names_one(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Models would be strewn over the working folders."""
    monkeypatch.setenv("HVT_MODELS", "~/here")
    assert cache_folder() == Path.home() / "here"
    monkeypatch.delenv("HVT_MODELS")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    if sys.platform == "linux":
        assert cache_folder() == tmp_path / "hvt" / "models"


def test_embedded_models_are_found_by_name(folder: Path) -> None:
    """The defaults would not open on a machine that never fetched anything."""
    for name, path in embedded_models().items():
        assert resolve_model(name) == path
        assert open_model(path).path == path


INFO: list[tuple[Callable[[Path], Path], str, str]] = [
    (
        partial(colour_detector, head="yolox"),
        "detector",
        "head yolox .*counted from it; BGR 0…255, letterbox top-left",
    ),
    (
        partial(colour_detector, head="ultralytics"),
        "detector",
        "head yolov8 .*: a column a cell: .*; RGB 0…1, letterbox centre",
    ),
    (colour_classifier, "classifier", "RGB, .pixel - 123.675 116.28 103.53. / 58.395"),
    (
        lambda path: constant_model(path, np.ones((1, 2, 8, 8))),
        "none",
        "fit no head that is known; no output is one row",
    ),
]


@pytest.mark.parametrize(("make", "adapter", "because"), INFO)
def test_info_says_which_adapter_fits_and_why(
    tmp_path: Path,
    make: Callable[[Path], Path],
    adapter: str,
    because: str,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """A user with a model of their own would try --detector and --classifier in turn and guess."""
    report = inspect_model(make(tmp_path / "m.onnx"))
    assert report.adapter == adapter
    assert re.search(because, report.because), report.because
    assert bool(report.class_names) == (adapter != "none")
    assert (report.median_ms is not None) == (adapter != "none")
    assert report.opsets.keys() == {""}
    assert main(["info", str(tmp_path / "m.onnx"), "--provider", "tensorrt"]) == 2
    assert capsys.readouterr().err.count("\n") == 1
    assert main(["info", str(tmp_path / "m.onnx")]) == 0
    shown = " ".join(capsys.readouterr().out.split())
    assert f"adapter {adapter}" in shown
    assert f"opset ai.onnx {report.opsets['']}" in shown
    assert f"size {(tmp_path / 'm.onnx').stat().st_size} bytes" in shown
