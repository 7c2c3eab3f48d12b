"""Three processes that change memory of their own, and memory that they share, in turns: ``mutable_family.py SEED``.

A token passes round by pipes. The process that has it takes the step of its number: it writes, empties or maps again what chance
says, which is the same for the same seed and step. When the file ``go`` is there each replays all steps on bytes of its own, and
says whether its memory is what it must be. The first one writes the number of each step of its own.
"""

import mmap
import os
import random
import sys
import tempfile
import time

PAGE = mmap.PAGESIZE
PRIVATE, SHARED = 64, 48
COUNT = 3
SEED = int(sys.argv[1])
OWN, FIRST_SHARED = 0, 1
MADV_REMOVE, MADV_DONTNEED = 9, 4


def opened():
    """A descriptor of each sort of shared memory that has one."""
    memory = os.memfd_create("shared")
    with tempfile.NamedTemporaryFile(dir="/dev/shm", delete=False) as file:
        nameless = os.dup(file.fileno())
    os.unlink(file.name)
    for one in (memory, nameless):
        os.ftruncate(one, SHARED * PAGE)
    return memory, nameless


def own():
    return mmap.mmap(-1, PRIVATE * PAGE, mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)


def step_of(number):
    """What a step does: (place, first page, pages, act, byte)."""
    dice = random.Random(SEED * 1_000_003 + number)
    place = dice.choice((OWN, OWN, 1, 2, 3))
    count = dice.randint(1, 6)
    first = dice.randrange((PRIVATE if place == OWN else SHARED) - count)
    return place, first, count, dice.choice(("write", "write", "write", "zero", "empty", "again")), dice.randrange(1, 256)


def take(number):
    place, first, count, act, byte = step_of(number)
    memory, begin, end = places[place], first * PAGE, (first + count) * PAGE
    if act == "write":
        for page in range(begin, end, PAGE):
            memory[page : page + 16] = bytes([byte]) * 16
    elif act == "zero":
        memory[begin:end] = bytes(end - begin)
    elif act == "empty":
        memory.madvise(MADV_DONTNEED if place == OWN else MADV_REMOVE, begin, end - begin)
    elif place == OWN:
        memory.close()
        places[OWN] = own()
    elif place > FIRST_SHARED:
        memory.close()
        places[place] = mmap.mmap(descriptors[place - 2], SHARED * PAGE)


def replayed(place, numbers):
    """The same by bytes alone."""
    content = bytearray((PRIVATE if place == OWN else SHARED) * PAGE)
    for number in numbers:
        where, first, count, act, byte = step_of(number)
        if where != place:
            continue
        for page in range(first * PAGE, (first + count) * PAGE, PAGE):
            if act == "write":
                content[page : page + 16] = bytes([byte]) * 16
            elif act in ("zero", "empty"):
                content[page : page + PAGE] = bytes(PAGE)
        if act == "again" and place == OWN:
            content = bytearray(len(content))
    return bytes(content)


def differences(rank, last):
    numbers = range(last + 1)
    mine = [number for number in numbers if number % COUNT == rank]
    for place, memory in enumerate(places):
        if memory[:] != replayed(place, mine if place == OWN else numbers):
            print(f"process {rank} has another content at place {place} after {last} steps", flush=True)
            return 1
    return 0


def go_round(rank):
    """Take one step in `COUNT`, until the token says that all is over."""
    while True:
        number, is_over = map(int, os.read(pipes[rank][0], 64).split())
        if is_over:
            wrong = differences(rank, number)
            if rank + 1 < COUNT:
                os.write(pipes[rank + 1][1], b"%d 1" % number)
            return wrong
        take(number)
        if rank == 0:
            print(number // COUNT, flush=True)
            time.sleep(0.001)
        is_last = rank == COUNT - 1 and os.path.exists("go")
        following = number if is_last else number + 1
        os.write(pipes[(rank + 1) % COUNT][1], b"%d %d" % (following, is_last))


descriptors = opened()
pipes = [os.pipe() for _ in range(COUNT)]
common = own()  # in common since the fork, until somebody writes
common[:] = bytes(range(256)) * (len(common) // 256)
places = [own(), mmap.mmap(-1, SHARED * PAGE), *(mmap.mmap(one, SHARED * PAGE) for one in descriptors)]
children = []
for rank in range(1, COUNT):
    child = os.fork()
    if child == 0:
        os._exit(go_round(rank) or common[:] != bytes(range(256)) * (len(common) // 256))
    children.append(child)
print("ready", flush=True)
os.write(pipes[0][1], b"0 0")
wrong = go_round(0)
statuses = [os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) for child in children]
print("ok" if not wrong and not any(statuses) else f"wrong: {statuses}", flush=True)
