"""``hvt-ground keys``: what it writes, whom it lets do what, and what it refuses."""

import errno
import json
import os
import re
import subprocess
import sys
from pathlib import Path

import json5
import pytest
from cryptography import x509
from cryptography.x509.oid import NameOID

from hvt_common.errors import UserError
from hvt_common.transport.zenoh_config import LinkSettings, configure
from hvt_fleet.link.certificate import Rights
from hvt_fleet.pki import authority
from hvt_fleet.pki.command import run
from hvt_fleet.pki.roster import Roster
from hvt_ground.cli import main
from programs.fleet_keys import Fleet

DEPLOY = Path(__file__).resolve().parents[4] / "deploy"


@pytest.fixture
def fleet(tmp_path: Path) -> Fleet:
    """Two edges, a ground that commands, one that watches one of them, and a router."""
    fleet = Fleet(tmp_path / "keys")
    fleet.keys("add-edge", "uav-1")
    fleet.keys("add-edge", "rov-1", "--host", "198.51.100.4")
    fleet.keys("add-ground", "base", "--host", "192.0.2.1", "--host", "base.example")
    fleet.keys("add-ground", "guest", "--watch-only", "--edges", "uav-*")
    fleet.keys("add-router", "hub", "--host", "hub.example")
    return fleet


def _rights(fleet: Fleet, name: str) -> Rights:
    settings = LinkSettings("ground", connect=("tls/192.0.2.1:7447",), zenoh_config=fleet.file(name))
    return Rights.of(configure(settings)[0])


def _certificate(fleet: Fleet, name: str) -> x509.Certificate:
    return x509.load_pem_x509_certificate((fleet.folder / f"{name}.pem").read_bytes())


def test_a_certificate_says_who_and_where(fleet: Fleet) -> None:
    """Access control goes by the common name; who connects compares the address: one missing, and nothing works."""
    certificate = _certificate(fleet, "base")
    assert [one.value for one in certificate.subject.get_attributes_for_oid(NameOID.COMMON_NAME)] == ["base"]
    names = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    assert names.get_values_for_type(x509.DNSName) == ["base", "base.example"]
    assert [str(one) for one in names.get_values_for_type(x509.IPAddress)] == ["192.0.2.1"]
    ca = _certificate(fleet, "ca")
    certificate.verify_directly_issued_by(ca)
    assert ca.extensions.get_extension_for_class(x509.BasicConstraints).value.ca
    assert not certificate.extensions.get_extension_for_class(x509.BasicConstraints).value.ca


WRITTEN = ("base", "roi", "tracks", "status")
RIGHTS = (
    # who, which way, what, of which key, and in whose file it is allowed or not
    *(("uav-1", "ingress", "put", f"hvt/uav-1/{row}", {"base": True, "hub": True}) for row in WRITTEN),
    *(("uav-1", "ingress", "put", f"hvt/rov-1/{row}", {"base": False, "hub": False}) for row in WRITTEN),
    *(("uav-9", "ingress", "put", f"hvt/uav-9/{row}", {"base": False, "hub": False}) for row in WRITTEN),
    *(("uav-1", "egress", "put", f"hvt/rov-1/{row}", {"base": False, "hub": False}) for row in WRITTEN),
    ("uav-1", "ingress", "put", "hvt/uav-1/feedback", {"base": False, "hub": False}),
    ("uav-1", "ingress", "query", "hvt/rov-1/control", {"base": False, "hub": False}),
    ("uav-1", "ingress", "liveliness_token", "hvt/rov-1/alive", {"base": False, "hub": False}),
    # a guest with a screen must not be able to spend the drone's budget
    *(
        (ground, "egress", "put", "hvt/uav-1/base", {"uav-1": True, "hub": True})
        for ground in ("base", "guest")
    ),
    *(
        (ground, "ingress", "query", "hvt/uav-1/info", {"uav-1": True, "hub": True})
        for ground in ("base", "guest")
    ),
    *(
        (ground, "ingress", "put", "hvt/uav-1/base", {"uav-1": False, "hub": False})
        for ground in ("base", "guest")
    ),
    ("base", "ingress", "query", "hvt/uav-1/control", {"uav-1": True, "hub": True}),
    ("guest", "ingress", "query", "hvt/uav-1/control", {"uav-1": False, "hub": False}),
    # two customers on one router must not watch each other
    ("guest", "egress", "put", "hvt/rov-1/base", {"hub": False}),
    ("guest", "egress", "liveliness_token", "hvt/rov-1/alive", {"hub": False}),
    ("guest", "ingress", "query", "hvt/rov-1/info", {"hub": False}),
)


