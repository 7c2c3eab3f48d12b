"""Restore a program of another kernel: redirect its calls to that kernel's vdso to this kernel's vdso.

The program holds addresses of functions in the vdso image that it was started with, because the C library looks them up at the
start. Where this kernel's image differs, the old image stays at its place as ordinary memory, and each function that `arch` names
begins with a jump into this kernel's image, which lies in a hole. So later look-ups by the auxiliary vector find the functions as
well. The data that the old image read are gone. Zeros in their place make the rest of the image ask the kernel by a system call.

When such a program moves again, its first image is an ordinary mapping, and only the jumps are renewed: a program that moved back
and forth a hundred times carries one old image.

A thread that was in the middle of the old image is led out of it before the jumps are written (`run_out`). The restore does this,
not the freeze of the live program, because here no program waits and the program can come to no harm. The thread continues with
the data that it had read, or by a system call. Only where it would take zeros for the time (a coarse clock, time(2)) its snapshot
is refused.

A limit: a signal handler that interrupted a function of the old image returns into it, and the coarse clocks answer 0 that once.

Source: vdso(7); lib/vdso/gettimeofday.c, where a clock mode of 0 (VDSO_CLOCKMODE_NONE) means the system call.
"""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Final

from msgspec.structs import replace

from checkpoint.arch import cpu
from checkpoint.arch import stubs as arch
from checkpoint.capability import Area, preserved
from checkpoint.engines.ptrace.facts.describe import this_machine
from checkpoint.engines.ptrace.restore.memory import KERNEL_KINDS, kernel_pages_of
from checkpoint.engines.ptrace.restore.vdso_syscalls import VdsoCalls
from checkpoint.errors import RestoreError
from checkpoint.linux import abi
from checkpoint.linux.procfs.procfs import MapsLine
from checkpoint.linux.spawn import vdso
from checkpoint.linux.spawn.vdso import Function
from checkpoint.linux.trace.tracee import Tracee
from checkpoint.model import Snapshot, ThreadState, Vma, VmaKind

CAPABILITIES: Final = (
    preserved(
        Area.THERE,
        "another kernel, with another vdso",
        "calls to the old vdso are led to the new one; refused if the program has moved its vdso, or was just reading a "
        "coarse clock",
        "and the program has moved or unmapped it",
        "and the snapshot does not hold the old one",
    ),
)
IMAGE_LIMIT: Final = 1 << 20
"""Bytes of an image that are looked at: those of today's kernels have 8 KiB."""
ContentAt = Callable[[int, int], bytes | None]
"""Bytes of a program's memory at an address, of a size; None where they are not carried."""
STEP_LIMIT: Final = 1000
"""Instructions that a thread is followed: a function of the vdso has some two hundred."""


def fits(state: Snapshot, ours: Sequence[MapsLine]) -> bool:
    """Whether this kernel's vdso can stand where the program had its own: the same code, laid out alike.

    Args:
        ours: of a process here, as `checkpoint.engines.ptrace.restore.memory.kernel_pages` finds them.
    """
    alike = [line.size for line in ours] == [vma.size for vma in kernel_pages_of(state.vmas)]
    return alike and state.machine.vdso_digest == this_machine().vdso_digest


def entry_address(state: Snapshot) -> int:
    """Where the image lies that the program was born with; 0 where it has none."""
    told = vdso.address_in(state.process.layout.auxv)
    own = kernel_pages_of(state.vmas)
    return told or (own[-1].start if own else 0)


def refuse(state: Snapshot, content_at: ContentAt) -> Iterator[str]:
    """Why a program of another kernel cannot be led to this one's vdso."""
    image = _image_mapping(state)
    named = f"the vdso of its kernel ({state.machine.kernel}) differs from that of this kernel ({this_machine().kernel})"
    if image is None:
        yield f"{named}, and the program has moved or unmapped it: boot the same kernel"
        return
    content = content_at(image.start, image.size) if image.size <= IMAGE_LIMIT else None
    if not content or not vdso.functions(content):
        yield f"{named}, and the snapshot does not hold the old one: capture it again, or boot the same kernel"


def _image_mapping(state: Snapshot) -> Vma | None:
    entry = entry_address(state)
    return next((vma for vma in state.vmas if vma.start == entry), None) if entry else None


def with_own_image(state: Snapshot) -> tuple[Snapshot, tuple[Vma, ...]]:
    """The same program with its kernel's image as memory of its own, and these mappings: data first, the image last.

    There are none where the program was led to that kernel's image before: what it was born with is its own already.
    """
    entry, own = entry_address(state), kernel_pages_of(state.vmas)
    if not any(vma.start == entry for vma in own):
        return replace(state, vmas=tuple(vma for vma in state.vmas if vma.kind not in KERNEL_KINDS)), ()
    vmas = tuple(_as_memory(vma) for vma in state.vmas)
    return replace(state, vmas=vmas), tuple(vma for vma in vmas if vma.start in {one.start for one in own})


