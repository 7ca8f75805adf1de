"""A page of Markdown, as the reports use it, as one HTML file whose plots can be zoomed and moved."""

from __future__ import annotations

import html
import re
from collections.abc import Iterable, Iterator
from pathlib import Path

STYLE = """
body{font:15px/1.5 sans-serif;max-width:1100px;margin:2em auto;padding:0 1em;color:#222;background:#fff}
table{border-collapse:collapse;margin:.6em 0}td,th{padding:.15em .8em;border-bottom:1px solid #ddd;text-align:left}
td.word{white-space:nowrap}td.right,th.right{text-align:right;white-space:nowrap}
figure{margin:1em 0;border:1px solid #ddd}figure svg{width:100%;height:auto;cursor:grab;touch-action:none}
figcaption{padding:.2em .6em;color:#666}code{background:#f2f2f2}img{max-width:100%}
"""
# Wheel: zoom about the pointer. Drag: move. Double click: as at first.
SCRIPT = """
for (const svg of document.querySelectorAll("figure svg")) {
  const v = svg.viewBox.baseVal, home = [v.x, v.y, v.width, v.height];
  const set = (x, y, w, h) => { v.x = x; v.y = y; v.width = w; v.height = h; };
  const at = e => { const b = svg.getBoundingClientRect();
    return [v.x + v.width * (e.clientX - b.left) / b.width, v.y + v.height * (e.clientY - b.top) / b.height]; };
  svg.addEventListener("wheel", e => { e.preventDefault(); const [x, y] = at(e), f = Math.exp(e.deltaY / 500);
    set(x - (x - v.x) * f, y - (y - v.y) * f, v.width * f, v.height * f); }, {passive: false});
  let from = null;
  svg.addEventListener("pointerdown", e => { from = at(e); svg.setPointerCapture(e.pointerId); });
  svg.addEventListener("pointermove", e => { if (from) { const [x, y] = at(e);
    set(v.x + from[0] - x, v.y + from[1] - y, v.width, v.height); } });
  svg.addEventListener("pointerup", () => { from = null; });
  svg.addEventListener("dblclick", () => set(...home));
}
"""
LONG_WORD = 40  # letters, from which on a word may be broken
HINT = "Plots: the wheel zooms, the mouse moves, a double click shows all."


def to_html(title: str, markdown: str, plots: dict[str, str]) -> str:
    """The page as one file.

    Args:
        title: of the window.
        markdown: titles, paragraphs, lists, tables, links, bold and code; an image `![NAME](...)` is a plot.
        plots: SVG by NAME; a missing one is left out.
    """
    body = "\n".join(_blocks(markdown, plots))
    hint = f"<p>{HINT}</p>" if plots else ""
    return (
        f'<!doctype html>\n<html lang="en"><head><meta charset="utf-8"><title>{html.escape(title)}</title>\n'
        f"<style>{STYLE}</style></head>\n<body>\n{body}\n{hint}\n<script>{SCRIPT}</script></body></html>\n"
    )


def take_plots(folder: Path, names: Iterable[str]) -> dict[str, str]:
    """The SVG files that plots of these names left in a folder, with ids of their own inside; the files are removed."""
    found: dict[str, str] = {}
    for path in (folder / f"{name}.svg" for name in names):
        if not path.is_file():
            continue
        text = path.read_text("utf-8")
        text = text[text.index("<svg") :]
        # Several plots are in one page: matplotlib's ids, which it counts from 1 in each, must differ.
        text = re.sub(r'(id="|url\(#|href="#)', rf"\g<1>{path.stem}-", text)
        found[path.stem] = text
        path.unlink()
    return found


def _blocks(markdown: str, plots: dict[str, str]) -> Iterator[str]:
    for block in re.split(r"\n\s*\n", markdown):
        lines = block.strip("\n").splitlines()
        if not lines or not lines[0]:
            continue
        if lines[0].startswith("#"):
            level = len(lines[0]) - len(lines[0].lstrip("#"))
            yield f"<h{level}>{_inline(lines[0][level:].strip())}</h{level}>"
        elif lines[0].startswith("|"):
            yield _table(lines)
        elif lines[0].startswith(("* ", "- ")):
            yield "<ul>" + "".join(f"<li>{_inline(line[2:])}</li>" for line in lines) + "</ul>"
        elif image := re.fullmatch(r"!\[([^\]]*)\]\([^)]*\)", lines[0]):
            if image[1] in plots:
                yield f"<figure><figcaption>{html.escape(image[1])}</figcaption>{plots[image[1]]}</figure>"
        else:
            yield f"<p>{_inline(' '.join(lines))}</p>"


def _table(lines: list[str]) -> str:
    rows = [[cell.strip() for cell in re.split(r"(?<!\\)\|", line.strip().strip("|"))] for line in lines]
    right = [cell.endswith("-:") for cell in rows[1]]
    head = "".join(_cell("th", cell, of) for cell, of in zip(rows[0], right, strict=False))
    body = "".join(
        f"<tr>{''.join(_cell('td', cell, of) for cell, of in zip(row, right, strict=False))}</tr>" for row in rows[2:]
    )
    return f"<table><tr>{head}</tr>{body}</table>"


def _cell(tag: str, text: str, right: bool) -> str:
    """A browser would break a date at its hyphens."""
    kind = "right" if right else "word" if "-" in text and " " not in text and len(text) < LONG_WORD else ""
    return f"<{tag}{f' class={kind}' if kind else ''}>{_inline(text)}</{tag}>"


def _inline(text: str) -> str:
    text = html.escape(text, quote=False)
    text = re.sub(r"`([^`]+)`", r"<code>\1</code>", text)
    text = re.sub(r"\*\*([^*]+)\*\*", r"<b>\1</b>", text)
    return re.sub(r"\[([^\]]+)\]\(([^)\"]+)\)", r'<a href="\2">\1</a>', text)