def test_each_machine_may_do_what_is_its_own(fleet: Fleet) -> None:
    """One captured drone could show another drone's picture, and a guest command; a key for others is none."""
    private = {"ca.key", "uav-1.key", "rov-1.key", "base.key", "guest.key", "hub.key"}
    assert {one.name: one.stat().st_mode & 0o077 for one in fleet.folder.glob("*.key")} == dict.fromkeys(
        private, 0
    )
    assert fleet.folder.stat().st_mode & 0o077 == 0
    rights = {name: _rights(fleet, name) for name in ("base", "guest", "hub", "uav-1", "rov-1")}
    for who, flow, message, key, allowed in RIGHTS:
        found = {name: rights[name].allow(who, flow=flow, message=message, key=key) for name in allowed}
        assert found == allowed, (who, flow, message, key)
    for name, commands in (("guest", False), ("base", True)):
        may = rights[name].allow_somebody(flow="egress", message="query", key="hvt/uav-1/control")
        assert may is commands
    known = {(name, who): rights[name].knows(who) for name in ("base", "hub") for who in ("uav-1", "uav-9")}
    assert known == {(name, who): who == "uav-1" for name, who in known}
    assert (rights["rov-1"].knows("base"), rights["rov-1"].knows("guest")) == (True, False)


def test_a_machine_that_is_removed_has_no_rights_anywhere(fleet: Fleet) -> None:
    """A lost drone's key is good for years: it must be worth nothing."""
    fleet.keys("remove", "uav-1")
    assert not (fleet.folder / "uav-1.key").exists()
    assert not fleet.file("uav-1").exists()
    for name in ("base", "guest", "hub"):
        assert not _rights(fleet, name).knows("uav-1")
        assert "uav-1" not in fleet.file(name).read_text()
    with pytest.raises(UserError, match="'uav-1' is not in this fleet: rov-1, base, guest, hub is"):
        fleet.keys("remove", "uav-1")


def test_a_new_machine_names_the_files_that_change(fleet: Fleet, capsys: pytest.CaptureFixture[str]) -> None:
    """Whoever copies only the new edge's files wonders why its ground sees nothing.

    The line at the head of its file is copied, too: without brackets the edge refuses the endpoint.
    """
    capsys.readouterr()
    fleet.keys("add-edge", "rov-2")
    said = capsys.readouterr().out
    assert "rov-2: copy ca.pem, rov-2.pem, rov-2.key and rov-2.json5 from" in said
    assert said.endswith("changed with it, copy again and restart what uses them: base.json5, hub.json5\n")
    fleet.keys("renew", "base", "--host", "2001:db8::1")
    assert "--connect tls/[2001:db8::1]:7447 " in fleet.file("rov-2").read_text().splitlines()[0]


