"""board_component.c in Python."""

import os
import time

from failover.boards.board import board
from failover.errors import FailoverError


def tell(opened, item, put, count):
    try:
        robot = opened.robot
    except FailoverError:
        robot = "none"
    lines = [f"robot {robot}", f"put {put}", f"count {count}"]
    for name, whose in (("own", None), ("peer", "robot9")):
        try:
            reading = item.get(whose)
            value = int.from_bytes(reading.value, "little")
            lines += [f"{name} 0", f"{name}_value {value}", f"{name}_age {reading.age_ns}", f"{name}_number {reading.number}"]
        except FailoverError:
            lines += [f"{name} -1"]
    with open("answer.new", "w") as file:
        file.write("".join(f"{line}\n" for line in lines))
    os.rename("answer.new", "answer")


def main():
    opened = board()
    item, count = opened.item("map"), 0
    print("ready", flush=True)
    while True:
        count += 1
        put = 0
        try:
            item.put(count.to_bytes(8, "little"))
        except FailoverError:
            put = -1
        if os.path.exists("ask"):
            os.unlink("ask")
            tell(opened, item, put, count)
        time.sleep(0.002)


main()
