"""One frozen dataclass per process, filled from defaults, then a TOML file, then flags; validated once.

A field is declared by its `Group`: its kind (how text becomes a value and back) and its help.
Every value passes through its kind whether it comes from the file or from the command line, so both say the
same sentence when it is wrong. ``--help`` leaves out ``rare`` settings; ``--help-all`` lists all. A class may
name settings in ``GONE`` that it does not take (any more): name → the end of the sentence, with the replacement.
``USUAL`` of a class: name → value that a start without flags has in place of the default, and the flags that undo it.
"""

import argparse
import dataclasses
import difflib
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from decimal import Decimal
from pathlib import Path
from typing import Any, TypeVar

import tomli_w

from hvt_common.errors import Parser, UserError, absent, check_not_read, named_path
from hvt_common.files import read_text, toml_table
from hvt_common.redaction import Redaction
from hvt_common.units import parse_bitrate, parse_bytes, parse_duration_s, parse_share, parse_size

_Config = TypeVar("_Config")


@dataclass(frozen=True, slots=True)
class SettingType:
    """Turns a setting's text into its value (`UserError` when it cannot), and the value into text."""

    metavar: str
    parse: Callable[..., Any]
    """``parse(text, name=…)``."""
    show: Callable[[Any], str | int | float] = str


def _plain(text: str, *, name: str) -> str:
    if not text.strip():
        raise UserError(f"{name} is empty: leave it out or give it a value")
    if "\0" in text:
        raise UserError(f"{name} {text!r} has a character that no name may have: write plain text")
    return text


def _place(text: str, *, name: str) -> str:
    # No shell makes a folder of the ``~`` in --source=~/clip.mp4, nor in a file of settings.
    return str(_path(text, name=name)) if text.startswith("~/") else _plain(text, name=name)


def _path(text: str, *, name: str) -> Path:
    path = named_path(_plain(text, name=name), name=name)
    _plain(str(path), name=name)  # a blank with a slash behind it is a blank
    return path


def _decimal(number: float) -> str:
    # All digits of a number, without an exponent.
    return format(Decimal(repr(number)).normalize(), "f")


TEXT = SettingType("TEXT", _plain)


def checked(check: Callable[[str], object]) -> SettingType:
    """Text that ``check`` takes; its `UserError` says what the text is, then the text in quotes, and the rest."""

    def parse(text: str, *, name: str) -> str:
        _plain(text, name=name)
        try:
            check(text)
        except UserError as error:
            raise UserError(f"{name} {text!r}{str(error).partition(repr(text))[2]}") from None
        return text

    return SettingType(TEXT.metavar, parse)


PLACE = SettingType("TEXT", _place)
"""A path, or a word or an address in its place."""
PATH = SettingType("FILE", _path)
BITRATE = SettingType("RATE", parse_bitrate, lambda bps: f"{_decimal(bps / 1000)}kbps")
BYTES = SettingType("SIZE", parse_bytes, lambda size: f"{_decimal(size / 1_000_000)}MB")
DURATION = SettingType("TIME", parse_duration_s, lambda seconds: f"{_decimal(seconds)}s")
SHARE = SettingType("SHARE", parse_share, float)
SIZE = SettingType("WxH", parse_size, lambda size: f"{size[0]}x{size[1]}")


def integer(low: int, high: int, *, unit: str = "") -> SettingType:
    return _within(low, high, int, "N", f"a whole number from {low} to {high}{unit}")


def number(low: float, high: float, *, unit: str = "") -> SettingType:
    return _within(low, high, float, "X", f"a number from {low:g} to {high:g}{unit}")


def _within(low: float, high: float, kind: type[int | float], metavar: str, accepted: str) -> SettingType:
    def parse(text: str, *, name: str) -> float:
        try:
            value: float = kind(text)
        except ValueError:
            value = float("nan")
        if not low <= value <= high:
            raise UserError(f"{name} {text!r} is not accepted: give {accepted}")
        return value

    return SettingType(metavar, parse, kind)


def choice(*accepted: str, elsewhere: Mapping[str, str] | None = None) -> SettingType:
    """One of a few words; of words that another option takes, ``elsewhere`` names that option."""

    def parse(text: str, *, name: str) -> str:
        if text not in accepted:
            option = (elsewhere or {}).get(text)
            hint = f"; or give {option} {text}" if option else ""
            raise UserError(f"{name} {text!r} is not known: choose one of {', '.join(accepted)}{hint}")
        return text

    return SettingType("|".join(accepted), parse)


def _truth(given: object, *, name: str) -> bool:
    if not isinstance(given, bool):
        raise UserError(f"{name} {given!r} is not accepted: give true or false")
    return given


