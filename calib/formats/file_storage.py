"""OpenCV's FileStorage in its three forms (YAML, XML, JSON) as plain values.

Not read with OpenCV, which allocates matrices of any size that the text states.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from stereo_sfm.calib.formats.common import MAX_YAML_CHARS, numbers, read_json, read_text, yaml_mapping

Storage = dict[str, Any]  # a matrix is a mapping with rows, cols, dt and data


def read_storage(path: Path) -> Storage:
    """The top-level values of a file.

    Raises:
        ValueError: not a FileStorage.
    """
    text = read_text(path)
    if text.lstrip().startswith("<"):
        return _from_xml(text)
    data = read_json(path) if text.lstrip().startswith("{") else yaml_mapping(text)
    if not isinstance(data, dict):
        raise ValueError("not an OpenCV FileStorage")
    return data


def _from_xml(text: str) -> Storage:
    if len(text) > MAX_YAML_CHARS:
        raise ValueError(f"larger than {MAX_YAML_CHARS >> 10} KiB, which no calibration is")
    try:
        root = ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        raise ValueError(f"not XML ({error})") from None
    if root.tag != "opencv_storage":
        raise ValueError("not an OpenCV FileStorage")
    return {child.tag: _xml_value(child) for child in root}


def _xml_value(element: ElementTree.Element) -> Any:
    """Children by name as text; text without children as one word or a list of words."""
    if len(element):
        return {child.tag: _words(child.text) for child in element}
    return _words(element.text)


def _words(text: str | None) -> str | list[str]:
    words = [word.strip('"') for word in (text or "").split()]
    return words[0] if len(words) == 1 else words


def matrix(value: Any) -> list[float] | None:
    """The numbers of a matrix in row-major order; None if the value is not a matrix.

    Raises:
        ValueError: the number of values does not match its rows and columns.
    """
    if not isinstance(value, dict) or "data" not in value:
        return None
    shape = numbers([value.get("rows", 0), value.get("cols", 0)], 2)
    return numbers(value["data"], round(shape[0] * shape[1]))
