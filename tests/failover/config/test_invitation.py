"""Invitations: the line, what is refused of it, the keys that follow from it."""

from __future__ import annotations

import pytest
from msgspec.structs import replace

from failover.config.invitation import SECRET_SIZE, Invitation, read
from failover.errors import InvitationError

GIVEN = Invitation("r2", "192.168.7.11", 7423, bytes(range(SECRET_SIZE)))


@pytest.mark.parametrize(
    "given",
    [
        GIVEN,
        replace(GIVEN, host="fd00::1"),
        replace(GIVEN, robot="机器人@2"),
        replace(GIVEN, port=1),
        replace(GIVEN, role="witness"),
    ],
)
def test_a_line_is_read_as_it_was_printed(given: Invitation) -> None:
    assert read(given.line) == given
    assert read(f"  {given.line}\n") == given


def test_every_other_line_is_refused_in_a_sentence() -> None:
    line = GIVEN.line
    changed = [
        line[:place] + other + line[place + 1 :] for place in range(len(line)) for other in "a7@/:" if line[place] != other
    ]
    cut = [line[:end] for end in range(len(line))]
    for other in (*changed, *cut, line + "a", line.upper(), "r2", "", "@:/", "r2@h:0/aaaa", "r2@h:99999/aaaa", "\0"):
        with pytest.raises(InvitationError, match="copy the line"):
            read(other)


def test_another_name_role_or_secret_makes_other_keys() -> None:
    others = [GIVEN, replace(GIVEN, robot="r3"), replace(GIVEN, role="server"), replace(GIVEN, secret=bytes(SECRET_SIZE))]
    keys = [key for one in others for key in (one.inviting_secret(), one.joining_secret())]
    assert len(set(keys)) == 8
    assert replace(GIVEN, host="10.0.0.1", port=1).inviting_secret() == GIVEN.inviting_secret()
