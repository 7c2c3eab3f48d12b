"""Files that another user may have written: snapshots, states, segments, configuration."""

from __future__ import annotations

import contextlib
import io
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

from tests.fuzz.target import SENTENCES, Decoder, scratch, target

ROOT = Path(__file__).resolve().parents[3]


def _samples() -> list[bytes]:
    return [path.read_bytes() for path in sorted((ROOT / "tests/samples").glob("*.snapshot"))]


def _read_snapshot(content: bytes) -> object:
    """In all the ways in which a file is read: for a store, a restore, a person."""
    import msgspec

    from checkpoint.snapshot import format
    from failover.cli.verbs import inspect_file

    made = format.decode(content)
    format.verify(content)
    outline = format.verified(content)[1]
    format.read_state(content)
    format.encode_bytes(made)
    msgspec.json.encode(inspect_file.as_builtins(outline, len(content)))
    with contextlib.redirect_stdout(io.StringIO()):
        inspect_file._show(outline, len(content), True, inspect_file.Rights(0, "-"))
    return made


@target("who gives a snapshot's file; a member that sends one")
def snapshot_file() -> Decoder:
    return Decoder(_samples(), _read_snapshot)


@target("who makes a snapshot's file: all of it, with right digests of its beginning and sections")
def snapshot_sealed() -> Decoder:
    from checkpoint.snapshot import layout

    preambles = {len(one): layout.Preamble.parse(one[: layout.PREAMBLE_SIZE]) for one in _samples()}

    def call(content: bytes) -> object:
        preamble = preambles.get(len(content), next(iter(preambles.values())))
        begin = bytearray(content[: layout.PREAMBLE_SIZE])
        for index, section in enumerate(preamble.sections):
            at = layout._PREAMBLE.size + layout._SECTION.size * (index + 1) - layout.DIGEST_SIZE
            stored = content[section.offset : section.offset + section.stored_size]
            begin[at : at + layout.DIGEST_SIZE] = layout.digest_of(stored)
        begin[-layout.DIGEST_SIZE :] = layout.digest_of(bytes(begin[: -layout.DIGEST_SIZE]))
        return _read_snapshot(bytes(begin) + content[layout.PREAMBLE_SIZE :])

    return Decoder(_samples(), call)


def _rewritten(sample: bytes, kind: Any, content: bytes) -> bytes:
    """The sample with another content of one section, as its author could write it: every digest is right."""
    from checkpoint.snapshot import format, layout
    from checkpoint.snapshot.frames import FrameWriter, Packer
    from checkpoint.snapshot.layout import Codec, Preamble, Section

    old, contents = Preamble.parse(sample[: layout.PREAMBLE_SIZE]), memoryview(format.decode(sample).contents).cast("B")
    sections, stored, offset = [], [], layout.PREAMBLE_SIZE
    for section in old.sections:
        body = sample[section.offset : section.offset + section.stored_size]
        codec, raw_size = (Codec.RAW, len(content)) if section.kind is kind else (section.codec, section.raw_size)
        body = content if section.kind is kind else body
        sections.append(Section(section.kind, codec, offset, len(body), raw_size, layout.digest_of(body)))
        stored.append(body)
        offset += len(body)
    preamble = Preamble(len(contents), tuple(sections), old.version)
    file = io.BytesIO()
    file.write(preamble.pack() + b"".join(stored))
    writer, packer = FrameWriter(file, preamble.frames_offset), Packer(1)
    for index in range(preamble.frame_count):
        writer.add(packer(contents[index * layout.FRAME_SIZE :][: layout.FRAME_SIZE]))
    writer.finish(preamble)
    return file.getvalue()


