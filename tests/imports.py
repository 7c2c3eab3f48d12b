"""``python -m tests.imports``: which folder imports which, and the circles of modules (there should be none).

Every import counts, also one inside a function: a module that is loaded late depends no less.
"""

from __future__ import annotations

import argparse
import ast
import functools
import sys
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path

ROOT = Path(__file__).parent.parent
LAYERS = ("checkpoint", "failover", "agent", "page")

Graph = Mapping[str, set[str]]
"""Module → modules that it imports; both dotted."""


def modules(root: Path = ROOT) -> dict[str, Path]:
    """Every module of the product, by its dotted name; a package is named by itself."""
    found = {}
    for layer in LAYERS:
        for path in sorted((root / layer).rglob("*.py")):
            parts = path.relative_to(root).with_suffix("").parts
            found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return found


def imports(tree: ast.AST, package: list[str]) -> Iterator[tuple[int, str]]:
    """Every import anywhere in a file, also inside functions and of names given as text: (line, dotted module)."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from ((node.lineno, alias.name) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            start = package[: len(package) - node.level + 1] if node.level else []
            module = ".".join([*start, *([node.module] if node.module else [])])
            yield from ((node.lineno, f"{module}.{alias.name}" if module else alias.name) for alias in node.names)
        elif isinstance(node, ast.Call) and called(node) in ("__import__", "import_module"):
            first = node.args[0] if node.args else None
            if isinstance(first, ast.Constant) and isinstance(first.value, str):
                yield node.lineno, first.value


@functools.cache
def imports_of(path: Path, package: tuple[str, ...]) -> tuple[tuple[int, str], ...]:
    """Every import of a file: (line, dotted module). Read once: several rules look at all files."""
    return tuple(imports(ast.parse(path.read_text(), str(path)), list(package)))


def called(node: ast.Call) -> str:
    """The last part of the name that a call calls, "" for anything fancier."""
    return node.func.id if isinstance(node.func, ast.Name) else node.func.attr if isinstance(node.func, ast.Attribute) else ""


def imported(found: Iterable[tuple[int, str]], known: Iterable[str]) -> set[str]:
    """The modules of the product that a source with these imports has; ``from package import name`` may be a module."""
    known = set(known)
    names = (name for _, name in found)
    return {name if name in known else name.rpartition(".")[0] for name in names} & known


def graph(root: Path = ROOT) -> dict[str, set[str]]:
    """The imports of all modules of the product."""
    known = modules(root)
    return {name: imported(imports_of(path, path.relative_to(root).parent.parts), known) - {name} for name, path in known.items()}


def circles(edges: Graph) -> list[list[str]]:
    """Groups of modules that import one another, directly or by others: Tarjan's strongly connected components."""
    order: dict[str, int] = {}
    low: dict[str, int] = {}
    stack: list[str] = []
    found = []

    def visit(name: str) -> None:
        order[name] = low[name] = len(order)
        stack.append(name)
        for other in edges.get(name, ()):
            if other not in order:
                visit(other)
                low[name] = min(low[name], low[other])
            elif other in stack:
                low[name] = min(low[name], order[other])
        if low[name] == order[name]:
            group = stack[stack.index(name) :]
            del stack[stack.index(name) :]
            if len(group) > 1:
                found.append(sorted(group))

    before = sys.getrecursionlimit()
    sys.setrecursionlimit(10_000)
    try:
        for name in edges:
            if name not in order:
                visit(name)
    finally:
        sys.setrecursionlimit(before)
    return found


def folder_of(name: str, packages: set[str]) -> str:
    """The folder in which a module lies."""
    return name if name in packages else name.rpartition(".")[0]


def folders(root: Path = ROOT) -> tuple[Counter[str], dict[str, Counter[str]]]:
    """How many modules each folder holds, and how many imports lead from each to each other one."""
    known = modules(root)
    packages = {name for name, path in known.items() if path.name == "__init__.py"}
    sizes = Counter(folder_of(name, packages) for name, path in known.items() if path.name != "__init__.py")
    arrows: dict[str, Counter[str]] = defaultdict(Counter)
    for name, others in graph(root).items():
        for other in others:
            here, there = folder_of(name, packages), folder_of(other, packages)
            if here != there:
                arrows[here][there] += 1
    return sizes, arrows


def main() -> int:
    """Print the drawing; 1 if there is a circle."""
    parser = argparse.ArgumentParser(prog="python -m tests.imports", description=__doc__)
    parser.add_argument("--root", type=Path, default=ROOT, help="of another checkout")
    root = parser.parse_args().root
    sizes, arrows = folders(root)
    for folder in sorted(sizes):
        print(f"{folder}  ({sizes[folder]} modules)")
        for other, count in sorted(arrows[folder].items()):
            print(f"    → {other}  {count}")
    found = circles(graph(root))
    print(f"{sum(sizes.values())} modules in {len(sizes)} folders, the largest of {max(sizes.values())}; circles: {len(found)}")
    for group in found:
        print(f"    {len(group)}: {' '.join(group)}")
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
