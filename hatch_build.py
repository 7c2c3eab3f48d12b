"""The build hook of the wheel: its `agent`, `checkpoint` and `page` are packages inside `failover`, and its files say so.

Their names are too common for site-packages. pyproject.toml (`sources`) says where each package goes; this hook rewrites the
imports, and the strings that are the name of a module, such as ``"agent.guard.server"``. It changes nothing else, and no line's
number. A checkout and an editable installation keep the packages at the top.
"""

from __future__ import annotations

import ast
import shutil
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from hatchling.builders.hooks.plugin.interface import BuildHookInterface


class Edit(NamedTuple):
    """What takes the place of a name in a line. Lines count from 0, columns in bytes of UTF-8."""

    line: int
    column: int
    name: str
    replacement: str


class OneTopLevelName(BuildHookInterface):  # type: ignore[type-arg]
    """Gives the builder a rewritten copy of each module, in place of the one that it would take."""

    PLUGIN_NAME = "custom"

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Rewrite into a directory that is gone when the wheel is made; nothing for an editable installation."""
        if version != "standard":
            return
        self._copies = tempfile.TemporaryDirectory(prefix="failover-wheel-")
        builder = self.build_config.builder
        places = {source.rstrip("/"): place.rstrip("/").replace("/", ".") for source, place in builder.config.sources.items()}
        modules = [file for file in builder.recurse_included_files() if file.path.endswith(".py")]
        rewriter = Rewriter(places, frozenset(_module(file.relative_path) for file in modules))
        for number, file in enumerate(modules):
            copy = Path(self._copies.name, f"{number}.py")
            copy.write_bytes(rewriter.rewritten(Path(file.path).read_bytes(), file.relative_path))
            shutil.copymode(file.path, copy)
            build_data["force_include"][str(copy)] = file.distribution_path

    def finalize(self, version: str, _build_data: dict[str, Any], _artifact_path: str) -> None:
        """Remove the copies."""
        if version == "standard":
            self._copies.cleanup()


class Rewriter:
    """Rewrites modules for their places in the wheel.

    Args:
        places: top-level package of the checkout → its package in the wheel.
        modules: the dotted names of all modules, as in the checkout.
    """

    def __init__(self, places: Mapping[str, str], modules: frozenset[str]) -> None:
        self._places = places
        self._modules = modules

    def rewritten(self, source: bytes, path: str) -> bytes:
        """One module.

        Args:
            path: named in errors.

        Raises:
            SyntaxError: it is no Python, or it names a module in a way that cannot be rewritten; names the line.
        """
        lines = source.splitlines(keepends=True)
        edits = [edit for node in ast.walk(ast.parse(source, path)) for edit in self._edits(node, path)]
        for edit in sorted(edits, reverse=True):
            line, old = lines[edit.line], edit.name.encode()
            if not line.startswith(old, edit.column):
                raise SyntaxError(f"{path}:{edit.line + 1}: the wheel cannot rename {edit.name}: write it in one piece")
            lines[edit.line] = line[: edit.column] + edit.replacement.encode() + line[edit.column + len(old) :]
        return b"".join(lines)

    def _edits(self, node: ast.AST, path: str) -> Iterator[Edit]:
        match node:
            case ast.ImportFrom(module=str(name), level=0) if place := self._place(name):
                yield Edit(node.lineno - 1, node.col_offset + len("from "), _top(name), place)
            case ast.Import():
                for one in node.names:
                    if place := self._place(one.name):
                        if "." in one.name and one.asname is None:
                            raise SyntaxError(f"{path}:{node.lineno}: the wheel cannot rename {one.name}: import it as a name")
                        bound = place if one.asname else f"{place} as {one.name}"
                        yield Edit(one.lineno - 1, one.col_offset, _top(one.name), bound)
            case ast.Constant(value=str(name)) if "." in name and name in self._modules and (place := self._place(name)):
                yield Edit(node.lineno - 1, node.col_offset + len('"'), name, name.replace(_top(name), place, 1))

    def _place(self, module: str) -> str | None:
        return self._places.get(_top(module))


def _top(module: str) -> str:
    return module.partition(".")[0]


def _module(path: str) -> str:
    return path.removesuffix(".py").removesuffix("/__init__").replace("/", ".")