def _section(kind_name: str, use: Callable[[bytes], object] = _read_snapshot) -> Decoder:
    from checkpoint.snapshot import canonical_state, format
    from checkpoint.snapshot.layout import SectionKind

    kind = SectionKind[kind_name]
    samples = _samples()
    packed: dict[str, Callable[[Any], bytes]] = {
        "HEADER": lambda made: canonical_state.encode_header(canonical_state.header_of(made)),
        "STATE": canonical_state.encode_state,
        "RUNS": format._pack_runs,
        "OUTPUT": lambda made: canonical_state.encode_output(made.output),
    }
    seeds = [bytes([index]) + packed[kind_name](format.decode(one)) for index, one in enumerate(samples)]

    def call(content: bytes) -> object:
        index = content[0] % len(samples) if content else 0
        return use(_rewritten(samples[index], kind, content[1:]))

    return Decoder(seeds, call)


@target("who makes a snapshot's file with right digests: its header", "msgpack")
def snapshot_header() -> Decoder:
    return _section("HEADER")


@target("who makes a snapshot's file with right digests: the state of its processes", "msgpack")
def snapshot_state() -> Decoder:
    return _section("STATE")


@target("who makes a snapshot's file with right digests: which pages it holds")
def snapshot_runs() -> Decoder:
    return _section("RUNS")


@target("who makes a snapshot's file with right digests: output of its program", "msgpack")
def snapshot_output() -> Decoder:
    return _section("OUTPUT")


@target("a member: the state of its processes, where a standby asks what it lacks for them", "msgpack")
def snapshot_lacks() -> Decoder:
    from checkpoint.engine import RestoreOptions
    from checkpoint.engines.ptrace.restore import checks
    from checkpoint.snapshot import format, untrusted

    def use(content: bytes) -> object:
        outline = format.read_outline(content)
        with untrusted.facts("say what this machine lacks"):  # as `checkpoint.keeper.server`
            return checks.lacks(outline, RestoreOptions(own_eyes=True), lambda *_: bytes(32))

    return _section("STATE", use)


@target("a member: a delta, folded into what the store holds")
def snapshot_chain() -> Decoder:
    from checkpoint.pages import page_set
    from checkpoint.snapshot import format
    from checkpoint.snapshot.layout import SectionKind
    from checkpoint.store import chain
    from tests.checkpoint.snapshots import PAGE, history

    base, delta = history(2)
    seeds = [format._pack_runs(delta)]
    file = format.encode_bytes(delta)
    first = chain.applied(page_set.PageTable.empty(PAGE), base, (base.contents,))

    def call(content: bytes) -> object:
        changed = format.decode(_rewritten(file, SectionKind.RUNS, content))
        table = chain.applied(first, changed, (changed.contents,))
        return table.page_sum, chain.fold([base, changed])

    return Decoder(seeds, call)


@target("who makes a snapshot's file: the image of another kernel's vdso in it")
def vdso_image() -> Decoder:
    from checkpoint.linux.spawn import vdso

    seeds = []
    with open("/proc/self/maps") as maps, open("/proc/self/mem", "rb", 0) as memory:
        for line in maps:
            if line.rstrip().endswith("[vdso]"):
                begin, end = (int(word, 16) for word in line.split()[0].split("-"))
                memory.seek(begin)
                seeds.append(memory.read(end - begin))
    return Decoder(seeds or [b"\x7fELF"], vdso.functions)


@target("a program that keeps its state: its segment")
def segment() -> Decoder:
    from checkpoint.segment.layout import PAGE
    from checkpoint.segment.reader import SegmentReader
    from checkpoint.segment.writer import SegmentWriter
    from tests.checkpoint import segments

    path = scratch() / "segment"
    writer = SegmentWriter(segments.layout(PAGE, PAGE))
    for number in (1, 2, 3):
        writer.commit([segments.source(bytes([number]) * PAGE), segments.source(bytes([number + 7]) * PAGE)])
    whole = os.pread(writer.descriptor, 1 << 20, 0)

    def call(content: bytes) -> object:
        path.write_bytes(content[: len(whole)] + whole[len(content) :])
        descriptor = os.open(path, os.O_RDONLY)
        try:
            reader = SegmentReader(descriptor)
            try:
                return reader.is_superseded, reader.newest(), reader.read(), reader.read(2)
            finally:
                reader.close()
        finally:
            os.close(descriptor)

    return Decoder([whole[: 60 << 10]], call)


