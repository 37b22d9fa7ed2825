"""Writes docs/options.md from the configuration of both programs: ``make docs``."""  # noqa: INP001 - a script

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from hvt_common.config import SWITCH, default_words
from hvt_edge.config import EdgeConfig
from hvt_ground.extras import config_class

PAGE = Path(__file__).with_name("options.md")

_HEAD = """\
# All options

Every option is a flag, or in a TOML file a key without the dashes (`--config FILE`). A flag overrides the file.

    hvt-edge --help                              # the common options
    hvt-edge --config edge.toml --print-config   # the settings, but those that the start works out, as TOML

| kind | written as |
|---|---|
| RATE | `800kbps`, `0.8Mbps` or `800000` (bits a second) |
| SIZE | `200MB`, `64kB`, `1GB` or bytes |
| TIME | `2s`, `500ms`, `1min`, `1h` or seconds |
| AGE, LIMIT | `1h`, `14days`, `2weeks`; a LIMIT may be `500MB` or `200GB` as well; never without a unit |
| SHARE | `0.8` or `80%` |
| WxH | `1280x720`, pixels |
| list | the flag may be repeated; in TOML `["…", "…"]` |
| yes/no | `--name`, `--no-name`; in TOML `true` or `false` |

The default stands in brackets, that of `--profile auto` first.
`hvt-edge --help` leaves out options with a star; `--help-all` lists everything.
A wrong value ends the program before the first frame with one sentence and exit code 2.
"""


def page() -> str:
    """The whole page."""
    lines = [_HEAD, *_program("hvt-edge", EdgeConfig), *_program("hvt-ground", config_class())]
    return "\n".join(lines)


def _program(name: str, config: type) -> Iterator[str]:
    yield f"## {name}\n"
    groups: dict[str, list[dataclasses.Field[Any]]] = {}
    for field in dataclasses.fields(config):
        groups.setdefault(str(field.metadata.get("group", "")), []).append(field)
    for group, fields in groups.items():
        if group:
            yield f"### {group[0].upper()}{group[1:]}\n"
        yield from (_row(field, config) for field in fields)
        yield ""


def _row(field: dataclasses.Field[Any], config: type) -> str:
    key, star = field.name.replace("_", "-"), "*" if field.metadata.get("rare") else ""
    default = default_words(config, field).replace("<", "&lt;")
    if default and " " not in default:
        default = f"`{default}`"
    if field.metadata["kind"] is SWITCH:
        named = f"`--{key}`, `--no-{key}`{star}"
    else:
        named = (
            f"`--{key} {field.metadata['kind'].metavar}`{star}{', list' if field.metadata['many'] else ''}"
        )
    return f"- {named}{f' ({default})' if default else ''}: {field.metadata['help']}"


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