def _as_memory(vma: Vma) -> Vma:
    """A mapping of the kernel's as one that we can make; its data are not readable until `run_out` is done."""
    if vma.kind not in KERNEL_KINDS:
        return vma
    protection = abi.PROT_READ | abi.PROT_EXEC if vma.kind is VmaKind.VDSO else 0
    return Vma(vma.start, vma.end, protection, shared=False, kind=VmaKind.ANONYMOUS)


def led_out(tracee: Tracee, calls: VdsoCalls, foreign: Sequence[Vma], threads: Iterable[ThreadState]) -> tuple[ThreadState, ...]:
    """The threads of a program, none of them in the middle of the old image.

    Args:
        tracee: of the vessel, stands still, with all signals blocked but SIGTRAP.
        calls: that it makes.
        foreign: the old kernel's data, the image last, as `with_own_image` tells.

    Raises:
        RestoreError: see `run_out`.
    """
    *places, image = foreign

    def protect(protection: int, mappings: Sequence[Vma] = places) -> None:
        for place in mappings:
            calls.make("mprotect", place.start, place.size, protection)

    def outside(thread: ThreadState) -> ThreadState:
        if not stands_in(thread.registers["prstatus"], image):
            return thread
        registers = run_out(tracee, thread.registers["prstatus"], image, lambda: protect(abi.PROT_READ))
        protect(abi.PROT_NONE)
        return replace(thread, registers={**thread.registers, "prstatus": registers}, interrupted="")

    protect(abi.PROT_READ | abi.PROT_EXEC, [image])
    led = tuple(map(outside, threads))
    protect(abi.PROT_READ | abi.PROT_WRITE, [image])
    protect(abi.PROT_READ)
    return led


def run_out(tracee: Tracee, registers: bytes, code: Vma, open_data: Callable[[], None]) -> bytes:
    """Lead a thread out of the old image, by steps that a thread of the vessel takes in its stead; its registers afterwards.

    Args:
        tracee: stands still, with all signals blocked but SIGTRAP.
        code: the mapping of the old image.
        open_data: makes the old image's data readable: they are zeros.

    Raises:
        RestoreError: it would take zeros for the time, or does not come out.
    """
    image = tracee.memory.read(code.start, code.size)
    registers = arch.with_registers(registers)
    asked = opened = False
    for _ in range(STEP_LIMIT):
        place = cpu.decode_registers(registers)[cpu.INSTRUCTION_POINTER]
        if not code.start <= place < code.end:
            if opened and not asked:
                break
            return registers
        asked |= image.startswith(cpu.SYSCALL, place - code.start)
        tracee.set_registers(registers)
        tracee.request("step", abi.PTRACE_SINGLESTEP)
        stop = tracee.wait()
        if stop.signal == signal.SIGSEGV and not opened:
            open_data()
            opened = True
            continue
        if stop.signal != signal.SIGTRAP:
            break
        registers = arch.with_registers(tracee.registers())
    raise RestoreError(
        "cannot restore: a thread was just reading a clock in the vdso of another kernel, whose data are gone; "
        "take another checkpoint, or boot the same kernel"
    )


def stands_in(registers: bytes, image: Vma) -> bool:
    """Whether a thread is in the middle of an image."""
    return image.start <= cpu.decode_registers(registers)[cpu.INSTRUCTION_POINTER] < image.end


def jumps(state: Snapshot, content_at: ContentAt, own: int, functions: Sequence[Function]) -> list[tuple[int, bytes]]:
    """The bytes to write into the image that the program was born with: each function jumps to this kernel's own.

    Args:
        own: where this kernel's image lies.
        functions: of this kernel's.
    """
    image = _image_mapping(state)
    content = content_at(image.start, image.size) if image is not None else None
    if image is None or content is None:
        return []
    known = {function.name: own + function.offset for function in functions}
    led = ((image.start + old.offset, _first_bytes(old, known)) for old in vdso.functions(content))
    return [(address, code) for address, code in led if code]


def _first_bytes(old: Function, known: Mapping[str, int]) -> bytes:
    """A jump; a system call where this kernel has no such function; nothing where there is no room, or no need."""
    number = arch.VDSO_CALLS.get(old.name)
    if number is None:
        return b""
    code = arch.jump_to(known[old.name]) if old.name in known else arch.call_and_return(number)
    return code if len(code) <= old.size else b""
