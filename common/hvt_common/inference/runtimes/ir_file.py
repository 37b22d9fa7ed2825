"""Checks an OpenVINO model (IR), ``NAME.xml`` beside ``NAME.bin``, and reads its exporter's metadata."""

from __future__ import annotations

import re
from pathlib import Path
from xml.etree import ElementTree as ET

from hvt_common.errors import UserError, absent
from hvt_common.inference.runtimes.onnx_file import MAX_MODEL_BYTES

_MAX_XML_BYTES = 64 << 20
_FIRST_BYTES = 512


def is_ir(path: Path) -> bool:
    """Whether a file is meant as an OpenVINO model, by its name."""
    return path.suffix.lower() == ".xml"


def files_of(path: Path) -> tuple[Path, ...]:
    """The files that a model is: itself, and of an IR the weights beside it."""
    return (path, path.with_suffix(".bin")) if is_ir(path) else (path,)


def check_ir_file(path: Path) -> None:
    """Raise `UserError` in one sentence if it is certainly no IR, or not a whole one."""
    if not path.is_file():
        state = "is not a file" if path.exists() else "does not exist"
        raise absent(path)(f"model {path} {state}; an OpenVINO .xml with its .bin is expected")
    _, weights = files_of(path)
    if not weights.is_file():
        raise UserError(f"model {path} has no {weights.name} beside it; OpenVINO keeps the weights there")
    for part, most in ((path, _MAX_XML_BYTES), (weights, MAX_MODEL_BYTES)):
        if part.stat().st_size > most:
            raise UserError(f"model {part} has {part.stat().st_size} bytes; at most {most} are accepted")
    try:
        with path.open("rb") as file:
            begin = file.read(_FIRST_BYTES)
    except OSError as error:
        raise UserError(f"model {path} cannot be read: {error.strerror}") from error
    if b"<net" not in begin or b"<!DOCTYPE" in begin or b"<!ENTITY" in begin:
        raise UserError(f"model {path} is not an OpenVINO model (it begins with no <net>)")


def ir_metadata(path: Path) -> dict[str, str]:
    """The ``model_info`` of an IR, names as in ONNX: ``names`` of the classes, and whatever else it says.

    Ultralytics writes its own into ``metadata.yaml`` beside the file: its plain values and names are read too. Raises
    `UserError` as `check_ir_file` does.
    """
    check_ir_file(path)
    try:
        found = ET.parse(path).getroot().find("rt_info/model_info")  # noqa: S314 - checked: no entities
    except (ET.ParseError, OSError) as error:
        raise UserError(f"model {path} is not an OpenVINO model, or is cut short ({error})") from error
    said = {one.tag: one.get("value", "") for one in (found if found is not None else ())}
    metadata = _yaml_of_ultralytics(path.with_name("metadata.yaml"))
    labels = said.pop("labels", "").split()
    if labels and "names" not in metadata:
        metadata["names"] = repr([label.replace("_", " ") for label in labels])
    return said | metadata


def _yaml_of_ultralytics(path: Path) -> dict[str, str]:
    # Plain keys, and the table of names as a literal; empty where there is no such file.
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines() if path.is_file() else []
    except (OSError, UnicodeDecodeError):
        return {}
    found: dict[str, str] = {}
    names: dict[int, str] = {}
    sides: list[str] = []
    table = ""
    for line in lines:
        key = re.match(r"([a-z0-9_]+):\s*(.*)", line)
        entry = re.match(r"\s+(\d+):\s*(.+)", line)
        if key is not None:
            table = key[1]
            if key[2]:
                found[table] = key[2].strip("'\"")
        elif entry is not None and table == "names":
            names[int(entry[1])] = entry[2].strip().strip("'\"")
        elif table == "imgsz" and line.strip().startswith("- "):
            sides.append(line.strip()[2:])
    if names:
        found["names"] = repr(names)
    if sides:
        found["imgsz"] = f"[{', '.join(sides)}]"
    return found
