"""NAMING.md is normative: its samples are what the code reads and writes, its limits are those of the code."""

from __future__ import annotations

from pathlib import Path

import msgspec

from failover.core.naming import names, records, scan, tables
from failover.core.naming.records import Record
from failover.core.naming.scan import SECOND, Digest, Pages, Row, Terms
from failover.core.naming.tables import Entry, Page

DOCUMENT = (Path(scan.__file__).parent / "NAMING.md").read_text()


def sample(kind: str) -> bytes:
    return bytes.fromhex(DOCUMENT.partition(f"```{kind}\n")[2].partition("```")[0])


def test_the_samples_are_read_as_the_document_says_and_written_the_same_way() -> None:
    digest = Digest("robot1", (Row("robot1", 1, 3, 5, 0),))
    pages = Pages("robot1", (Page("robot1", 1, 2, 3, "robot1", 5, 0, (Entry("L/x", 3, b""),)),))
    assert scan.decode(sample("digest")) == digest
    assert scan.decode(sample("pages")) == pages
    assert scan.encode(pages) == sample("pages")
    assert scan.decode(scan.encode(digest)) == digest


def test_the_document_names_every_key_of_a_record_and_every_limit() -> None:
    for field in msgspec.structs.fields(Record):
        assert f"| `{field.encode_name}` |" in DOCUMENT
    limits = (records.BODY_SIZE_MAX, tables.PAGE_SIZE_MAX, scan.MESSAGE_SIZE_MAX)
    assert all(f"{limit:,} " in DOCUMENT or f"{limit:,}." in DOCUMENT for limit in limits)
    terms = Terms()
    assert f"at most {names.NAME_SIZE_MAX} bytes" in DOCUMENT and f"at most {names.NAME_DEPTH_MAX} steps" in DOCUMENT
    assert f"every {terms.scan_ns // SECOND} s" in DOCUMENT
    assert f"within {terms.live_scans * terms.scan_ns // SECOND} s" in DOCUMENT
    assert f"{terms.unreachable_ns // SECOND} s more" in DOCUMENT
    assert f"and {scan.REMOVED_MIN}, the origin" in DOCUMENT
    assert tables.COUNT_MAX == 1 << 62
