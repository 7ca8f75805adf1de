"""The page of results, made from the figures that the benchmarks wrote (`benchmarks/figures/*.json`).

python benchmarks/results.py                  writes docs/results.md
python benchmarks/results.py --check          whether the page is the one that the figures make
python benchmarks/results.py --release 0.2.0  writes benchmarks/figures/0.2.0.md, which stays as it is
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from _figures import FOLDER, page

DOCS = Path(__file__).parents[1] / "docs"
HEAD = """\
# Results

What holds today. Each table is made from the figures of one benchmark by `python -m benchmarks results`.
Below it stand what `python -m benchmarks` ran (once unless stated), the commit, the machine and the versions. Figures
move from run to run: ± is their standard deviation.

The terms are in the [glossary](glossary.md); how the figures came about is in the [lab notebook](notebook.md).
"""
RELEASE = """\
# Figures of {version}

Accuracy, speed and memory of this release, per sequence. [Results](../../docs/results.md) explains the terms.
"""


def main() -> int:
    """Write or compare the page; 1 if it differs."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--check", action="store_true", help="write nothing; exit with 1 if docs/results.md differs")
    parser.add_argument("--release", metavar="VERSION", help="write the figures of a release instead")
    args = parser.parse_args()
    path, head = DOCS / "results.md", HEAD
    if args.release:
        path, head = FOLDER / f"{args.release}.md", RELEASE.format(version=args.release)
    text = "\n".join([head, *page()]).rstrip() + "\n"
    if args.check:
        same = path.is_file() and path.read_text("utf-8") == text
        print(f"{path.name} {'is' if same else 'is not'} what the figures make")
        return int(not same)
    path.write_text(text, encoding="utf-8")
    print(path)
    return 0


if __name__ == "__main__":
    sys.exit(main())
