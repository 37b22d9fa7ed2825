"""The tree stays one that a stranger finds his way in."""

import ast
import re
import subprocess
import tomllib
from collections import Counter, defaultdict
from pathlib import Path, PurePosixPath

import pytest

from programs.golden import FLIGHTS

ROOT = Path(__file__).resolve().parents[1]
BUILD = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["hatch"]["build"]
PACKAGES = tuple(BUILD["targets"]["wheel"]["packages"])
FLIES = PACKAGES[:3]
MOST_AT_THE_TOP, MOST_IN_A_FOLDER = 8, 14


def modules():
    """Every Python file that git has; the tests' too."""
    listed = subprocess.run(
        ["git", "ls-files", "*.py"], cwd=ROOT, capture_output=True, text=True, check=False
    )
    if listed.returncode:
        pytest.skip("this is no git checkout: nothing says which files are the project's")
    return [PurePosixPath(one) for one in listed.stdout.split()]


def test_nothing_is_kept_that_git_is_to_leave_out():
    """What a merge tool left behind would be in every wheel."""
    listed = ["git", "ls-files", "--cached", "--ignored", "--exclude-standard"]
    assert subprocess.run(listed, cwd=ROOT, capture_output=True, text=True, check=False).stdout == ""


def test_every_room_of_packages_is_checked_and_seen_by_the_tests():
    """Calls of what lies in another room would be taken for calls of an unknown library."""
    seen = (ROOT / "tests" / "mypy.ini").read_text(encoding="utf-8")
    rooms = {one.partition("/")[0] for one in PACKAGES}
    assert {room for room in rooms if f"/../{room}:" not in seen} == set()


def test_no_folder_is_a_corridor():
    """A newcomer would search sixty doors for one."""
    count = Counter(str(one.parent) for one in modules() if one.name != "__init__.py")
    assert {place: number for place, number in count.items() if number > MOST_IN_A_FOLDER} == {}
    assert {place: count[place] for place in PACKAGES if count[place] > MOST_AT_THE_TOP} == {}


def test_each_golden_flight_is_flown_in_one_place():
    """Who looks for a flight by its name would find none, or several that are not the same."""
    flown = re.compile(r'(?<!def )\bLink\(\w+, name="([\w-]+)"\)|^FLIGHT = "([\w-]+)"$', re.MULTILINE)
    files = [one for one in modules() if one.parts[0] == "tests"]
    named = {(one, *found) for one in files for found in flown.findall((ROOT / one).read_text("utf-8"))}
    assert sorted("".join(found) for _, *found in named) == sorted(FLIGHTS)


def test_every_folder_of_a_package_says_what_happens_there():
    """The tree would have to be explained by somebody who knows it."""
    folders = {one.parent for one in modules() if str(one).startswith(PACKAGES)}
    silent = [
        str(folder)
        for folder in sorted(folders)
        if not ast.get_docstring(ast.parse((ROOT / folder / "__init__.py").read_text(encoding="utf-8")))
    ]
    assert silent == []


def test_a_room_names_what_is_there():
    """Its first lines would send a newcomer to a file that is gone."""
    rooms = {one.parent for one in modules() if one.name == "__init__.py" and str(one).startswith(PACKAGES)}
    known = {part for one in modules() for part in one.with_suffix("").parts}
    gone = set()
    for room in rooms:
        told = ast.get_docstring(ast.parse((ROOT / room / "__init__.py").read_text(encoding="utf-8"))) or ""
        named = {one for one in re.findall(r"(?<!`)`(\w+)`(?!`)", told) if one not in known}
        code = [one.read_text(encoding="utf-8") for one in (ROOT / room).rglob("*.py")] if named else []
        words = {word for text in code for word in re.findall(r"\w+", text.partition('"""\n')[2])}
        gone |= {(str(room), one) for one in named - words}
    assert gone == set()


def imported(path):
    """Dotted names of all that a file imports, inside functions too; of a name it may be one too many."""
    for node in ast.walk(ast.parse((ROOT / path).read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom) and node.module:
            yield from (node.module, *(f"{node.module}.{one.name}" for one in node.names))
        elif isinstance(node, ast.Import):
            yield from (one.name for one in node.names)


def test_rooms_are_entered_by_the_door():
    """A part of a room that others quietly rest on could not be changed without looking through the whole tree.

    The first lines of a room's ``__init__`` name in `backticks` the modules that others import. Rooms are the folders
    of what flies; others are everything but the tests, which look into every corner.
    """
    rooms, files = {}, {}
    for path in modules():
        if str(path).startswith(FLIES):
            dotted = ".".join(path.with_suffix("").parts[1:])
            if path.name == "__init__.py":
                rooms[dotted.removesuffix(".__init__")] = path
            else:
                files[dotted] = path
    used = defaultdict(set)
    for path in modules():
        if path.parts[0] == "tests":
            continue
        here = ".".join(path.parts[1:])
        for name in imported(path):
            way = name.split(".")
            for depth in range(2, len(way)):
                room, inner = ".".join(way[:depth]), ".".join(way[: depth + 1])
                if room in rooms and not here.startswith(f"{room}.") and name in files:
                    used[room].add(inner)
    told = {
        room: f"{ast.get_docstring(ast.parse((ROOT / path).read_text()))}" for room, path in rooms.items()
    }
    named = {
        room: {f"{room}.{one}" for one in re.findall(r"(?<!`)`(\w+)`(?!`)", text)}
        for room, text in told.items()
    }
    assert {room: sorted(used[room] - named[room]) for room in used if used[room] - named[room]} == {}
    assert sum(map(len, used.values())) > 50, "the check has found too few imports to mean anything"