def test_each_machine_has_its_keys_where_its_own_file_says(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A drone with its keys elsewhere would send the ground to look for its own there: it would not start."""
    folder = tmp_path / "keys"

    def keys(command: str, name: str, *words: str) -> None:
        run([command, name, "--dir", str(folder), *words])

    def where(name: str) -> set[str]:
        said = json5.loads((folder / f"{name}.json5").read_text())["transport"]["link"]["tls"]
        return {str(Path(path).parent) for path in said.values() if isinstance(path, str)}

    run(["new-ca", "--dir", str(folder)])
    keys("add-ground", "base", "--host", "192.0.2.1")
    keys("add-edge", "uav-1", "--keys-folder", 'drone/"A"')
    keys("add-edge", "uav-2")
    keys("add-ground", "ops", "--keys-folder", "/home/ops/keys")
    keys("remove", "uav-2")
    assert where("base") == {"/etc/hvt/tls"}
    assert where("uav-1") == {'drone/"A"'}
    assert where("ops") == {"/home/ops/keys"}
    capsys.readouterr()
    keys("add-edge", "uav-1", "--keys-folder", "/media/card")
    assert where("uav-1") == {"/media/card"}
    assert "changed with it" not in capsys.readouterr().out, "the others' files are as they were"


def test_list_says_who_may_what_until_when(fleet: Fleet, capsys: pytest.CaptureFixture[str]) -> None:
    """The only place to see the rights of a fleet at a glance."""
    capsys.readouterr()
    run(["list", "--dir", str(fleet.folder)])
    lines = capsys.readouterr().out.splitlines()
    named = [" ".join(line.split()[:2]) for line in lines]
    assert named == ["edge rov-1", "edge uav-1", "ground base", "ground guest", "router hub"]
    assert re.search(r"key until \d{4}-\d\d-\d\d  watches and commands \*$", lines[2])
    assert lines[3].endswith("watches uav-*")


def test_the_order_of_adding_does_not_matter(tmp_path: Path) -> None:
    """The roster decides, not who was there first: else some pair could not talk."""
    orders = [("uav-1", "base", "uav-2"), ("uav-2", "uav-1", "base")]
    texts = []
    for number, order in enumerate(orders):
        fleet = Fleet(tmp_path / str(number))
        for name in order:
            fleet.keys("add-ground" if name == "base" else "add-edge", name)
        texts.append([fleet.file(name).read_text().replace(str(fleet.folder), "") for name in sorted(order)])
    assert texts[0] == texts[1]


def test_the_router_with_keys_is_the_router_with_keys_added(fleet: Fleet) -> None:
    """Two files that drift apart would make a router behave differently for being secured."""
    plain = json5.loads((DEPLOY / "zenoh" / "router.json5").read_text(encoding="utf-8"))
    keyed = json5.loads(fleet.file("hub").read_text(encoding="utf-8"))
    assert keyed["transport"]["link"].pop("tls")["enable_mtls"] is True
    assert keyed.pop("access_control")["default_permission"] == "deny"
    assert plain.pop("listen") == {"endpoints": ["tcp/127.0.0.1:7447"]}
    assert keyed.pop("listen") == {"endpoints": ["tls/0.0.0.0:7447"]}
    assert keyed == plain


def test_zenoh_reads_every_file_also_of_a_fleet_of_one(tmp_path: Path) -> None:
    """Zenoh refuses empty lists: the first machine of a fleet must start all the same."""
    fleet = Fleet(tmp_path / "keys")
    for command, name in (("add-edge", "uav-1"), ("remove", "uav-1"), ("add-ground", "base")):
        fleet.keys(command, name)
        if command != "remove":
            assert _rights(fleet, name).enabled
            assert not _rights(fleet, name).knows("anybody")


def test_a_renewed_ground_stays_where_it_moved_to(fleet: Fleet) -> None:
    """The next renewal would name its old host: every edge would refuse it."""
    fleet.keys("renew", "base", "--host", "new.example")
    fleet.keys("renew", "base")
    names = _certificate(fleet, "base").extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    assert names.get_values_for_type(x509.DNSName) == ["base", "new.example"]
    assert "tls/new.example:7447" in fleet.file("uav-1").read_text()


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["add-edge", "ca"], "'ca' is reserved"),
        (["renew", "ca", "--host", "h"], "'ca' is not in this fleet"),
        (["add-edge", "base"], "'base' is the name of a ground"),
        (["add-ground", "uav-1"], "'uav-1' is the name of a edge"),
        (["add-router", "base", "--host", "h"], "'base' is the name of a ground"),
        (["add-edge", "../ca"], "edge id '../ca' is not usable"),
        (["add-edge", "UAV"], "edge id 'UAV' is not usable"),
        (["add-ground", "two", "--edges", "a/b"], "edge pattern 'a/b' is not usable"),
        (["add-ground", "two", "--host", "bä\u00dfe"], "--host 'bäße' is neither an address nor a host name"),
        (["add-ground", "two", "--host", "192.0.2.1:7447"], "neither an address nor a host name: give it without a"),
        (["add-router", "two"], "the following arguments are required: --host"),
        (["new-ca"], "already holds a CA"),
        (["frobnicate"], "invalid choice"),
    ],
)  # fmt: skip
def test_what_cannot_be_is_a_sentence_and_changes_nothing(
    fleet: Fleet, arguments: list[str], says: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """`add-edge ca` would overwrite the key that signs for the whole fleet."""
    before = {file: file.read_bytes() for file in fleet.folder.iterdir()}
    capsys.readouterr()
    assert main(["keys", *arguments, "--dir", str(fleet.folder)]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert says in said
    assert {file: file.read_bytes() for file in fleet.folder.iterdir()} == before


def test_a_disk_that_fills_up_between_key_and_certificate_changes_neither(
    fleet: Fleet, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The machine would have a new key beside its old certificate, which opens nothing; and a CA none at all."""
    before = {file: file.read_bytes() for file in fleet.folder.iterdir()}
    opens = os.open

    def full(path: Path, *given: int) -> int:
        if Path(path).name == "uav-1.pem.new":
            raise OSError(errno.ENOSPC, "No space left on device")
        return opens(path, *given)

    monkeypatch.setattr(os, "open", full)
    with pytest.raises(UserError, match=r"uav-1.pem cannot be written \(No space left on device\)"):
        fleet.keys("renew", "uav-1")
    assert {file: file.read_bytes() for file in fleet.folder.iterdir()} == before


@pytest.mark.parametrize("days", [100, 0])
def test_no_key_outlives_its_ca(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], days: int
) -> None:
    """A key of 825 days from a CA with a month left: programs that check it fall silent, and none had warned."""
    monkeypatch.setattr(authority, "CA_DAYS", days)
    fleet = Fleet(tmp_path / "keys")
    until = _certificate(fleet, "ca").not_valid_after_utc
    if not days:
        with pytest.raises(UserError, match=rf"the CA in \S+ ended on {until:%Y-%m-%d}: make another one"):
            fleet.keys("add-edge", "uav-1")
        assert not fleet.file("uav-1").exists()
        return
    fleet.keys("add-edge", "uav-1")
    assert _certificate(fleet, "uav-1").not_valid_after_utc == until
    assert f"keys ends on {until:%Y-%m-%d}, and its keys with it: make another" in capsys.readouterr().out


