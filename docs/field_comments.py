"""A griffe extension: the comments beside the fields of a class become its table of attributes in the reference."""

from __future__ import annotations

import io
import tokenize
from typing import Any

import griffe


class FieldComments(griffe.Extension):
    """Gives every class with annotated fields, and without an `Attributes:` section, such a section."""

    def on_class(self, *, cls: griffe.Class, **_: Any) -> None:
        """Append the section to the docstring."""
        docstring = cls.docstring.value if cls.docstring else ""
        fields = [one for one in cls.attributes.values() if _is_field(one)]
        if not fields or "Attributes:" in docstring:
            return
        entries = [f"    {one.name} ({one.annotation}): {_comment(one)}" for one in fields]
        cls.docstring = griffe.Docstring("\n".join([docstring, "", "Attributes:", *entries]), parent=cls)


def _is_field(attribute: griffe.Attribute) -> bool:
    """A value of an instance, or a member of an enumeration, that is documented nowhere else."""
    of_class = attribute.annotation is not None and "instance-attribute" not in attribute.labels
    known = attribute.inherited or attribute.is_private or attribute.docstring is not None
    return not (of_class or known or "property" in attribute.labels)


def _comment(attribute: griffe.Attribute) -> str:
    """The comments in the lines of a field and in those just above it, on one line."""
    lines = attribute.parent.lines_collection[attribute.filepath]  # type: ignore[union-attr]
    begin = (attribute.lineno or 1) - 1
    first = begin
    while first > 0 and lines[first - 1].lstrip().startswith("#"):
        first -= 1
    source = "\n".join(line.strip() for line in lines[first : attribute.endlineno or begin + 1])
    tokens = tokenize.generate_tokens(io.StringIO(source).readline)
    return " ".join(token.string.lstrip("# ") for token in tokens if token.type == tokenize.COMMENT)
