"""Checks an OpenVINO model's files without any library before OpenVINO parses them, and reads their metadata."""

import re
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from xml.etree import ElementTree as ET

from hvt_common.errors import UserError, absent, telling
from hvt_common.files import read_text
from hvt_common.inference.runtimes.model_file import MAX_MODEL_BYTES, ULTRALYTICS, files_of

_MAX_XML_BYTES = 64 << 20
_FIRST_BYTES = 512


def check_ir_file(path: Path) -> None:
    """Raise `UserError` in one sentence if it is certainly no IR, or not a whole one."""
    if not path.is_file():
        state = "is not a file" if path.exists() else "does not exist"
        raise absent(path)(f"model {path} {state}; an OpenVINO .xml with its .bin is expected")
    weights = files_of(path)[1]
    if not weights.is_file():
        raise UserError(f"model {path} has no {weights.name} beside it; OpenVINO keeps the weights there")
    for part, most in ((path, _MAX_XML_BYTES), (weights, MAX_MODEL_BYTES)):
        if part.stat().st_size > most:
            raise UserError(f"model {part} has {part.stat().st_size} bytes; at most {most} are accepted")
    with telling(f"model {path} cannot be read (", "): give an .xml of OpenVINO"), path.open("rb") as file:
        begin = file.read(_FIRST_BYTES)
    if b"<net" not in begin or b"<!DOCTYPE" in begin or b"<!ENTITY" in begin:
        raise UserError(f"model {path} is not an OpenVINO model (it begins with no <net>)")


def ir_metadata(path: Path) -> dict[str, str]:
    """The ``model_info`` of an IR and its ONNX file's metadata, by ONNX's names: ``names`` of the classes and so on.

    ``mean_values``, ``scale_values`` and ``reverse_input_channels``, of BGR pixels, become ``hvt.mean`` and so on.
    Ultralytics writes its own into ``metadata.yaml`` beside the file: its plain values and names are read too. Raises
    `UserError` as `check_ir_file` does.
    """
    check_ir_file(path)
    try:
        root = ET.parse(path).getroot()  # noqa: S314 - checked: no entities
    except (ET.ParseError, OSError) as error:
        raise UserError(f"model {path} is not an OpenVINO model, or is cut short ({error})") from error
    places = ("framework", "model_info")  # the first holds the metadata of the ONNX file that it was made of
    said = {one.tag: one.get("value", "") for place in places for one in root.iterfind(f"rt_info/{place}/*")}
    metadata = _yaml_of_ultralytics(path.with_name(ULTRALYTICS))
    found = (root.find(f"{place}/reverse_input_channels") for place in _OF_CONVERSION)
    turned = any(one is not None and one.get("value", "").lower() in _YES for one in found)
    # It is no step of the graph, but in its first weights.
    order = {"hvt.channel_order": "BGR"} if turned else {}
    labels = said.pop("labels", "").split()
    if labels and "names" not in metadata:
        metadata["names"] = repr([label.replace("_", " ") for label in labels])
    return order | _pixels_of_model_info(said) | said | metadata


_YES = ("yes", "true", "1")
_OF_CONVERSION = ("rt_info/conversion_parameters", "rt_info/cli_parameters", "meta_data/cli_parameters")
"""The parameters of OpenVINO's converter."""


def _pixels_of_model_info(said: Mapping[str, str]) -> dict[str, str]:
    found: dict[str, str] = {}
    if said.get("embedded_processing", "").lower() in _YES:  # they are steps of the graph
        return found
    mean, divisors = (said.get(key, "").strip("[]() ") for key in ("mean_values", "scale_values"))
    if mean or divisors:
        found["hvt.mean"] = mean or "0"
        with suppress(ValueError, ZeroDivisionError):  # text that is no number is refused later
            divisors = " ".join(str(1 / float(one)) for one in (divisors or "1").replace(",", " ").split())
        found["hvt.scale"] = divisors
    if "reverse_input_channels" in said:
        turned = said["reverse_input_channels"].lower() in _YES
        found["hvt.channel_order"] = "RGB" if turned else "BGR"
    return found


def _yaml_of_ultralytics(path: Path) -> dict[str, str]:
    # Plain keys, and the table of names as a literal; empty where there is no such file.
    try:
        lines = read_text(path).splitlines()
    except OSError:
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
