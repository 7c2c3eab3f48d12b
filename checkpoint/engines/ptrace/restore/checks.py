"""Check, before anything is started, that this machine has what a snapshot needs.

The check reports all problems at once, so that the operator can cure them at once.
"""

from __future__ import annotations

import functools
import mmap
import os
import shlex
import stat
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Final

from msgspec import Struct, field
from msgspec.structs import replace

from checkpoint.arch import cpu, extended
from checkpoint.capability import Area, by_rule, refused
from checkpoint.engine import RestoreOptions
from checkpoint.engines.ptrace.facts.describe import this_machine
from checkpoint.engines.ptrace.facts.file_identity import build_id
from checkpoint.engines.ptrace.restore import mapping_kinds, memory, vdso
from checkpoint.engines.ptrace.restore.memory import is_file_mapping, kernel_pages, makes_shared_memory
from checkpoint.engines.ptrace.restore.process_state import may_not_enter
from checkpoint.engines.ptrace.restore.vdso import ContentAt
from checkpoint.engines.ptrace.restore.vessel import CAP_SYS_CHROOT
from checkpoint.errors import MismatchError
from checkpoint.linux import abi
from checkpoint.linux.procfs import descendants, procfs
from checkpoint.linux.spawn import cpuid
from checkpoint.model import FileIdentity, Resource, Snapshot
from checkpoint.program import cpu_baseline
from checkpoint.resources import rebuild
from checkpoint.resources.carried import restore
from checkpoint.resources.devices import by_rule as devices_by_rule
from checkpoint.resources.events import aio
from checkpoint.resources.files import other_writers, overmounted, proc_and_sys
from checkpoint.resources.restore_context import number_of
from checkpoint.snapshot import carried_files, process_tree
from checkpoint.store import member_pages
from checkpoint.store.content_store import DIGEST_SIZE, digest_of_file, path_in
from checkpoint.store.digest_cache import DigestOf

CAPABILITIES: Final = (
    refused(
        Area.THERE,
        "a mapped or open file that is missing, or different (size, build, content)",
        "install the same file on all robots, or make it shared if its content does not matter (`--shared`)",
        "is another file: {} bytes here",
        "is another file: as long",
        "is another build of that file",
        "cannot be used ({}): {}",
        "and shared, cannot be used",
        "is of another type here",
        "bytes here and {} there",
        "has another content here",
        "the brought copy of it ({}) is damaged",
    ),
    refused(
        Area.THERE,
        "a file that the program writes, and that another program has changed or is writing: found while the program runs",
        "let one program write each file, or make the file shared (`--shared`): it then keeps its content, and the "
        "restore sets the offset",
        "was written to since the snapshot",
        "is held open for writing by",
    ),
    refused(
        Area.THERE,
        "another architecture or page size",
        "use processors of the same kind",
        "it was taken on {}, this machine is",
        "its pages are {} bytes",
    ),
    by_rule(
        Area.THERE,
        "a processor without instructions that the other one has (AVX-512 …)",
        "start the program with `--portable`; without it use equal processors, because failover cannot know which "
        "instructions the program chose",
        "this processor lacks",
    ),
    refused(
        Area.THERE,
        "a processor without registers that a thread is just using; AMX tiles in use",
        "use the same processor, or another checkpoint. Registers at rest do not count, nor does the place where the "
        "processor puts them",
        "is using {}, which this machine lacks",
    ),
    refused(
        Area.THERE,
        "a kernel without a feature that the program uses",
        "boot a kernel that has it",
        "which this kernel ({}) does not know",
    ),
    refused(
        Area.THERE,
        "a missing directory in which the program works, or a missing root directory",
        "make the directory",
        "its working directory {} is missing",
        "its root directory {} is missing",
    ),
    refused(
        Area.THERE,
        "a snapshot of another version, or an incomplete one",
        "use the version that captured it, or capture again",
        "which this version does not know",
        "its first thread is missing",
        "are not those of this processor",
    ),
)

_FAR: str = "bring it here from the machine that ran the program"
_CARRIED: str = f"{_FAR}; or, as the program writes to it, carry it: --carry, for it or its folder"
"""While the program runs no copy would do for long."""


