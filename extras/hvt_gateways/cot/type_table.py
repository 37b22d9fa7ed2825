"""Which Cursor on Target type an object of a class has, and a platform: the table here, and one of the user's."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from fnmatch import fnmatchcase
from importlib.resources import files
from pathlib import Path
from typing import Any, Final

from hvt_common.errors import UserError, absent
from hvt_common.files import read_text
from hvt_common.inference.class_names import kind_of

_TYPE: Final = re.compile(r"[A-Za-z0-9]+(-[A-Za-z0-9]+)*")
_MOST_TYPE: Final = 64
_MOST_NAME: Final = 128
_MOST_ROWS: Final = 10_000
_MOST_BYTES: Final = 1_000_000
_TABLES: Final = ("classes", "platforms")
_ANY: Final = "*"


@dataclass(frozen=True, slots=True)
class TypeTable:
    """Types by class name, in small letters, and by pattern of edge ids; both have a row ``*``."""

    classes: Mapping[str, str]
    platforms: Mapping[str, str]

    def of_class(self, name: str) -> str:
        """The type of an object: by its class name, else by the kind that it means, else that of ``*``."""
        plain = name.casefold()
        return self.classes.get(plain) or self.classes.get(kind_of(plain)) or self.classes[_ANY]

    def of_edge(self, edge: str) -> str:
        """The type of the camera's platform: of the first pattern that fits, ``*`` last."""
        fits = (
            kind for pattern, kind in self.platforms.items() if pattern != _ANY and fnmatchcase(edge, pattern)
        )
        return next(fits, self.platforms[_ANY])

    def extended(self, other: TypeTable) -> TypeTable:
        """With the rows of another before its own."""
        classes = {**self.classes, **other.classes}
        former = {one: kind for one, kind in self.platforms.items() if one not in other.platforms}
        return TypeTable(classes, {**other.platforms, **former})


def default_types() -> TypeTable:
    """The table of ``types.toml`` beside this file."""
    text = (files("hvt_gateways.cot") / "types.toml").read_text(encoding="utf-8")
    return _parsed(tomllib.loads(text), where="types.toml")


def read_types(path: Path | None) -> TypeTable:
    """The default table, with the rows of the user's before them; `UserError` where one of these is wrong."""
    table = default_types()
    if path is None:
        return table
    try:
        content = tomllib.loads(read_text(path, most=_MOST_BYTES))
    except OSError as error:
        raise absent(path)(
            f"--cot-types {path} cannot be read ({error.strerror}): give a table of types, TOML"
        ) from None
    except (ValueError, RecursionError) as error:
        raise UserError(f"--cot-types {path} is no TOML: {error}") from None
    return table.extended(_parsed(content, where=f"--cot-types {path}"))


def _parsed(content: Mapping[str, Any], *, where: str) -> TypeTable:
    unknown = [name for name in content if name not in _TABLES]
    if unknown:
        raise UserError(f"{where}: {unknown[0]!r} is not known: give the tables [classes] and [platforms]")
    classes, platforms = (_rows(content.get(name, {}), where=f"{where}: [{name}]") for name in _TABLES)
    return TypeTable({name.casefold(): kind for name, kind in classes.items()}, platforms)


def _rows(table: object, *, where: str) -> dict[str, str]:
    if not isinstance(table, dict):
        raise UserError(f'{where} is no table: write rows such as car = "a-u-G-E-V-C" below it')
    if len(table) > _MOST_ROWS:
        raise UserError(f"{where} has {len(table)} rows: {_MOST_ROWS} are accepted")
    for name, kind in table.items():
        if not 0 < len(name) <= _MOST_NAME:
            raise UserError(f"{where} {name[:40]!r}: a name has 1 to {_MOST_NAME} characters")
        if not isinstance(kind, str) or len(kind) > _MOST_TYPE or _TYPE.fullmatch(kind) is None:
            raise UserError(
                f"{where} {name} = {str(kind)[:80]!r} is no Cursor on Target type: give one such as "
                "a-u-G-E-V-C, letters and digits between hyphens"
            )
    return table
