"""The table of what comes back says what the code does: every refusal belongs to a row, and the documents hold these rows."""

from __future__ import annotations

import ast
import inspect
import re
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import pytest

from checkpoint import resources
from checkpoint.capability import Area, Verdict, refused
from checkpoint.engines import capability_table
from checkpoint.engines.ptrace import capability_rows
from checkpoint.engines.ptrace.capture import tree as capture_tree
from checkpoint.engines.ptrace.facts import birth_order, probe
from checkpoint.engines.ptrace.restore import process, process_state, restore, rights, threads, timers, vdso_syscalls
from checkpoint.engines.ptrace.restore import tree as restored_tree
from tests import capability_table as written_table

RESOURCES = Path(resources.__file__).parent

SPEAKS_FOR = {
    capability_rows: (probe, restore, process, threads, process_state, rights, timers, vdso_syscalls),
    birth_order: (capture_tree, restored_tree),
}
"""Rows that stand in one file for sentences in others."""

NO_KIND = (
    "there is no such process",
    "that is not the number of a process",
    "not permitted; run as that user",
    "cannot {} pid {} ({}): {}",
    "cannot capture {} (pid {}): {}",
    "cannot capture pid {}: {}",
    "has become another program (exec)",
    "cannot restore {} as pid {}: {}",
    "cannot restore {} here: {}",
    "it has just ended",
)
"""Parts of sentences that are about no kind of thing: a process that is gone, or the frame around reasons."""

REFUSING = {"UnsupportedError", "ProbeError", "MismatchError"}
GLUE = {"is", "which", "of", "with", "port"}
"""Words of sentences that are put together of others: these are collected where they stand."""


def sentences(source: str) -> Iterator[str]:
    """What a file may say of a kind: strings that functions return, yield, refuse with or call a reason; ``{}`` for fields."""
    tree = ast.parse(source)
    for node in ast.walk(tree):
        if isinstance(node, ast.Return | ast.Yield):
            yield from _strings(node.value)
        elif isinstance(node, ast.Raise) and isinstance(node.exc, ast.Call) and getattr(node.exc.func, "id", "") in REFUSING:
            for argument in node.exc.args:
                yield from _strings(argument)
        elif isinstance(node, ast.Assign) and any(getattr(target, "id", "") == "reason" for target in node.targets):
            yield from _strings(node.value)
    for statement in tree.body:
        if isinstance(statement, ast.AnnAssign) and isinstance(statement.value, ast.Dict | ast.Tuple):
            for cell in statement.value.values if isinstance(statement.value, ast.Dict) else statement.value.elts:
                yield from _strings(cell)


def _strings(node: ast.expr | None) -> Iterator[str]:
    """The texts of an expression, those within calls left out: they are about something else."""
    if isinstance(node, ast.JoinedStr):
        text = "".join(str(part.value) if isinstance(part, ast.Constant) else "{}" for part in node.values)
        for part in node.values:
            if isinstance(part, ast.FormattedValue):
                yield from _strings(part.value)
    elif isinstance(node, ast.Constant) and isinstance(node.value, str):
        text = node.value
    else:
        is_choice = isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr == "get"
        is_open = is_choice or isinstance(node, ast.IfExp | ast.Tuple | ast.BoolOp | ast.List)
        for child in ast.iter_child_nodes(node) if node is not None and is_open else ():
            yield from _strings(child if isinstance(child, ast.expr) else None)
        return
    words = re.findall(r"[A-Za-z]+", text.replace("{}", ""))
    if " " in text and set(words) - GLUE:
        yield text


def of(module: ModuleType) -> list[str]:
    """The sentences of a file that no list of the test leaves out."""
    return [text for text in sentences(inspect.getsource(module)) if not any(part in text for part in NO_KIND)]


@pytest.mark.parametrize("carrier", capability_table.CARRIERS, ids=lambda module: module.__name__)
def test_every_refusal_in_the_code_belongs_to_a_row(carrier: ModuleType) -> None:
    said = [part for row in capability_table.carried_by(carrier) for part in row.said]
    for module in (carrier, *SPEAKS_FOR.get(carrier, ())):
        assert [text for text in of(module) if not any(part in text for part in said)] == []


@pytest.mark.parametrize("carrier", capability_table.CARRIERS, ids=lambda module: module.__name__)
def test_no_row_speaks_of_a_refusal_that_is_gone(carrier: ModuleType) -> None:
    texts = [text for module in (carrier, *SPEAKS_FOR.get(carrier, ())) for text in of(module)]
    said = [part for row in capability_table.carried_by(carrier) for part in row.said]
    assert [part for part in said if not any(part in text for text in texts)] == []


def test_every_file_that_refuses_carries_rows() -> None:
    carriers = {Path(str(module.__file__)) for module in capability_table.CARRIERS}
    assert [path.name for path in sorted(RESOURCES.rglob("*.py")) if _refuses(path) and path not in carriers] == []


def _refuses(path: Path) -> bool:
    """Whether a file has the furniture of a kind."""
    return bool(re.search(r"^def (refuse|refuse_\w+|mismatches)\(", path.read_text(), re.MULTILINE))


def test_a_refusal_without_a_row_is_seen() -> None:
    source = 'def refuse(held):\n    return f"{held.name} is a teapot: use a cup"\n'
    assert list(sentences(source)) == ["{} is a teapot: use a cup"]
    assert written_table.row_of("fd 3 is a teapot: use a cup") is None


def test_the_row_of_a_refusal_is_found_by_its_words() -> None:
    row = written_table.row_of(
        "fd 3 is a socket (vsock, socket:[123]), which is not kept yet: protect the program while it has none"
    )
    assert row is not None and row.area == Area.SOCKETS and row.verdict == Verdict.REFUSED


def test_every_area_has_rows_and_every_refusal_says_what_to_do() -> None:
    assert {row.area for row in capability_table.rows()} == set(Area)
    for row in capability_table.rows():
        assert row.kind and row.sentence, row
        assert not row.sentence.endswith("."), row


def test_the_documents_hold_exactly_this_table() -> None:
    for path, text in written_table.written().items():
        assert path.read_text() == text, "run ./run table"


def test_a_document_without_its_place_for_the_table_is_seen() -> None:
    with pytest.raises(ValueError, match="capabilities:begin"):
        written_table.put_into("no marks here", "table")


def test_a_row_says_its_kind_in_the_table() -> None:
    row = refused(Area.DEVICES, "teapots", "use a cup", "is a teapot")
    assert written_table.line_of(row) == f"| teapots | {Verdict.REFUSED.value} | use a cup |"
