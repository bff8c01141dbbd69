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
SHARED = {"__init__", "endurance_subscribers", "endurance_watch", "independent_defects"}
TABLE = "table"  # Runs others: it belongs to no room


def rooms() -> dict[str, list[str]]:
    """Return the names of all benchmarks, by room."""
    found: dict[str, list[str]] = {}
    for path in sorted(HERE.glob("*/*.py")):
        if path.stem not in SHARED:
            found.setdefault(path.parent.name, []).append(path.stem)
    return found


def find(name: str) -> Path | None:
    """Return the file of a benchmark; None if there is none."""
    if name == TABLE:
        return HERE / f"{TABLE}.py"
    return next((HERE / room / f"{name}.py" for room, names in rooms().items() if name in names), None)


def docstring(path: Path) -> str:
    """Return a file's docstring."""
    return ast.get_docstring(ast.parse(path.read_text())) or ""


def imports(path: Path) -> set[str]:
    """Return the top-level modules that a file imports."""
    tree = ast.parse(path.read_text())
    return {alias.name for node in tree.body if isinstance(node, ast.Import) for alias in node.names}


def print_all() -> None:
    """Print the benchmarks by room, with the first line of each docstring."""
    for room, names in rooms().items():
        print(f"\n{room}: {docstring(HERE / room / '__init__.py')}")
        for name in names:
            print(f"  {name:<20} {docstring(HERE / room / f'{name}.py').partition(chr(10))[0]}")
    print(f"\n  {TABLE:<20} {docstring(HERE / f'{TABLE}.py').partition(chr(10))[0]}")


def main() -> None:
    """Run the benchmark that the command line names."""
    if len(sys.argv) < 2 or sys.argv[1] in {"-h", "--help"}:
        print(__doc__.rstrip())
        print_all()
        return
    name = sys.argv[1]
    path = find(name)
    if path is None:
        sys.exit(f"there is no benchmark {name!r}; `python benchmarks/run.py` lists all")
    if {"-h", "--help"} & set(sys.argv[2:]) and not {"argparse", "click"} & imports(path):
        print(docstring(path))
        return
    # Matrices are small: a second thread costs more than it computes, and CPU times would count it.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    sys.path[:0] = [str(HERE), str(HERE.parent / "tests")]
    sys.argv = [f"benchmarks/run.py {name}", *sys.argv[2:]]
    module = ".".join(path.relative_to(HERE).with_suffix("").parts)
    sys.exit(importlib.import_module(module).main())


if __name__ == "__main__":
    main()