@target("who gives the kept state of a Python program; a member that sends one", "msgpack")
def kept_state() -> Decoder:
    from failover.state import Encoded, schema
    from tests.samples import state

    encoded = state.schema().encode(state.sampled())
    declared, regions = state.schema(), encoded.regions

    def call(content: bytes) -> object:
        schema.read(content)
        return declared.decode(Encoded(content, regions))

    return Decoder([bytes(encoded.data)], call)


def _posts(framed: Callable[[bytes], bytes], seeds: Callable[[list[bytes]], list[bytes]]) -> Decoder:
    """The file of a durable sender, opened with these bytes in it; the seeds are made of its records."""
    import msgspec

    from failover.core.messaging.envelope import Envelope
    from failover.drivers.posts_file import FOLDER, Begun, Over, Posted, PostsFile, place_of

    folder, whose = scratch(), ("robot1/mission", "Lab/Engine")
    message = Envelope("Lab/Engine", "set", {"duty": 0.5}, sender=whose[0], boot=7, seq=1, reliable=True, deadline_ms=9.5)
    made = [msgspec.msgpack.encode(one) for one in (Begun(*whose, 7, 0), Posted(message, 1e9), Over(1))]

    def call(content: bytes) -> object:
        os.environ[FOLDER] = str(folder)
        place_of(*whose).write_bytes(framed(content))
        file = PostsFile(*whose, 7, 0)
        try:
            return file.kept
        finally:
            file.close()

    return Decoder(seeds(made), call)


@target("who writes to the folder of a program that posts: its messages that wait")
def posts_file() -> Decoder:
    from failover.drivers.posts_file import framed

    return _posts(lambda content: content, lambda made: [b"".join(framed(one, safe) for one in made) for safe in (0, 100)])


@target("who writes to the folder of a program that posts: one record, with a right digest", "msgpack")
def posts_record() -> Decoder:
    import msgspec

    from failover.drivers.posts_file import Begun, framed

    begun = framed(msgspec.msgpack.encode(Begun("robot1/mission", "Lab/Engine", 7, 0)), 0)
    return _posts(lambda content: begun + framed(content, 0), lambda made: made[1:])


# --- Configuration ----------------------------------------------------------------------------------------------------


def _toml(name: str, seeds: list[bytes], read: Callable[[Path], object]) -> Decoder:
    place = scratch()

    def call(content: bytes) -> object:
        (place / name).write_bytes(content)
        return read(place)

    return Decoder(seeds, call)


TEAM = b"""team = "lab"
change = 2
[robots.robot1]
beats = ["10.0.0.1:7400"]
bulk = "10.0.0.1:7401"
public_key = "0123456789abcdefghijklmnopqrstuvwxyzABCD"
[robots.robot2]
beats = ["10.0.0.2:7400", "[fe80::2]:7400"]
bulk = "10.0.0.2:7401"
role = "server"
public_key = "ABCDefghijklmnopqrstuvwxyz01234567890123"
[board]
group = "robots"
[board.items.ball]
type = { x = "f4", y = "f4[3]", seen = "u4" }
period = 2
"""


@target("who gives a team.toml; a member that changes the team", "text")
def team_toml() -> Decoder:
    from failover.config import team

    def read(place: Path) -> object:
        found = team.read(place)
        found.roster()
        return found

    return _toml("team.toml", [TEAM], read)


@target("who gives an agent.toml", "text")
def agent_toml() -> Decoder:
    from agent import config

    bare = b'robot = "robot1"\nteam_directory = "%s"\ninsecure = true\n'
    place = scratch()
    (place / "team.toml").write_bytes(b"".join(line + b"\n" for line in TEAM.splitlines() if b"public_key" not in line))
    whole = bare % os.fsencode(place) + b'beat_ms = 20\nrule = "majority"\n[components."/lab/a"]\ncommand = ["/bin/true"]\n'
    return _toml("agent.toml", [whole], lambda at: config.load(at / "agent.toml"))


