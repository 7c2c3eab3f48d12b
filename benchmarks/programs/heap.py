"""A Python program with objects, as a robot's map would be: a dictionary of cells, some of them written anew all the time.

``python3 heap.py CELLS CHANGES``: prints "ready", then replaces CHANGES cells and sleeps 50 ms, for ever. Also imported by the
benchmark, which pickles the same objects.
"""

import random
import sys
import time

Cells = dict[tuple[int, int], dict[str, object]]


def cell(dice: random.Random, turn: int) -> dict[str, object]:
    """One cell of the map."""
    return {
        "height": dice.random(),
        "seen": turn,
        "by": f"laser-{dice.randrange(4)}",
        "history": [dice.random() for _ in range(4)],
    }


def cells(count: int, dice: random.Random) -> Cells:
    """A map of ``count`` cells."""
    return {(index // 1000, index % 1000): cell(dice, 0) for index in range(count)}


def change(found: Cells, changes: int, dice: random.Random, turn: int) -> None:
    """Replace some cells, those near each other as a moving robot would."""
    start = dice.randrange(max(len(found) - changes, 1))
    for index in range(start, start + changes):
        found[(index // 1000, index % 1000)] = cell(dice, turn)


def main() -> None:
    """Go on for ever."""
    count, changes = int(sys.argv[1]), int(sys.argv[2])
    dice = random.Random(1)
    found = cells(count, dice)
    print("ready", flush=True)
    turn = 0
    while True:
        turn += 1
        change(found, changes, dice, turn)
        time.sleep(0.05)


if __name__ == "__main__":
    main()
