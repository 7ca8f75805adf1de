"""`stereo-sfm sources`: list the kinds of sources that can be opened, or the options of one."""

from __future__ import annotations

import argparse


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of this command."""
    parser.add_argument("kind", nargs="?", metavar="KIND", help="kind whose options to list (default: list the kinds)")


def run(args: argparse.Namespace) -> int:
    """List the kinds, or the options of one."""
    from stereo_sfm.drivers.registry import driver, drivers, kinds
    from stereo_sfm.errors import one_of

    if args.kind is None:
        rows = [(f"{kind}:{found.place}", found.summary) for kind, found in drivers()]
        print("\n".join(_table(("source", "what it reads"), rows)))
        return 0
    from stereo_sfm.drivers.options import grouped

    found = driver(one_of(args.kind, kinds(), "source"))
    print(f"{args.kind}:{found.place}?OPTION=VALUE&...: {found.summary}")
    for title, helps in grouped(found.options):
        rows = [(h.name, h.default or "-", ": ".join(filter(None, (h.doc, h.wanted)))) for h in helps]
        print(f"\n{title}" if title else "")
        print("\n".join(_table(("option", "default", "meaning"), rows)))
    return 0


def _table(head: tuple[str, ...], rows: list[tuple[str, ...]]) -> list[str]:
    widths = [max(len(row[k]) for row in (head, *rows)) for k in range(len(head))]
    return ["  ".join(text.ljust(w) for text, w in zip(row, widths, strict=True)).rstrip() for row in (head, *rows)]