@target("who gives a rights.toml", "text")
def rights_toml() -> Decoder:
    from failover.config import rights

    return _toml("rights.toml", [(ROOT / "systemd/rights.toml").read_bytes()], rights.read)


@target("who gives a programs.toml", "text")
def programs_toml() -> Decoder:
    from failover.config import programs

    text = b'[[keys]]\nowner = "anna"\npublic = "%s"\nuntil = "2027-12-31"\n' % (b"ab" * 32)
    return _toml("programs.toml", [text], programs.read)


@target("who gives a page.toml", "text")
def page_toml() -> Decoder:
    from failover.config import page

    sample = (ROOT / "systemd/page.toml").read_bytes()
    said = b'listen = "127.0.0.1:7480"\n[users.anna]\npassword = "%s"\n'
    line = b"scrypt:2:1:1:AAAAAAAAAAAAAAAAAAAAAA==:AAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAA="
    return _toml("page.toml", [sample, said % line], lambda place: page.read(place / "page.toml"))


@target("who gives a world of simulated robots", "text")
def world_toml() -> Decoder:
    from failover.simulators import files

    seeds = [path.read_bytes() for path in sorted(files.SHIPPED.glob("*.toml"))]
    return _toml("world.toml", seeds, lambda place: files.read(str(place / "world.toml")))


@target("who can write the state directory: the vote record, with a right digest", "json")
def vote_record() -> Decoder:
    import msgspec

    from agent.main_loop import vote_record as module
    from failover.core import vote_record as core
    from failover.core.types import VoteRecord

    place = scratch()
    whole = module.Record(module.VERSION, "robot1", 3, core.encode(VoteRecord()))

    def call(content: bytes) -> object:
        (place / module.FILE_NAME).write_bytes(content + b"\n" + module._digest(content).encode() + b"\n")
        with contextlib.suppress(*SENTENCES):
            core.decode(content)
        return core.decode(module.VoteRecordFile(place, "robot1").read().core)

    return Decoder([msgspec.json.encode(whole)], call)


def _archived(content: bytes) -> bytes:
    """An object of an archive that holds this content."""
    from failover.archive import sealed
    from failover.archive.keys import keys_without_members

    with io.BytesIO() as file:
        sealed.seal(keys_without_members(bytes(32)), "lab/@x/1.base.sealed", iter([content]), file)
        return file.getvalue()


@target("the owner of an archive's bucket: an object", needs="cryptography")
def archive_object() -> Decoder:
    from failover.archive import sealed
    from failover.archive.keys import keys_without_members

    def call(content: bytes) -> object:
        return b"".join(sealed.unsealed(keys_without_members(bytes(32)), "lab/@x/1.base.sealed", io.BytesIO(content)))

    return Decoder([_archived(b""), _archived(b"a snapshot" * 100)], call)


@target("who has an archive key: what an object holds before its snapshot", "msgpack", needs="cryptography")
def archive_label() -> Decoder:
    import msgspec

    from checkpoint.snapshot import format
    from checkpoint.store.index import file_name, folder_name
    from failover.archive import sealed
    from failover.archive.archive import Archive, Copy, Label
    from failover.archive.keys import keys_without_members
    from failover.archive.objects import FolderObjects
    from tests.checkpoint import snapshots

    place = scratch()
    snapshot = format.encode_bytes(snapshots.history(1)[0])
    header = format.read_header(snapshot)
    folder = folder_name(header.component)
    name = f"lab/{folder}/1-{file_name(header)}.sealed"
    (place / name).parent.mkdir(parents=True)
    keys = keys_without_members(bytes(32))
    archive = Archive(FolderObjects(place), keys, "lab", place)

    def call(content: bytes) -> object:
        with (place / name).open("wb") as file:
            sealed.seal(
                keys_without_members(bytes(32)), name, iter([len(content).to_bytes(4, "little") + content + snapshot]), file
            )
        with (place / "fetched").open("w+b") as file:
            return archive.fetch(Copy(name, folder, file_name(header), 1, 1, 1, 1, 0), file)

    return Decoder([msgspec.msgpack.encode(Label("r1", 1.5, b"spec"))], call)
