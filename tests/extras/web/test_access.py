"""Who may open the page: tokens that several grounds of one machine share."""

from concurrent.futures import ThreadPoolExecutor
from threading import Barrier

import pytest

from hvt_web.access import Access, cookie_name, crowding, own_tokens

GROUNDS = 8
OPERATOR = {"x-hvt-role": "operator"}


def test_grounds_that_start_at_once_agree_on_their_tokens(tmp_path):
    """All but one would end with a sentence that nobody understands, or know tokens that no link has."""
    together = Barrier(GROUNDS)

    def start(folder):
        together.wait()
        return own_tokens(folder)

    with ThreadPoolExecutor(GROUNDS) as pool:
        for number in range(20):
            folder = tmp_path / str(number)
            found = list(pool.map(start, [folder] * GROUNDS))
            assert all(one == found[0] for one in found)
            assert [one.name for one in folder.iterdir()] == ["web-tokens.json"]
            assert (folder / "web-tokens.json").stat().st_mode & 0o777 == 0o600


@pytest.mark.parametrize(
    ("host", "name"),
    [("10.8.0.1:8080", "hvt-8080"), ("10.8.0.1", "hvt-80"), ("[::1]:81", "hvt-81"), ("", "hvt")],
)
def test_a_cookie_is_of_the_port_that_the_browser_sees(host, name):
    """Two grounds of one host would throw each other's viewers out: cookies know no port."""
    assert cookie_name({"host": host}) == name


@pytest.mark.parametrize(
    ("port", "cookie", "role"),
    [
        (8080, f"hvt-8080={'o' * 20}; hvt-8081=other", "operator"),
        (8081, f"hvt-8080={'o' * 20}; hvt-8081=other", None),
        (8080, f"hvt={'v' * 20}", "viewer"),  # of a proxy
        (8080, f'prefs={{"theme":"dark"}}; =; a b; hvt-8080={"o" * 20}', "operator"),
    ],
)
def test_each_ground_takes_its_own_cookie_of_several(port, cookie, role):
    """The token of another ground would be refused, or JSON in the cookie of another page throw operators out."""
    access = Access({"operator": "o" * 20, "viewer": "v" * 20})
    assert access.role({"host": f"10.8.0.1:{port}", "cookie": cookie}) == role


@pytest.mark.parametrize(
    ("host", "origin", "said"),
    [
        ("hvt.example.org", "https://hvt.example.org", ""),
        ("HVT.example.org", "https://hvt.example.org", ""),
        ("hvt.example.org:8443", "https://hvt.example.org:8443", ""),
        ("hvt.example.org:443", "https://hvt.example.org", ""),
        ("hvt.example.org", "https://hvt.example.org:8443", "proxy_set_header Host $http_host"),
        ("hvt.example.org", "https://evil.example.org", "another site"),
        ("hvt.example.org", "null", "another site"),
        ("hvt.example.org", "", "another site"),
        ("hvt.example.org:99999", "https://hvt.example.org", "another site"),
    ],
)
def test_a_proxy_that_drops_the_port_is_told_which_header_is_wrong(host, origin, said):
    """The page would say "no connection" for ever, and nobody look at the proxy."""
    found = Access({}, proxy="hvt.example.org").foreign({"host": host, "origin": origin})
    assert found.count(said) if said else found == ""


LOOPBACK = ("127.0.0.1:8080", "127.0.0.2", "LocalHost:8080", "[::1]:8080", "[::ffff:127.0.0.1]")
OTHERS = (
    *(
        "127.evil.example:8080",
        "127.0.0.1.evil.example",
        "localhost.evil.example",
        "127.0.0.1:8080, evil.example",
    ),
    *(
        "[127.0.0.1",
        "localhost.",
        "127.0.0.1.",
        "[::1].evil.example",
        "evil.example[::1]:8080",
        "127.1",
        "0x7f000001",
    ),
    *("operator@127.0.0.1", "127.0.0.1:0", "evil.example", "192.0.2.7", ""),
)


@pytest.mark.parametrize("host", [*LOOPBACK, *OTHERS])
def test_only_an_address_of_loopback_makes_an_operator(host):
    """Any website could have such a name lead here, and command the edge; or a page name itself operator."""
    assert Access({}).role({"host": host}) == ("operator" if host in LOOPBACK else None)
    behind = Access({}, proxy="hvt.example.org")
    assert behind.role({"host": host} | OPERATOR) is None
    assert behind.role({"host": "hvt.example.org"} | OPERATOR) == "operator"
    assert Access({}).role({"host": "127.0.0.1:8080"} | OPERATOR) is None, "no proxy was named"


@pytest.mark.parametrize(
    ("places", "newcomer", "goes"),
    [
        (["10.0.0.1"] * 3 + ["10.0.0.2"], "10.0.0.3", "10.0.0.1"),
        (["10.0.0.1"] * 3 + ["10.0.0.2"], "10.0.0.1", None),
        (["10.0.0.1", "10.0.0.2"], "10.0.0.3", None),
        (["10.0.0.1", "10.0.0.1"], "10.0.0.2", "10.0.0.1"),
        (["2001:db8::1", "2001:db8::2", "2001:db8::3"], "2001:db8:0:1::1", "2001:db8::1"),
        (["2001:db8::1", "2001:db8::2", "2001:db8::3"], "2001:db8::4", None),
        (["::ffff:10.0.0.1", "::ffff:10.0.0.2", "::ffff:10.0.0.3"], "::ffff:10.0.0.4", None),
        ([], "10.0.0.1", None),
    ],
)
def test_where_there_is_no_room_who_has_most_makes_some(places, newcomer, goes):
    """One machine that opens connections without end would keep all others from the page."""
    assert crowding(places, newcomer) == goes
