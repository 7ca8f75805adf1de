"""YAML as calibrations use it, safe against texts that stand for more than they hold.

A few lines of aliases of aliases can mean billions of values, and brackets in brackets overflow the parser's stack:
both are counted while the text is read, before any value is made.
"""

from __future__ import annotations

from typing import Any

import yaml
from yaml.events import AliasEvent
from yaml.nodes import MappingNode, Node, ScalarNode, SequenceNode

MOST_VALUES = 20_000  # with every alias written out
MOST_DEPTH = 32
LONGEST = 4096  # characters of one value
OPENCV_MATRIX = "tag:yaml.org,2002:opencv-matrix"


class CalibrationLoader(yaml.SafeLoader):
    """SafeLoader that knows OpenCV's matrices (as plain mappings) and limits what a text may stand for.

    Its parsing raises ValueError for texts above the limits.
    """

    def __init__(self, stream: str) -> None:
        super().__init__(stream)
        self._depth = 0
        self._values: dict[Node, int] = {}  # what each composed node stands for

    def compose_node(self, parent: Node | None, index: Any) -> Node | None:
        """As SafeLoader's."""
        self._depth += 1
        if self._depth > MOST_DEPTH:
            raise ValueError("its values are nested too deeply")
        alias = self.check_event(AliasEvent)
        node = super().compose_node(parent, index)
        self._depth -= 1
        if alias and node not in self._values:
            raise ValueError("one of its values holds itself")
        if node is not None and not alias:
            self._values[node] = self._count(node)
        return node

    def _count(self, node: Node) -> int:
        if isinstance(node, ScalarNode) and len(node.value) > LONGEST:
            raise ValueError(f"one of its values has {len(node.value)} characters")
        count = 1 + sum(self._values[child] for child in _children(node))
        if max(count, len(self._values)) > MOST_VALUES:
            raise ValueError("it stands for more values than any calibration")
        return count


def _children(node: Node) -> list[Node]:
    if isinstance(node, MappingNode):
        return [part for pair in node.value for part in pair]
    return list(node.value) if isinstance(node, SequenceNode) else []


def _matrix(loader: CalibrationLoader, node: Node) -> dict[Any, Any]:
    return loader.construct_mapping(node, deep=True) if isinstance(node, MappingNode) else {}


CalibrationLoader.add_constructor(OPENCV_MATRIX, _matrix)
