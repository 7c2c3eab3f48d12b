"""Frames: what one robot seals and another one opens, which datagrams are believed, and which are refused by value."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from failover.core.beat_builder import Speaker
from failover.core.frames import frame
from failover.core.frames.frame import (
    AGE_US_MAX,
    FRAME_SIZE_MAX,
    HEADER,
    ITEM_SIZE_MAX,
    LEFT_US_MAX,
    PARTS_MAX,
    SEAL_SIZE,
    Part,
    Portion,
    Reason,
    Receiver,
    Refused,
    Sealer,
    beat_size_max,
    bodies,
    body_size_max,
    codes,
    size_of,
)
from failover.core.frames.roster import Roster, roster
from failover.core.frames.terms import Said
from failover.core.wire.messages import Beat, Echo, Entry

TEAM = roster(["robot1", "robot2", "robot3"])
KEYS = {(a, b): f"{a} speaks to {b}".encode() for a in TEAM.names for b in TEAM.names if a != b}
ENTRY = Entry("/lab/robot1/mapper", 3, 7, "robot1", 449, 12, bytes(16), "robot2")
BEAT = Beat("robot1", 3, 41, 40, 1, 1, (Echo("robot2", 9, 1000),), (ENTRY,), 2)
SAID = Said(50_000, 0b111, 12, (0b101010,), ((1, 1000, 12_345),))
BALL = Portion(0, 1_500, 77, bytes(range(16)))
LEFT_US = 3_600_000_000
DOCUMENT = Path(frame.__file__).with_name("FRAME.md")


def sealer(me: str = "robot1", boot: int = 3, team: Roster = TEAM) -> Sealer:
    made = Sealer(me, "team", team, boot)
    made.counter = 99
    return made


def keys_of(me: str) -> list[bytes]:
    """Its keys to all others, by rank."""
    return [KEYS[me, other] for other in TEAM.names if other != me]


def sealed(
    beat: Beat | None = BEAT, items: tuple[Portion, ...] = (BALL,), by: Sealer | None = None, said: Said | None = SAID
) -> bytes:
    by = by or sealer()
    (datagram,) = by.seal(bodies(said, beat, items, LEFT_US, body_size_max(3))[0], keys_of("robot1"), round_=5)
    return datagram


def receiver(me: str = "robot2", team: Roster = TEAM) -> Receiver:
    made = Receiver(me, "team", team)
    for other in TEAM.names:
        if other != me:
            made.accept(other, KEYS[other, me])
    return made


def resealed(body: bytes, count: int = 2, key: bytes = KEYS["robot1", "robot2"]) -> bytes:
    """A datagram of any body whose first authenticators are right."""
    (datagram,) = sealer().seal([body], [key] * count)
    return datagram


# --- What is believed ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("me", ["robot2", "robot3"])
def test_every_receiver_reads_the_same_datagram(me: str) -> None:
    assert receiver(me).open(sealed()) == Part(
        "robot1", True, 0, 0, frame.LAST, 3, 100, 5, 0, 1, SAID, BEAT, (BALL,), LEFT_US
    )  # fmt: skip


def test_the_samples_of_the_document_are_what_we_send_and_read() -> None:
    blocks = DOCUMENT.read_text().partition("## Samples")[2].split("```")[1::2]
    found = [bytes.fromhex("".join(block.split())) for block in blocks]
    long = Portion(3, AGE_US_MAX, 1, bytes(1150))
    two = sealer().seal(bodies(None, None, (BALL, long), LEFT_US, body_size_max(3))[0], keys_of("robot1"), round_=5)
    assert found == [sealed(), two[1]]
    assert isinstance(receiver().open(found[0]), Part)


def test_a_part_is_believed_once() -> None:
    opened, datagram = receiver(), sealed()
    opened.open(datagram)
    assert opened.open(datagram) == Refused(Reason.REPLAYED, "robot1", 100)


def counted(counter: int, boot: int = 1) -> bytes:
    """A datagram of that counter and life."""
    by = sealer(boot=boot)
    by.counter = counter - 1
    return sealed(Beat("robot1", boot, 1), by=by)


def test_late_parts_inside_the_window_are_believed_and_older_ones_are_not() -> None:
    opened = receiver()
    opened.open(counted(100))
    assert isinstance(opened.open(counted(37)), Part)
    assert opened.open(counted(36)) == Refused(Reason.REPLAYED, "robot1", 36)


def test_an_earlier_life_is_refused_and_a_later_one_begins_anew() -> None:
    opened = receiver()
    opened.open(counted(100, 5))
    assert opened.open(counted(101, 4)) == Refused(Reason.EARLIER_LIFE, "robot1", 101)
    assert isinstance(opened.open(counted(1, 6)), Part)
    assert opened.open(counted(102, 5)) == Refused(Reason.EARLIER_LIFE, "robot1", 102)


def test_a_forged_boot_count_does_not_reset_the_window() -> None:
    opened, datagram = receiver(), counted(100, 5)
    opened.open(datagram)
    forged = bytearray(counted(1, 9))
    forged[HEADER.size + SEAL_SIZE - 1] ^= 1
    assert opened.open(bytes(forged)) == Refused(Reason.FORGED)
    assert opened.open(datagram) == Refused(Reason.REPLAYED, "robot1", 100)


def test_the_key_before_the_present_one_stays_valid_and_the_one_before_that_does_not() -> None:
    opened = receiver()
    newer = [bytes([number]) * 32 for number in (1, 2)]
    for key in newer:
        opened.accept("robot1", key)
    by, (body,) = sealer(), bodies(None, BEAT, (), LEFT_US, body_size_max(3))[0]
    verdicts = [opened.open(by.seal([body], [key])[0]) for key in (*newer, KEYS["robot1", "robot2"])]
    assert [isinstance(one, Part) for one in verdicts] == [True, True, False]
    assert verdicts[2] == Refused(Reason.UNKNOWN_KEY)


def test_an_older_key_that_is_forgotten_is_refused_and_the_newest_one_stays_valid() -> None:
    opened, newer = receiver(), bytes(32)
    opened.accept("robot1", newer)
    for sender in ("robot1", "nobody"):
        opened.forget_older(sender)
    by, (body,) = sealer(), bodies(None, BEAT, (), LEFT_US, body_size_max(3))[0]
    old, new = (opened.open(by.seal([body], [key])[0]) for key in (KEYS["robot1", "robot2"], newer))
    assert old == Refused(Reason.UNKNOWN_KEY) and isinstance(new, Part)


# --- One speaker -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("count", [1, 2])
def test_a_receiver_cannot_make_what_another_receiver_believes(count: int) -> None:
    """robot2 knows its own key of robot1, and the number of robot3's; it seals a frame in robot1's name with all that it has."""
    stolen, number = KEYS["robot1", "robot2"], frame._prepared(KEYS["robot1", "robot3"])[0]
    (datagram,) = sealer().seal(bodies(SAID, BEAT, (), LEFT_US, body_size_max(3))[0], [stolen] * count)
    assert receiver("robot3").open(datagram) == Refused(Reason.UNKNOWN_KEY)
    for place in range(count):
        at = HEADER.size + SEAL_SIZE * place
        datagram = datagram[:at] + number + datagram[at + len(number) :]
    assert receiver("robot3").open(datagram) == Refused(Reason.FORGED)


def test_no_robot_speaks_for_another() -> None:
    for by, beat in ((sealer(), Beat("robot3", 3, 1)), (sealer("robot3"), BEAT)):
        (datagram,) = by.seal(bodies(None, beat, (), LEFT_US, body_size_max(3))[0], [KEYS["robot1", "robot2"]])
        assert isinstance(receiver().open(datagram), Refused)


def test_a_rank_that_is_not_its_senders_is_refused() -> None:
    by = sealer()
    by._rank = 2
    (datagram,) = by.seal(bodies(SAID, BEAT, (), LEFT_US, body_size_max(3))[0], [KEYS["robot1", "robot2"]])
    assert receiver().open(datagram) == Refused(Reason.SENDER, "robot1")


def test_a_receiver_whose_key_is_not_known_yet_gets_no_code_and_the_others_do() -> None:
    (datagram,) = sealer().seal(bodies(SAID, BEAT, (), LEFT_US, body_size_max(3))[0], [b"", KEYS["robot1", "robot3"]])
    assert receiver("robot2").open(datagram) == Refused(Reason.UNSEALED)
    assert isinstance(receiver("robot3").open(datagram), Part)


# --- Another roster --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("others", [["robot1", "robot2", "robot3", "base"], ["robot1", "robot2"], ["robot1", "robot2", "robot4"]])
def test_of_a_robot_with_another_team_file_the_beat_is_believed_and_nothing_that_counts_by_rank(others: list[str]) -> None:
    """An operator changes the team file of one robot after the other: meanwhile they must hear each other live."""
    theirs = roster(others)
    keys = [KEYS.get(("robot1", other), b"") for other in theirs.names if other != "robot1"]
    by = sealer(team=theirs)
    (datagram,) = by.seal(bodies(SAID, BEAT, (BALL,), LEFT_US, body_size_max(len(theirs)))[0], keys)
    found = receiver().open(datagram)
    assert isinstance(found, Part)
    assert (found.sender, found.alike, found.rank, found.slots, found.beat, found.items) == ("robot1", False, 0, None, BEAT, ())


def test_of_a_robot_with_another_board_likewise() -> None:
    theirs = roster(TEAM.names, b"another board")
    found = receiver().open(sealed(by=sealer(team=theirs)))
    assert isinstance(found, Part)
    assert (found.alike, found.items, found.beat) == (False, (), BEAT)
    assert receiver().open(sealed(None, by=sealer(team=theirs))) == Refused(Reason.ROSTER, "robot1")


# --- What is refused -------------------------------------------------------------------------------------------------


def changed(at: int, value: bytes) -> bytes:
    datagram = sealed()
    return datagram[:at] + value + datagram[at + len(value) :]


@pytest.mark.parametrize(
    ("datagram", "reason"),
    [
        (b"", Reason.NOT_OURS),
        (b"fB\x01\x00" + bytes(40), Reason.VERSION),
        (b"fB\x01\x00" + bytes(400), Reason.VERSION),
        (sealed() + bytes(FRAME_SIZE_MAX), Reason.NOT_OURS),
        (changed(0, b"gg"), Reason.NOT_OURS),
        (changed(2, b"\x02"), Reason.VERSION),
        (changed(8, b"\xff"), Reason.TEAM),
        (changed(20, bytes(4)), Reason.UNKNOWN_KEY),
        (changed(44, b"\x01"), Reason.PART),
        (changed(44, b"\xff\xff"), Reason.PART),
        (changed(45, b"\x00"), Reason.PART),
        (changed(45, bytes([PARTS_MAX + 1])), Reason.PART),
        (changed(46, b"\x00\x00"), Reason.NOT_OURS),
        (changed(46, b"\xff\xff"), Reason.NOT_OURS),
        (changed(46, b"\x03\x00"), Reason.ROSTER),
        (changed(48, b"\xff\xff"), Reason.UNKNOWN_KEY),
        (changed(52, b"\xff\xff"), Reason.FORGED),
        (changed(4, b"\x01\x00"), Reason.ROSTER),
        (changed(24, b"\x04"), Reason.FORGED),
        (changed(40, b"\x06"), Reason.FORGED),
    ],
)
def test_strangers_are_refused_by_name(datagram: bytes, reason: Reason) -> None:
    assert receiver().open(datagram) == Refused(reason)


def test_parts_of_different_frames_stay_apart() -> None:
    """The header of one part with the body of another one is a forgery, whatever both were."""
    by = sealer()
    pair = by.seal(bodies(None, None, tuple(Portion(n, 0, 1, bytes(600)) for n in range(2)), LEFT_US, 800)[0], keys_of("robot1"))
    head = HEADER.size + SEAL_SIZE * 2
    for first, second in ((0, 1), (1, 0)):
        assert receiver().open(pair[first][:head] + pair[second][head:]) == Refused(Reason.FORGED)


@pytest.mark.parametrize("end", range(len(sealed())))
def test_a_datagram_that_ends_too_early_is_refused(end: int) -> None:
    assert isinstance(receiver().open(sealed()[:end]), Refused)


ODD_ITEMS = [
    [0, 0, 0, b"x"],
    [0, AGE_US_MAX + 1, 1, b"x"],
    [1 << 32, 0, 1, b"x"],
    [-1, 0, 1, b"x"],
    [0, -1, 1, b"x"],
    [0, 0, 1, b"x", 1],
    [0, 0, 1, b"", 0, 5],
    [0, 0, 1, b"123456", 0, 5],
    [0, 0, 1, b"12", 4, 5],
    [0, 0, 1, b"x", 0, ITEM_SIZE_MAX + 1],
    [0, 0, 1, "text"],
    [0, 0, 1],
    None,
]


@pytest.mark.parametrize("item", ODD_ITEMS)
def test_items_outside_of_their_ranges_are_refused(item: object) -> None:
    body = frame._encode((SAID, BEAT, (item,), LEFT_US))
    assert receiver().open(resealed(body)) == Refused(Reason.MALFORMED, "robot1")


@pytest.mark.parametrize("age_us", [0, 1, AGE_US_MAX - 1, AGE_US_MAX])
def test_ages_up_to_the_greatest_pass(age_us: int) -> None:
    found = receiver().open(sealed(items=(Portion(1023, age_us, (1 << 64) - 1, b"x"),)))
    assert isinstance(found, Part)
    assert found.items[0].age_us == age_us


@pytest.mark.parametrize("left_us", [LEFT_US_MAX + 1, (1 << 64) - 1])
def test_an_instant_that_no_clock_shows_is_refused(left_us: int) -> None:
    assert receiver().open(resealed(frame._encode((SAID, BEAT, (BALL,), left_us)))) == Refused(Reason.MALFORMED, "robot1")
    assert isinstance(receiver().open(resealed(frame._encode((SAID, BEAT, (BALL,), LEFT_US_MAX)))), Part)


@pytest.mark.parametrize(
    "beat",
    [Beat("robot1", 4, 1), Beat("robot1", 3, 0), Beat("robot1", 3, 1, 2), Beat("robot1", 3, 1, entries=(Entry("", 0, 0),))],
)
def test_a_beat_of_another_life_or_with_numbers_beyond_all_sense_is_refused(beat: Beat) -> None:
    assert receiver().open(sealed(beat)) == Refused(Reason.MALFORMED, "robot1")


@given(st.binary(max_size=1300))
def test_no_bytes_make_the_receiver_raise(datagram: bytes) -> None:
    assert isinstance(receiver().open(datagram), Refused)


@given(st.binary(max_size=300), st.integers(1, 2))
def test_an_authentic_body_of_any_bytes_never_raises(body: bytes, count: int) -> None:
    found = receiver().open(resealed(body, count))
    assert isinstance(found, Refused) or found.beat is None


@given(st.integers(0, 10_000))
def test_one_changed_bit_is_always_refused(where: int) -> None:
    datagram = bytearray(sealed())
    end = HEADER.size + SEAL_SIZE  # the authenticator of robot3 does not concern robot2
    places = [at for at in range(len(datagram)) if not end <= at < end + SEAL_SIZE]
    datagram[places[where // 8 % len(places)]] ^= 1 << where % 8
    assert isinstance(receiver().open(bytes(datagram)), Refused)


# --- Many parts ------------------------------------------------------------------------------------------------------

PORTIONS = st.lists(
    st.builds(
        Portion, st.integers(0, 2000), st.integers(0, AGE_US_MAX), st.integers(1, 1 << 63), st.integers(0, 9000).map(bytes)
    ),
    max_size=30,
)


@given(PORTIONS, st.booleans())
def test_every_part_fits_and_together_they_say_the_first_items_in_order(items: list[Portion], beats: bool) -> None:
    made, placed = bodies(SAID if beats else None, BEAT if beats else None, items, LEFT_US, body_size_max(3))
    assert len(made) <= PARTS_MAX
    opened, by = receiver(), sealer()
    parts = [opened.open(datagram) for datagram in by.seal(made, keys_of("robot1"))]
    assert all(isinstance(part, Part) for part in parts)
    told = [part for part in parts if isinstance(part, Part)]
    assert [part.part for part in told] == list(range(len(made)))
    assert [bool(part.flags & frame.LAST) for part in told] == [False] * (len(made) - 1) + [True]
    assert all(part.beat is None and part.slots is None for part in told[1:])
    values: dict[int, bytes] = {}
    order = list(range(placed))
    pieces = [piece for part in told for piece in part.items]
    at = 0
    for place in order:
        item = items[place]
        whole = b""
        while len(whole) < len(item.value) or (not item.value and not whole):
            piece = pieces[at]
            at += 1
            assert (piece.number, piece.age_us, piece.put, piece.offset) == (item.number, item.age_us, item.put, len(whole))
            whole += piece.value
            if not item.value:
                break
        values[place] = whole
    assert at == len(pieces)
    assert all(values[place] == items[place].value for place in order)


def test_what_does_not_fit_the_parts_of_one_frame_is_told_and_waits() -> None:
    items = [Portion(number, 0, 1, bytes(4000)) for number in range(100)]
    made, placed = bodies(SAID, BEAT, items, LEFT_US, body_size_max(3))
    assert 0 < placed < 100
    assert len(made) <= PARTS_MAX
    made, placed = bodies(None, None, items[placed:], LEFT_US, body_size_max(3))
    assert placed > 0


@pytest.mark.parametrize("members", [2, 3, 17, 18, 64])
def test_a_beat_of_the_greatest_size_fits_beside_the_slots(members: int) -> None:
    names = roster([f"robot{number}" for number in range(members)])
    echoes = tuple((rank, (1 << 62) - 1, AGE_US_MAX) for rank in range(frame.echoes_max(members)))
    views = ((1 << 64) - 1,) * -(-members // 32)
    said = Said(AGE_US_MAX, (1 << 64) - 1, AGE_US_MAX, views, echoes)
    entries = {f"/lab/robot1/part{n:03}": Entry(f"/lab/robot1/part{n:03}", 3, 1, "robot1", 64, 9, bytes(16)) for n in range(100)}
    speaker = Speaker("robot1", 1, members=members)
    heard = tuple(Echo(name, 9, 100_000) for name in names.names[1:])
    seen = set()
    for _ in range(60):
        beat = speaker.beat(entries, heard)
        assert size_of(beat) <= beat_size_max(members)
        (body,), _ = bodies(said, beat, (), (1 << 63) - 1, body_size_max(members))
        made = Sealer("robot1", "team", names, 1).seal([body], [bytes(32)] * codes(members))
        assert len(made[0]) <= FRAME_SIZE_MAX
        seen |= {entry.name for entry in beat.entries}
    assert members > 18 or seen == set(entries)


def test_a_frame_for_each_receiver_has_the_same_counter() -> None:
    """In a large team each receiver gets a datagram of its own; copies over several links are told by the counter."""
    by, made = sealer(), bodies(SAID, BEAT, (BALL,), LEFT_US, body_size_max(64))[0]
    first = by.seal(made, [KEYS["robot1", "robot2"]])
    second = by.seal(made, [KEYS["robot1", "robot3"]], again=True)
    for me, datagram in (("robot2", first[0]), ("robot3", second[0])):
        found = receiver(me).open(datagram)
        assert isinstance(found, Part)
        assert found.counter == 100
