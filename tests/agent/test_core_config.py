"""The terms on which a component begins and comes back: what came with it, and this robot's own rules."""

from __future__ import annotations

import pytest

from agent.config import ComponentConfig
from agent.core_config import terms_here
from failover.core.types import DETACH, REFUSE, Launch


@pytest.mark.parametrize("said", [REFUSE, DETACH])
@pytest.mark.parametrize("here", ["refuse", "detach"])
def test_what_was_said_at_the_start_counts_on_every_robot(said: str, here: str) -> None:
    component = ComponentConfig(shared_memory="detach" if here == "detach" else "refuse")
    assert terms_here(Launch(shared_memory=said), component).detaches_memory == (said == DETACH)


def test_without_a_launch_this_robots_own_rule_counts() -> None:
    assert terms_here(None, ComponentConfig(shared_memory="detach")).detaches_memory
    assert not terms_here(None, ComponentConfig()).detaches_memory