SWITCH = SettingType("", _truth, bool)
"""Yes or no, which is no text anywhere."""
AUTO = "auto"


def or_auto(kind: SettingType) -> SettingType:
    """The same kind, or the word ``auto``, which stays as it is: the program finds the value itself."""

    def parse(text: str, *, name: str) -> Any:
        return AUTO if text.strip() == AUTO else kind.parse(text, name=name)

    def show(value: Any) -> str | int | float:
        return AUTO if value == AUTO else kind.show(value)

    return SettingType(f"{kind.metavar}|{AUTO}", parse, show)


@dataclass(frozen=True, slots=True)
class Group:
    """Settings that ``--help`` lists under one title; those of a ``rare`` group only ``--help-all`` lists."""

    title: str = ""
    rare: bool = False

    def option(
        self,
        kind: SettingType,
        default: Any,
        help_line: str,
        *,
        many: bool = False,
        shown_default: str = "",
        bare: str = "",
    ) -> Any:
        """Declare a dataclass field that is also a flag ``--its-name`` and a TOML key ``its-name``.

        With ``many`` the flag may be given several times and the value is a tuple; ``bare`` is the value of the
        flag alone.
        """
        metadata = {"kind": kind, "many": many, "shown_default": shown_default, "bare": bare}
        metadata |= {"help": help_line, "group": self.title, "rare": self.rare}
        return dataclasses.field(default=default, metadata=metadata)

    def switch(self, help_line: str, *, default: bool = False) -> Any:
        """Declare a yes/no field: ``--name`` and ``--no-name``."""
        return self.option(SWITCH, default, help_line)


@dataclass(frozen=True, slots=True)
class Loaded:
    """The settings and choices of the command line."""

    values: Mapping[str, Any]
    """Field name → value, only for those that the file or the flags set."""
    print_config: bool


def load(
    config_class: type[_Config], argv: Sequence[str] | None, *, program: str, description: str
) -> tuple[_Config, Loaded]:
    """Build the configuration of a process; ``--help`` and ``--version`` print and exit with 0.

    Raises `UserError` for an unknown flag or key, a value that its kind does not take, or an unreadable file.
    """
    words = sys.argv[1:] if argv is None else argv
    for word in words:
        if word.startswith("--"):
            name = word.partition("=")[0].removeprefix("--").removeprefix("no-")
            _refuse_gone(config_class, name, said=f"--{name}")
    parser = _flags(config_class, program=program, description=description, rare="--help-all" in words)
    given = vars(parser.parse_args(words))
    print_config = bool(given.pop("print_config", False))
    file = given.pop("config", None)
    values: dict[str, Any] = {}
    if file is not None:
        file = _path(_one(file, name="--config"), name="--config")
        values.update(_from_file(config_class, file))
    for field in dataclasses.fields(config_class):  # type: ignore[arg-type]
        if field.name in given:
            values[field.name] = _value(field, given[field.name], name=_flag(field.name))
    if file is not None:
        for name, value in values.items():
            if isinstance(value, Path | str):
                check_not_read(Path(value), [file], name=_flag(name))
    return config_class(**values), Loaded(values=values, print_config=print_config)


def settings_words(settings: Mapping[str, object]) -> list[str]:
    """Settings as a command line says them: ``{"edge_id": "a", "quiet": True}`` is ``--edge-id=a --quiet``."""
    words = []
    for name, value in settings.items():
        flag = _flag(name)
        for one in value if isinstance(value, list | tuple) else [value]:
            if isinstance(one, bool):
                words.append(flag if one else flag.replace("--", "--no-", 1))
            else:
                words.append(f"{flag}={one}")
    return words


def _refuse_gone(config_class: type, word: str, *, said: str) -> None:
    gone: Mapping[str, str] = getattr(config_class, "GONE", {})
    if word in gone:
        raise UserError(f"{said} {gone[word]}")


def to_toml(config: Any) -> str:
    """The whole configuration as a TOML file that ``--config`` reads back to the same values."""
    table: dict[str, Any] = {}
    for field in dataclasses.fields(config):
        value = getattr(config, field.name)
        if value is None or value == ():
            continue  # TOML has no null; a key that is absent means the same
        key = field.name.replace("_", "-")
        if field.metadata["many"]:
            table[key] = [field.metadata["kind"].show(item) for item in value]
        else:
            table[key] = field.metadata["kind"].show(value)
    return tomli_w.dumps(table)


def _flag(name: str) -> str:
    return f"--{name.replace('_', '-')}"


