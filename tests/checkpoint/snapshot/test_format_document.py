"""FORMAT.md says what the code does, to the byte; the sample file of each version stays readable."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import msgspec
import pytest

from checkpoint import model
from checkpoint.snapshot import canonical_state, format, layout
from tests.samples.make import (
    DIFFERENCES_SAMPLE,
    SAMPLE,
    SAMPLES,
    TREE_DIFFERENCES_SAMPLE,
    TREE_SAMPLE,
    sample,
    tree_sample,
)

DOCUMENT = (Path(layout.__file__).parent / "FORMAT.md").read_text()
MAPS = {
    "Header": canonical_state.Header,
    "State": canonical_state._State,
    "TreeState": canonical_state._TreeState,
    "Member": canonical_state._MemberRecord,
    "Resource": canonical_state._ResourceRecord,
    **{
        kind.__name__: kind
        for kind in (
            *(model.Position, model.Machine, model.Clocks, model.ProcessState, model.FileIdentity, model.MemoryLayout),
            *(model.Credentials, model.SignalAction, model.IntervalTimer, model.PosixTimer, model.ThreadState, model.Rseq),
            *(model.Vma, model.PageRun, model.OutputPiece, model.Zombie),
        )
    },
}


def fields_of(kind: Any) -> list[str]:
    return [field.name for field in msgspec.structs.fields(kind)]


@pytest.mark.parametrize("name", [*MAPS])
def test_every_field_stands_in_the_document_in_its_order(name: str) -> None:
    row = re.search(rf"^\| {name} \| (.*) \|$", DOCUMENT, re.MULTILINE)
    assert row, f"FORMAT.md has no row for {name}"
    assert re.findall(r"`(\w+)`", row[1]) == fields_of(MAPS[name])


def test_every_map_that_the_code_can_write_stands_in_the_document() -> None:
    seen = {kind.__name__ for kind in MAPS.values()}
    for kind in MAPS.values():
        mentioned = set(re.findall(r"\b[A-Z]\w+", " ".join(map(str, kind.__annotations__.values()))))
        known = {name for name in mentioned if hasattr(model, name)} - {"Mapping", "VmaKind", "Fact"}
        assert known <= seen | {"Resource"}, f"{kind.__name__} holds {known - seen}"


@pytest.mark.parametrize(
    "sentence",
    [
        f"magic `{layout.MAGIC.hex(' ')}`",
        f"magic `{layout.END_MAGIC.hex(' ')}`",
        f"version: {layout.VERSION} |",
        f"## Preamble: {layout.PREAMBLE_SIZE} bytes",
        f"## Trailer: {layout.TRAILER_SIZE} bytes",
        f"size of a full frame's contents: {layout.FRAME_SIZE}",
        f"| {layout.FRAME_HEAD_SIZE} | p | zero bytes |",
        f"multiple of {layout.ALIGNMENT}",
        f"at most {layout.MAX_CONTENTS_SIZE >> 30} GiB",
        ", ".join(f"{kind.name.lower()} {limit >> 20} MiB" for kind, limit in layout.SECTION_LIMITS.items()),
        ", ".join(f"{kind.value} {kind.name.lower()}" for kind in layout.SectionKind),
        ", ".join(f"{codec.value} {codec.name.lower()}" for codec in layout.Codec),
        f"nested at most {canonical_state.MAX_FACT_DEPTH} deep",
        f"first {canonical_state.STATE_DIGEST_SIZE} bytes",
    ],
)
def test_every_number_of_the_layout_stands_in_the_document(sentence: str) -> None:
    assert sentence in DOCUMENT


def test_the_worked_example_is_the_sample_file() -> None:
    raw = SAMPLE.read_bytes()
    assert f"a delta of {len(raw)} bytes" in DOCUMENT
    lines = re.findall(r"^([0-9a-f]{4})  ((?:[0-9a-f]{2} ?)+)$", DOCUMENT, re.MULTILINE)
    assert len(lines) > 20
    for offset, words in lines:
        content = bytes.fromhex(words)
        assert raw[int(offset, 16) :][: len(content)] == content


def test_the_sample_file_is_still_read() -> None:
    assert format.decode(SAMPLE) == sample()


def test_the_sample_file_of_several_processes_is_still_read() -> None:
    assert TREE_SAMPLE.read_bytes()[8] == layout.TREE_VERSION
    assert format.decode(TREE_SAMPLE) == tree_sample()


@pytest.mark.parametrize("path", [DIFFERENCES_SAMPLE, TREE_DIFFERENCES_SAMPLE])
def test_the_sample_files_with_differences_are_still_read(path: Path) -> None:
    assert path.name == f"version-{path.read_bytes()[8]}.snapshot"
    decoded = format.decode(path)
    assert decoded == SAMPLES[path]()
    assert decoded.differences
