"""Programs that are taken over resume after their predecessors."""

from __future__ import annotations

import asyncio

from agent.worker.components.resume_order import ResumeOrder


def test_a_program_resumes_after_its_predecessors_or_in_vain() -> None:
    async def resumed() -> list[str]:
        order, done = ResumeOrder({"map": ("odometry",), "plan": ("map",)}), list[str]()
        for name in ("plan", "map", "odometry", "alone"):
            order.begins(name)

        async def resume(name: str) -> None:
            assert not await order.turn_of(name)
            done.append(name)
            order.ended(name)

        async with asyncio.TaskGroup() as group:
            for name in ("plan", "map", "alone", "odometry"):
                group.create_task(resume(name))
        return done

    done = asyncio.run(resumed())
    assert [name for name in done if name != "alone"] == ["odometry", "map", "plan"]


def test_a_program_does_not_wait_for_ever() -> None:
    async def waited() -> frozenset[str]:
        order = ResumeOrder({"map": ("odometry",)})
        order.begins("odometry")
        return await order.turn_of("map", 0.01)

    assert asyncio.run(waited()) == {"odometry"}