class Brought(Struct, frozen=True):
    """Contents that are opened in place of this machine's own files, by the paths that the program knows.

    Attributes:
        run: the executable, and mapped files.
        opened: files that are open for reading.
    """

    run: Mapping[str, str] = field(default_factory=dict)
    opened: Mapping[str, str] = field(default_factory=dict)


def require(state: Snapshot, options: RestoreOptions, *vessel_pids: int) -> tuple[Brought, ...]:
    """Refuse a snapshot that cannot come back here; answers with the files not to take from their own path, by process.

    Args:
        vessel_pids: the processes that are to become the program; they, we and our ancestors may hold files that the program
            writes to.

    Raises:
        MismatchError: with one reason for each difference.
    """
    reasons: list[str] = []
    brought = []
    ours = frozenset[int]().union(*(other_writers.family(pid) for pid in (os.getpid(), *vessel_pids)))
    reasons += _of_views(state, options)
    for view, source in zip(*member_pages.apart(state), strict=True):
        content_at = functools.partial(memory.content_at, view) if source is None else source.content_at
        differing, one = _compare(view, options, content_at=content_at if len(state.contents) else None)
        reasons += (*differing, *_of_writers(view, options, ours))
        brought.append(one)
    if reasons:
        each = tuple(dict.fromkeys(reasons))
        raise MismatchError(f"cannot restore {state.component} here: {'; '.join(each)}", each)
    return tuple(brought)


def _compare(
    state: Snapshot,
    options: RestoreOptions,
    digest_of: DigestOf = digest_of_file,
    content_at: ContentAt | None = None,
) -> tuple[tuple[str, ...], Brought]:
    """Everything in which this machine differs from the snapshot's needs, one sentence each; and the files brought for it.

    Args:
        content_at: None: its memory is not known, nor whether the vdso that it was born with can be led to ours.
    """
    architecture = os.uname().machine
    if state.machine.architecture != architecture:
        reason = f"it was taken on {state.machine.architecture}, this machine is {architecture}: restore it on such a machine"
        reason += "; a program that keeps its state itself resumes on either (docs/decorator.md)"
        return (reason,), Brought()
    if unsupported_here := cpuid.why_unsupported():
        return (unsupported_here,), Brought()
    run: dict[str, str] = {}
    opened: dict[str, str] = {}
    of_files = (*_of_files(state, options, run, digest_of), *_of_descriptors(state, options, opened, digest_of))
    return (*_of_machine(state, options, content_at), *of_files), Brought(run, opened)


def lacks(outline: Snapshot, options: RestoreOptions, digest_of: DigestOf) -> tuple[str, ...]:
    """What this machine lacks for a program that still runs on another one, one sentence each.

    Files that the program writes may change until it comes: of those we look only whether they are there, and which other
    processes write to them. Whether a vdso without its content can be led to ours is left to `require`.

    Args:
        outline: of its newest snapshot, which may be a delta.
    """
    views = process_tree.views(carried_files.without(outline))
    travels, spared = carried_files.every_path(outline), _never_in_the_way(views)
    found = [*_of_views(outline, options), *restore.written_by_others(outline, spared)]
    for view in views:
        expected = (*options.accept_changed, *travels, *_in_flux(view))
        found += (*_of_root(view), *_compare(view, replace(options, accept_changed=expected), digest_of)[0])
        found += _of_writers(view, replace(options, accept_changed=travels), spared)
    return tuple(dict.fromkeys(found))


def _never_in_the_way(views: Sequence[Snapshot]) -> frozenset[int]:
    """Processes that may write to a program's files now: we, and itself, where robots are processes of one machine."""
    ours = other_writers.family(os.getpid())
    if views[0].machine.boot_id != this_machine().boot_id:
        return ours
    theirs = {"\0".join(view.process.arguments).encode(errors="surrogateescape") for view in views} - {b""}
    return ours | {pid for pid in other_writers.everybody() if other_writers.arguments_of(pid) in theirs}


def contested(outline: Snapshot, options: RestoreOptions, pid: int, components: Mapping[str, int]) -> tuple[str, ...]:
    """See `checkpoint.engine.Engine.contested`."""
    own = {pid, *descendants.component(pid)}
    spared = frozenset(own).union(*(other_writers.family(one) for one in (os.getpid(), pid)))
    owners = {one: name for name, first in components.items() if first != pid for one in (first, *descendants.component(first))}
    known = replace(options, accept_changed=carried_files.every_path(outline))
    found = list(restore.written_by_others(outline, spared, owners))
    for view in process_tree.views(carried_files.without(outline)):
        found += _of_writers(view, known, spared, owners)
    return tuple(dict.fromkeys(found))


