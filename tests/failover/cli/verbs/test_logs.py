"""The last lines of a stream: whatever the pieces are cut into, and no more is held than is shown."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from failover.cli.verbs.logs import Tail
from failover.client.control import Output


@given(st.lists(st.text("a\n", max_size=6)), st.integers(0, 5))
def test_the_last_lines_are_those_of_the_whole_wherever_it_is_cut(parts: list[str], lines: int) -> None:
    tail, offset = Tail(lines), 0
    for part in parts:
        tail.add(Output(1, offset, part.encode(), ()))
        offset += len(part)
    whole = "".join(parts).splitlines(keepends=True)
    shown = tail.last_lines()
    assert b"".join(one.content for one in shown).decode() == "".join(whole[len(whole) - min(lines, len(whole)) :])
    assert all("".join(parts)[one.offset :].startswith(one.content.decode()) for one in shown)


def test_what_lies_before_the_last_lines_is_forgotten() -> None:
    tail, size = Tail(3), 0
    for number in range(1_000):
        line = b"%d\n" % number
        tail.add(Output(1, size, line, ()))
        size += len(line)
    assert tail.held <= 5
    assert b"".join(one.content for one in tail.last_lines()) == b"997\n998\n999\n"
