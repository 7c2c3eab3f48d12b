"""How many components a user may have: no user takes from the others the names that the team follows."""

from __future__ import annotations

from typing import Final

import pytest

from agent.errors import RefusedError
from agent.worker.control.quotas import NAMES_FOR_EACH, check_components
from failover.core.types import ComponentView, Protection, State

ALICE: Final = 7001
BOB: Final = 7002
MOST: Final = 3


def seen(number: int, state: State = State.PRIMARY, owner: int = ALICE) -> ComponentView:
    return ComponentView(f"/lab/r1/program-{number}", state, 1, "r1", "", Protection.NONE, -1, 0, (), "", owner=owner)


def test_a_user_may_have_so_many_components_whether_they_run_or_have_ended() -> None:
    known = [seen(1), seen(2, State.FINISHED), seen(3, State.FAILED)]
    check_components(ALICE, "/lab/r1/new", known[:2], MOST)
    with pytest.raises(RefusedError, match=r"uid 7001 has 3 components, the most .*components_per_user.*2 of them have ended"):
        check_components(ALICE, "/lab/r1/new", known, MOST)


def test_what_others_have_and_a_name_that_is_used_again_do_not_count() -> None:
    known = [seen(1), seen(2), seen(3)]
    check_components(BOB, "/lab/r1/new", known, MOST)
    check_components(ALICE, known[0].name, known, MOST)


def test_root_may_have_any_number() -> None:
    check_components(0, "/lab/r1/new", [seen(number, owner=0) for number in range(100)], MOST)


def test_names_that_were_released_keep_their_place_and_can_be_taken_again() -> None:
    known = [seen(number, State.RELEASED) for number in range(NAMES_FOR_EACH * MOST)]
    with pytest.raises(RefusedError, match=r"uid 7001 has used 6 names .* take one of them again .*program-0 for one"):
        check_components(ALICE, "/lab/r1/new", known, MOST)
    check_components(ALICE, known[-1].name, known, MOST)
    check_components(ALICE, "/lab/r1/new", known[1:], MOST)