def _of_views(state: Snapshot, options: RestoreOptions) -> tuple[str, ...]:
    """Views of the kernel that a program of an ordinary user cannot have, of all processes of a component."""
    if not options.own_eyes:
        return ()
    known = frozenset(one.process.pid for one in state.processes)
    held = (resource for one in state.processes for resource in one.resources)
    return tuple(text for one in held for text in proc_and_sys.refuse_user(one, known, isolated=state.process.isolated))


def _of_root(state: Snapshot) -> Iterator[str]:
    """Whether its vessel could enter its root directory: one with PIDs of its own has the right to in its user namespace."""
    may = procfs.status(os.getpid()).capabilities[2] >> CAP_SYS_CHROOT & 1
    if state.process.root_directory != "/" and not (may or state.process.isolated):
        yield may_not_enter(state.process.root_directory)


def _in_flux(state: Snapshot) -> Iterator[str]:
    """Files here that the program writes to, and that may yet be as it leaves them."""
    here = state.machine.boot_id == this_machine().boot_id
    for held in state.resources:
        path = str(held.facts.get("path", ""))
        if held.kind != "files" or not rebuild.is_written(held) or not os.path.exists(path):
            continue
        if here or os.path.getsize(path) >= number_of(held.facts["size"]):
            yield path
    for vma in state.vmas:
        if vma.file is not None and vma.shared and vma.protection & abi.PROT_WRITE and os.path.exists(vma.file.path):
            yield vma.file.path


def _of_machine(state: Snapshot, options: RestoreOptions, content_at: ContentAt | None) -> Iterator[str]:
    machine, here = state.machine, this_machine()
    if machine.page_size != abi.PAGE_SIZE:
        yield f"its pages are {machine.page_size} bytes, this kernel's {abi.PAGE_SIZE}: boot a kernel with the same"
    yield from _of_threads(state)
    if content_at is not None and not vdso.fits(state, own_kernel_pages()):
        yield from vdso.refuse(state, content_at)
    if listed := ", ".join(cpu_baseline.lacking(machine.features, here.features)):
        cure = "use one that has them, or start it with failover run --portable"
        yield f"this processor lacks {listed}, by which the program may have chosen its code: {cure}"
    yield from mapping_kinds.refuse(state)
    yield from aio.mismatches(state.vmas)
    if any(vma.guards for vma in state.vmas) and not can_install_guards():
        yield f"it has guard pages of madvise(2), which this kernel ({here.kernel}) does not know: boot Linux 6.13 or later"
    if not os.path.isdir(state.process.root_directory):
        yield f"its root directory {state.process.root_directory} is missing: make it"
    directory = state.process.working_directory
    is_made = directory in options.accept_changed or (options.contents and missing_directories(state))
    if not (os.path.isdir(directory) or procfs.is_gone(directory) or is_made):
        yield f"its working directory {directory} is missing: make it"


@functools.cache
def own_kernel_pages() -> list[procfs.MapsLine]:
    """Where our own vdso and its data lie, as long as we live."""
    return kernel_pages(procfs.parse_maps(procfs.read_text(os.getpid(), "maps")))


def missing_directories(state: Snapshot) -> tuple[str, ...]:
    """The directories to make for the program's working directory, the outermost first; none where that is impossible."""
    directory = Path(state.process.working_directory)
    missing = [one for one in (directory, *directory.parents) if not os.path.lexists(one)]
    is_plain = directory.is_absolute() and ".." not in directory.parts and not procfs.is_gone(str(directory))
    return tuple(str(one) for one in reversed(missing)) if is_plain else ()


def _of_threads(state: Snapshot) -> Iterator[str]:
    if not state.threads or state.threads[0].tid != state.process.pid:
        yield "its first thread is missing: capture it again"
    for thread in state.threads:
        registers = thread.registers
        if len(registers.get("prstatus", b"")) != cpu.REGISTERS_SIZE or not registers.get("xstate"):
            yield f"the registers of its thread {thread.tid} are not those of this processor: capture it again"
            continue
        if names := ", ".join(extended.lacking(registers["xstate"], *xstate_layouts(state))):
            cure = "use the same processor, or another checkpoint"
            yield f"its thread {thread.tid} is using {names}, which this machine lacks: {cure}"


