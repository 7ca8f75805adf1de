"""A YAML loader for calibrations, safe against texts that expand to huge values.

A few lines of nested aliases can expand to billions of values, and nested brackets overflow the parser's stack:
both are counted while the text is parsed, before any value is built.
"""

from __future__ import annotations

from typing import Any

import yaml
from yaml.events import AliasEvent
from yaml.nodes import MappingNode, Node, ScalarNode, SequenceNode

from stereo_sfm.calib.mask import INLINE

MAX_VALUES = 20_000  # with every alias written out
MAX_DEPTH = 32
MAX_VALUE_CHARS = 4096  # but for masks, which are images: they have as many as the text may have
OPENCV_MATRIX = "tag:yaml.org,2002:opencv-matrix"


class CalibrationLoader(yaml.SafeLoader):
    """SafeLoader that reads OpenCV's matrices (as plain mappings) and limits the size of the expanded text.

    Raises ValueError for texts above the limits.
    """

    def __init__(self, stream: str) -> None:
        super().__init__(stream)
        self._depth = 0
        self._values: dict[Node, int] = {}  # number of values that each composed node expands to

    def compose_node(self, parent: Node | None, index: Any) -> Node | None:
        """As `SafeLoader.compose_node`, counting values."""
        self._depth += 1
        if self._depth > MAX_DEPTH:
            raise ValueError("values are nested too deeply")
        alias = self.check_event(AliasEvent)
        node = super().compose_node(parent, index)
        self._depth -= 1
        if alias and node not in self._values:
            raise ValueError("a value contains itself")
        if node is not None and not alias:
            self._values[node] = self._count(node)
        return node

    def _count(self, node: Node) -> int:
        if isinstance(node, ScalarNode) and len(node.value) > MAX_VALUE_CHARS and not node.value.startswith(INLINE):
            raise ValueError(f"a value has {len(node.value)} characters")
        count = 1 + sum(self._values[child] for child in _children(node))
        if max(count, len(self._values)) > MAX_VALUES:
            raise ValueError("it expands to more values than any calibration has")
        return count


def _children(node: Node) -> list[Node]:
    if isinstance(node, MappingNode):
        return [part for pair in node.value for part in pair]
    return list(node.value) if isinstance(node, SequenceNode) else []


def _matrix(loader: CalibrationLoader, node: Node) -> dict[Any, Any]:
    return loader.construct_mapping(node, deep=True) if isinstance(node, MappingNode) else {}


CalibrationLoader.add_constructor(OPENCV_MATRIX, _matrix)
