"""Every number of the README: `python -m benchmarks` runs all of them, `python -m benchmarks NAME...` some.

Each file of this folder is a program of its own; arguments after `--` are passed to it.
"""

from __future__ import annotations

import ast
import signal
import subprocess
import sys
from pathlib import Path

FOLDER = Path(__file__).parent


def main(args: list[str]) -> int:
    """Run the named benchmarks one after the other; the number of failed ones."""
    known = sorted(p.stem for p in FOLDER.glob("*.py") if not p.stem.startswith("_"))
    if args and args[0] in ("-h", "--help"):
        print(__doc__)
        for name in known:
            text = ast.get_docstring(ast.parse((FOLDER / f"{name}.py").read_text("utf-8"))) or ""
            print(f"  {name:20} {text.partition(chr(10))[0]}")
        return 0
    split = args.index("--") if "--" in args else len(args)
    known.sort(key=lambda name: name == "results")  # made from what the others wrote
    names, passed_on = args[:split] or known, args[split + 1 :]
    unknown = [name for name in names if name not in known]
    if unknown:
        print(f"no benchmark {', '.join(unknown)} (there are: {', '.join(known)})", file=sys.stderr)
        return 2
    failed = 0
    for name in names:
        print(f"== {name}", flush=True)
        code = subprocess.run([sys.executable, str(FOLDER / f"{name}.py"), *passed_on], cwd=FOLDER.parent).returncode
        failed += code != 0
    return failed


if __name__ == "__main__":
    signal.signal(signal.SIGPIPE, signal.SIG_DFL)  # `| head` ends it silently
    sys.exit(main(sys.argv[1:]))