def xstate_layouts(state: Snapshot) -> tuple[extended.Layout, extended.Layout]:
    """Where the components of the threads' extended states lie there, and here; the same where it is not told."""
    ours = cpuid.xstate_layout()
    told = state.threads[0].registers.get("xstate_layout", b"") if state.threads else b""
    theirs = extended.decode_layout(told)
    return theirs or ours, ours or theirs


def can_install_guards() -> bool:
    """Whether this kernel knows MADV_GUARD_INSTALL."""
    with mmap.mmap(-1, abi.PAGE_SIZE, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS) as page:
        try:
            page.madvise(abi.MADV_GUARD_INSTALL)
        except OSError:
            return False
    return True


# --- Files -----------------------------------------------------------------------------------------------------------


def _of_files(state: Snapshot, options: RestoreOptions, brought: dict[str, str], digest_of: DigestOf) -> Iterator[str]:
    """The executable and everything that is mapped: the program runs their bytes, so they must be the very same.

    Args:
        brought: gets the content to open, by path, where this machine has not the same file.
    """
    mapped = [vma.file for vma in state.vmas if vma.file is not None and is_file_mapping(vma)]
    written = {vma.file.path for vma in state.vmas if vma.file is not None and vma.shared and vma.protection & abi.PROT_WRITE}
    private = {vma.file.path for vma in state.vmas if vma.file is not None and not vma.shared} | {state.process.executable.path}
    for identity in {identity.path: identity for identity in (state.process.executable, *mapped)}.values():
        if identity.path in options.accept_changed or _is_made(state, identity.path):
            continue
        if options.terms.is_shared(identity.path) and identity.path not in private:
            yield from _of_shared_file(identity.path, "mapped")
            continue
        reasons = tuple(_of_file(identity, digest_of, is_written=identity.path in written))
        content, damage = _content(options, identity.digest if reasons and identity.path not in written else b"", digest_of)
        if content:
            brought[identity.path] = content
        else:
            yield from (reason + damage for reason in reasons)


def of_mapped_files(state: Snapshot, options: RestoreOptions) -> tuple[tuple[str, ...], dict[str, str]]:
    """Why its executable, or a mapped file, cannot be had here; and the contents to open for files brought along, by path."""
    brought: dict[str, str] = {}
    return tuple(_of_files(state, options, brought, digest_of_file)), brought


def _content(options: RestoreOptions, digest: bytes, digest_of: DigestOf) -> tuple[str, str]:
    """The file that was brought with this digest, or "" and its fault ("" if there is no such file)."""
    if not options.contents or len(digest) != DIGEST_SIZE:
        return "", ""
    path = str(path_in(options.contents, digest))
    try:
        if digest_of(path) == digest:
            return path, ""
    except OSError:
        return "", ""
    return "", f"; the brought copy of it ({path}) is damaged: remove that copy, and failover brings it again"


def _is_made(state: Snapshot, path: str) -> bool:
    """Whether a file is missing here, and a restore makes it."""
    return not os.path.lexists(path) and makes_shared_memory(state.vmas, path)


def _of_file(identity: FileIdentity, digest_of: DigestOf, *, is_written: bool) -> Iterator[str]:
    """Why a file is not the one that was mapped.

    Args:
        is_written: through a shared mapping, by the program itself: the very same file holds other bytes by now, and
            gets those of the snapshot.
    """
    path = identity.path
    try:
        about = os.stat(path)
    except OSError as error:
        yield f"{path} cannot be used ({error.strerror}): {_FAR}"
        return
    is_same = (about.st_dev, about.st_ino) == (identity.device, identity.inode)
    if is_same and (about.st_mtime_ns == identity.mtime_ns or (is_written and about.st_size == identity.size)):
        return
    if identity.size and about.st_size != identity.size:
        yield f"{path} is another file: {about.st_size} bytes here, {identity.size} there; {_FAR}"
    elif identity.digest and digest_of(path) != identity.digest:
        yield f"{path} is another file: as long, but its content differs; {_FAR}"
    elif not identity.digest and identity.build_id and build_id(path) != identity.build_id:
        yield f"{path} is another build of that file (its build id differs); {_FAR}"


