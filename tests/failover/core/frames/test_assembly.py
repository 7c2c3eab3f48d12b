"""Items that come in pieces: whole or not at all."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from failover.core.frames.assembly import CONTRADICTORY, INCOMPLETE, UNFINISHED_MAX, Assembly
from failover.core.frames.frame import Portion, _pieces, bodies, body_size_max

VALUE = bytes(range(256)) * 10


def cut(put: int, number: int = 7, value: bytes = VALUE, room: int = 500) -> list[Portion]:
    return list(_pieces(Portion(number, 5, put, value), room, room))


@given(st.permutations(range(len(cut(1)))))
def test_pieces_in_any_order_make_the_value_once(order: list[int]) -> None:
    pieces, assembly = cut(1), Assembly()
    found = [assembly.take("robot2", pieces[place]) for place in order]
    assert found[:-1] == [None] * (len(pieces) - 1)
    assert found[-1] == Portion(7, 5, 1, VALUE)


def test_an_item_in_one_piece_passes_as_it_is() -> None:
    assert Assembly().take("robot2", Portion(1, 2, 3, b"")) == Portion(1, 2, 3, b"")


def test_a_put_that_lacks_a_piece_is_dropped_and_counted_when_the_next_one_comes() -> None:
    assembly = Assembly()
    for piece in cut(1)[1:] + cut(2)[:-1]:
        assert assembly.take("robot2", piece) is None
    assert assembly.take("robot2", cut(2)[-1]) == Portion(7, 5, 2, VALUE)
    assert assembly.dropped == {INCOMPLETE: 1}


def test_pieces_of_two_senders_do_not_mix() -> None:
    assembly = Assembly()
    first, *rest = cut(1)
    assembly.take("robot2", first)
    assert all(assembly.take("robot3", piece) is None for piece in rest)


def test_a_piece_that_comes_twice_stands_for_no_other() -> None:
    assembly, pieces = Assembly(), cut(1)
    assert all(assembly.take("robot2", pieces[0]) is None for _ in range(len(pieces)))
    found = [assembly.take("robot2", piece) for piece in pieces]
    assert found[-1] == Portion(7, 5, 1, VALUE)


def test_pieces_that_overlap_or_are_of_another_size_make_no_value() -> None:
    assembly = Assembly()
    for portion in (Portion(1, 0, 1, b"1234", 0, 8), Portion(1, 0, 1, b"1234", 2, 8)):
        assert assembly.take("robot2", portion) is None
    for portion in (Portion(1, 0, 2, b"1234", 0, 8), Portion(1, 0, 2, b"1234", 4, 9)):
        assert assembly.take("robot2", portion) is None
    assert assembly.dropped == {CONTRADICTORY: 2}


def test_a_sender_that_begins_many_fills_no_memory() -> None:
    assembly = Assembly()
    for number in range(1000):
        assembly.take("robot2", Portion(number, 0, 1, b"x", 0, 65536))
    assert assembly.dropped == {INCOMPLETE: 1000 - UNFINISHED_MAX}


PIECES = st.builds(
    Portion, st.integers(0, 2), st.just(0), st.integers(1, 3), st.binary(max_size=4), st.integers(0, 8), st.integers(0, 8)
).filter(lambda portion: portion.is_sound)


@given(st.lists(PIECES, max_size=40))
def test_whatever_comes_a_value_that_is_given_out_has_its_size(portions: list[Portion]) -> None:
    assembly = Assembly()
    for portion in portions:
        found = assembly.take("robot2", portion)
        assert found is None or (found.total == 0 and found.is_sound)
        assert found is None or portion.total == 0 or len(found.value) == portion.total


def test_what_a_frame_cuts_is_put_together_again() -> None:
    items = [Portion(number, 9, 4, bytes([number]) * (2000 * number)) for number in range(8)]
    assembly = Assembly()
    made, placed = bodies(None, None, items, 0, body_size_max(8))
    assert placed == len(items)
    import msgspec

    from failover.core.frames.frame import Body

    found = [assembly.take("r", one) for body in made for one in msgspec.msgpack.decode(body, type=Body).items]
    assert [one for one in found if one is not None] == items
