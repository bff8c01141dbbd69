"""Run a benchmark by name, or list all of them.

python benchmarks/run.py
python benchmarks/run.py NAME [ARGUMENTS ...]
python benchmarks/run.py NAME --help
"""

from __future__ import annotations

import ast
import importlib
import os
import sys
from pathlib import Path

HERE = Path(__file__).parent
SHARED = {"run", "measuring", "endurance_subscribers", "endurance_watch", "planted_by_strangers"}


def names() -> list[str]:
    """Return the names of all benchmarks."""
    return sorted(path.stem for path in HERE.glob("*.py") if path.stem not in SHARED)


def summary(name: str) -> str:
    """Return the first line of a benchmark's docstring."""
    docstring = ast.get_docstring(ast.parse((HERE / f"{name}.py").read_text())) or ""
    return docstring.partition("\n")[0]


def imports(name: str) -> set[str]:
    """Return the top-level modules that a benchmark imports."""
    tree = ast.parse((HERE / f"{name}.py").read_text())
    return {alias.name for node in tree.body if isinstance(node, ast.Import) for alias in node.names}


def main() -> None:
    """Run the benchmark that the command line names."""
    if len(sys.argv) < 2 or sys.argv[1] in {"-h", "--help"}:
        print(__doc__)
        for name in names():
            print(f"  {name:<20} {summary(name)}")
        return
    name = sys.argv[1]
    if name not in names():
        sys.exit(f"there is no benchmark {name!r}; `python benchmarks/run.py` lists all")
    if {"-h", "--help"} & set(sys.argv[2:]) and not {"argparse", "click"} & imports(name):
        print(ast.get_docstring(ast.parse((HERE / f"{name}.py").read_text())))
        return
    # Matrices are small: a second thread costs more than it computes, and CPU times would count it.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    sys.path[:0] = [str(HERE), str(HERE.parent / "tests")]
    sys.argv = [f"benchmarks/run.py {name}", *sys.argv[2:]]
    sys.exit(importlib.import_module(name).main())


if __name__ == "__main__":
    main()