def _of_descriptors(state: Snapshot, options: RestoreOptions, brought: dict[str, str], digest_of: DigestOf) -> Iterator[str]:
    for held in state.resources:
        path = str(held.facts.get("path", ""))
        if held.kind not in rebuild.KINDS:
            yield f"{held.name} is of kind {held.kind!r}, which this version does not know: use the version that captured it"
        elif held.kind == "files" and not held.facts.get("deleted") and path not in options.accept_changed:
            if _is_made(state, path):
                continue
            if options.terms.is_shared(path):
                yield from _of_shared_file(path, f"open as {held.name}")
                continue
            reasons = tuple(_of_open_file(held, path, state.machine.boot_id == this_machine().boot_id, digest_of))
            digest = held.facts.get("digest")
            content, damage = _content(options, digest if reasons and isinstance(digest, bytes) else b"", digest_of)
            if content:
                brought[path] = content
            else:
                yield from (reason + damage for reason in reasons)
        elif held.kind == devices_by_rule.KIND:
            yield from devices_by_rule.mismatches(held, options.terms.devices)
        elif "handle" in held.facts and options.own_eyes:
            yield overmounted.refuse_user(held)
        elif held.kind in rebuild.NEEDED:
            yield from rebuild.NEEDED[held.kind](held)


def _of_shared_file(path: str, how: str) -> Iterator[str]:
    """Why a file that keeps what it has cannot be used: it must be there."""
    try:
        os.stat(path)
    except OSError as error:
        yield f"{path}, {how} and shared, cannot be used ({error.strerror}): mount or make it here as it is there"


def _of_open_file(held: Resource, path: str, same_boot: bool, digest_of: DigestOf) -> Iterator[str]:
    """A file that was only read must be the same; one that was written at its end may have grown, and is cut back.

    Args:
        same_boot: it may be the very same file, and its times can be compared.
    """
    cure = _CARRIED if rebuild.is_written(held) else _FAR
    try:
        about = os.stat(path, follow_symlinks=not number_of(held.facts["flags"]) & rebuild.O_PATH)
    except OSError as error:
        yield f"{path}, open as {held.name}, cannot be used ({error.strerror}): {cure}"
        return
    if stat.S_IFMT(about.st_mode) != stat.S_IFMT(number_of(held.facts["mode"])):
        yield f"{path}, open as {held.name}, is of another type here (a directory, a device …); {_FAR}"
        return
    if not stat.S_ISREG(about.st_mode) or number_of(held.facts["flags"]) & rebuild.O_PATH:
        return
    facts, size = held.facts, number_of(held.facts["size"])
    named = f"{path}, open as {held.name},"
    shared = f"accept it as shared if its content does not matter: --shared {shlex.quote(path)}"
    grows, digest = rebuild.grows_at_its_end(held), facts.get("digest", b"")
    same_file = same_boot and (about.st_dev, about.st_ino) == (facts["device"], facts["inode"])
    if about.st_size < size or (about.st_size > size and not grows):
        yield f"{named} has {about.st_size} bytes here and {size} there; {cure}, or {shared}"
    elif same_file and about.st_mtime_ns != facts["mtime_ns"] and rebuild.is_written(held) and not grows:
        yield f"{named} was written to since the snapshot, and not only at its end; end the program with the capture, or {shared}"
    elif digest and digest_of(path) != digest:
        yield f"{named} has another content here; {_FAR}, or {shared}"


def _of_writers(
    state: Snapshot, options: RestoreOptions, ours: frozenset[int], owners: Mapping[int, str] = MappingProxyType({})
) -> Iterator[str]:
    """Files that the program writes to and another process does, too: their words would mix, and the cut would lose some.

    Args:
        owners: which component a process belongs to, by pid.
    """
    for held in state.resources:
        path = str(held.facts.get("path", ""))
        if held.kind != "files" or held.facts.get("deleted") or path in options.accept_changed or options.terms.is_shared(path):
            continue
        if not (os.path.isfile(path) and rebuild.is_written(held) and other_writers.may_be_written(path)):
            continue
        if pid := other_writers.writer_of(path, ours):
            who = other_writers.told(pid, owners)
            cure = f"end that first, or accept it as shared: --shared {shlex.quote(path)}"
            yield f"{path}, open as {held.name}, is held open for writing by {who}: {cure}"
