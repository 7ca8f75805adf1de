"""Pages that the program writes itself: its commands, settings and sources as they are when the docs are built."""

from __future__ import annotations

import argparse
import ast
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

PLACE = re.compile(r"<!-- on the site: (\S+) -->\n(.*?)<!-- end -->\n", re.S)


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Fill the places `<!-- on the site: WHAT -->`; what a reader of the file sees there instead is left out."""
    return PLACE.sub(lambda place: text_of(place[1]) + "\n", markdown)


def text_of(what: str) -> str:
    """The text of a place.

    Args:
        what: a key of MAKERS, or a file of the repository: a page as it is, a program as a block of code.

    Raises:
        FileNotFoundError: neither.
    """
    if what in MAKERS:
        return MAKERS[what]()
    text = Path(what).read_text()
    if what.endswith(".md"):  # a page that lies outside docs/ links into it
        return text.replace("](docs/", "](")
    return _block(text)


def _block(program: str) -> str:
    return f"```python\n{program.rstrip()}\n```"


def _commands() -> str:
    import importlib

    from stereo_sfm.cli import COMMANDS

    parts: list[str] = []
    for name, text in COMMANDS.items():
        parser = argparse.ArgumentParser(
            f"stereo-sfm {name}", description=text, formatter_class=lambda prog: argparse.HelpFormatter(prog, width=100)
        )
        importlib.import_module(f"stereo_sfm.commands.{name.replace('-', '_')}").add_arguments(parser)
        parts.append(f"## {name}\n\n{text[:1].upper()}{text[1:]}.\n\n```text\n{parser.format_help()}```\n")
    return "\n".join(parts)


def _configuration() -> str:
    import contextlib
    import io

    from stereo_sfm.cli import main

    out = io.StringIO()
    with contextlib.redirect_stdout(out):
        main(["config", "dump"])
    return f"```toml\n{out.getvalue()}```"


def _sources() -> str:
    from stereo_sfm.drivers.options import grouped
    from stereo_sfm.drivers.registry import drivers

    found = dict(drivers())
    rows = [f"| `{kind}` | {one.summary} | `{kind}:{one.place}` |" for kind, one in found.items()]
    parts = ["| kind | what it reads | written as |", "|---|---|---|", *rows, ""]
    for kind, one in found.items():
        parts += [f"## {kind}", "", f"{one.summary[:1].upper()}{one.summary[1:]}.", ""]
        for title, helps in grouped(one.options):
            parts += [f"**{title[:1].upper()}{title[1:]}**", ""] if title else []
            parts += ["| option | default | meaning |", "|---|---|---|"]
            for option in helps:
                default = f"`{option.default}`" if option.default else ""
                meaning = f"{option.doc}{': ' * bool(option.wanted)}{option.wanted}"
                parts.append(f"| `{option.name}` | {default} | {meaning} |")
            parts.append("")
    return "\n".join(parts)


def _examples() -> str:
    parts: list[str] = []
    for path in sorted(Path("examples").glob("*.py")):
        text = path.read_text()
        title = (ast.get_docstring(ast.parse(text)) or path.stem).splitlines()[0]
        parts += [f"## {path.name}", "", title, "", _block(text), ""]
    return "\n".join(parts)


def _changelog() -> str:
    """The changelog, with the lines of the next version above its first version."""
    text = Path("CHANGELOG.md").read_text().replace("[changelog.d](changelog.d)", "`changelog.d`")
    parts: list[str] = []
    for kind in ("added", "changed", "fixed", "removed"):
        lines = [path.read_text().strip() for path in sorted(Path("changelog.d").glob(f"*.{kind}.md"))]
        parts += [f"### {kind.title()}\n", *(f"- {line}" for line in lines), ""] if lines else []
    head, version, tail = text.partition("\n## ")
    return head + ("\n## Next version\n\n" + "\n".join(parts) if parts else "") + version + tail


MAKERS: dict[str, Callable[[], str]] = {
    "changelog": _changelog,
    "commands": _commands,
    "configuration": _configuration,
    "sources": _sources,
    "examples": _examples,
    "nothing": str,
}