def test_a_folder_in_the_place_of_a_file_is_a_sentence(fleet: Fleet) -> None:
    """`remove` would end with a traceback, and nobody know whether the lost machine still has its rights."""
    fleet.file("uav-1").unlink()
    fleet.file("uav-1").mkdir()
    with pytest.raises(UserError, match=r"uav-1.json5 cannot be deleted"):
        run(["remove", "uav-1", "--dir", str(fleet.folder)])
    fleet.file("uav-1").rmdir()
    run(["remove", "uav-1", "--dir", str(fleet.folder)])
    assert "uav-1" not in Roster.read(fleet.folder).names


def test_a_folder_without_a_ca_or_with_a_foreign_roster_is_a_sentence(tmp_path: Path) -> None:
    """Run in the wrong folder, it must not begin a second fleet."""
    with pytest.raises(UserError, match="holds no CA: make one with hvt-ground keys new-ca"):
        run(["add-edge", "uav-1", "--dir", str(tmp_path)])
    assert list(tmp_path.iterdir()) == []
    for text in ("[]", "{", "[" * 99_999, json.dumps({"edges": ["A B"], "grounds": [], "routers": []})):
        (tmp_path / "fleet.json").write_text(text)
        with pytest.raises(UserError, match="is not a roster as hvt-ground keys writes it"):
            Roster.read(tmp_path)


def test_keys_need_no_models_and_no_viewer() -> None:
    """Keys are made on an office machine: `keys` must not wait for, or need, what only a flight needs."""
    code = (
        "import sys; from hvt_ground.cli import main; main(['keys', 'list', '--dir', '/nowhere']); "
        "print(sorted({'rerun', 'onnxruntime', 'av'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n"