def _flags(config_class: type, *, program: str, description: str, rare: bool) -> argparse.ArgumentParser:
    from hvt_common import __version__  # noqa: PLC0415  (only the version line needs it)

    parser = Parser(
        prog=program,
        description=description,
        argument_default=argparse.SUPPRESS,
        allow_abbrev=False,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"{program} {__version__}")
    parser.add_argument("--config", metavar="FILE", help="TOML file with these settings; flags go over it")
    parser.add_argument("--print-config", action="store_true", help="print the settings as TOML and exit")
    fields = dataclasses.fields(config_class)
    if any(field.metadata["rare"] for field in fields):
        help_all = "list every setting, also those that few need"
        parser.add_argument("--help-all", action="help", help=help_all)
    titles = dict.fromkeys(field.metadata["group"] for field in fields if field.metadata["group"])
    groups = {title: parser.add_argument_group(title) for title in titles}
    for field in fields:
        into = groups.get(field.metadata["group"], parser)
        help_line = field.metadata["help"].replace("%", "%%")
        hidden = field.metadata["rare"] and not rare
        shown = default_words(config_class, field).replace("%", "%%")
        shown_help = f"{help_line} [{shown}]" if shown else help_line
        kind: SettingType = field.metadata["kind"]
        bare, many = field.metadata["bare"], field.metadata["many"]
        how: dict[str, Any] = {"action": argparse.BooleanOptionalAction}
        if kind is not SWITCH:
            how = {"action": "append" if many else "store", "metavar": kind.metavar}
            how |= {"nargs": "?", "const": bare} if bare else {}
        into.add_argument(_flag(field.name), help=argparse.SUPPRESS if hidden else shown_help, **how)
    return parser


def default_words(config_class: type, field: dataclasses.Field[Any]) -> str:
    """A setting's default as ``--help`` says it: of two, that of a start without flags comes first."""
    both: tuple[Mapping[str, Any], str] = getattr(config_class, "USUAL", ({}, ""))
    usual, unless = both
    own = field.metadata.get("shown_default") or _shown(field, field.default)
    return f"{_shown(field, usual[field.name])}; {own} {unless}" if field.name in usual else own


def _shown(field: dataclasses.Field[Any], default: object) -> str:
    if default is None or default == ():
        return ""
    kind: SettingType = field.metadata["kind"]
    if kind is SWITCH:
        return "yes" if default else "no"
    if isinstance(default, tuple) and kind.metavar != SIZE.metavar and not kind.metavar.startswith("WxH"):
        return " ".join(str(kind.show(item)) for item in default)
    return str(kind.show(default))


def _value(field: dataclasses.Field[Any], given: Any, *, name: str) -> Any:
    kind: SettingType = field.metadata["kind"]
    if kind is SWITCH:
        return kind.parse(given, name=name)
    if field.metadata["many"]:
        items = given if isinstance(given, list) else [given]
        return tuple(kind.parse(_one(item, name=name), name=name) for item in items)
    return kind.parse(_one(given, name=name), name=name)


def _one(given: Any, *, name: str) -> str:
    # The text of one plain value; of a list, a table or a truth value there is none.
    if isinstance(given, list | dict | bool):
        raise UserError(f"{name} {given!r} is not accepted: give one value, as --help shows")
    return str(given)


def _from_file(config_class: type, file: Path) -> dict[str, Any]:
    fields = {field.name.replace("_", "-"): field for field in dataclasses.fields(config_class)}
    try:
        table = toml_table(read_text(file))
    except FileNotFoundError:
        raise absent(file)(f"--config {file} does not exist: give a TOML file") from None
    except OSError as error:
        raise UserError(f"--config {file} cannot be read ({error.strerror}): give a TOML file") from None
    except (ValueError, RecursionError) as error:
        raise UserError(f"--config {file} is not valid TOML: {error}") from None
    values: dict[str, Any] = {}
    for key, given in table.items():
        plain = key.replace("_", "-")
        _refuse_gone(config_class, plain, said=f"{key} in {file}")
        field = fields.get(plain)
        if field is None:
            near = difflib.get_close_matches(key.lower(), fields, n=1)
            hint = f"did you mean {near[0]}?" if near else "a key is an option without its two dashes"
            raise UserError(f"--config {file} has an unknown key {key!r}: {hint}")
        if field.name in values:
            raise UserError(f"--config {file} has {plain} twice, with - and with _: give it once")
        try:
            values[field.name] = _value(field, given, name=f"{key} in {file}")
        except UserError as error:  # the value may be an address that was meant for another key
            raise UserError(Redaction([str(given)]).text(str(error))) from None
    return values
