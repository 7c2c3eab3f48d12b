"""Tells whether a call reached a line of the project's code that no call before it had reached: such a case is changed further.

From Python 3.12 on by sys.monitoring, before by sys.settrace. A line that was reached costs nothing any more: sys.monitoring
turns it off, and a function of which every line was reached is not traced. (atheris does more, and has no wheels for aarch64.)
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from types import CodeType, FrameType
from typing import Any, Final

ROOT: Final = Path(__file__).resolve().parents[2]
FOLLOWED: Final = tuple(f"{ROOT}/{package}/" for package in ("agent", "checkpoint", "failover", "page"))
TOOL: Final = 3
"""A number that Python leaves free for tools such as this one."""


class Reached:
    """The lines that were reached so far. One at a time in a process.

    Attributes:
        count: of lines.
    """

    def __init__(self) -> None:
        self.count = 0
        self._left: dict[CodeType, set[int]] = {}
        self._monitoring: Any = getattr(sys, "monitoring", None)
        if self._monitoring is not None:
            if self._monitoring.get_tool(TOOL) is None:
                self._monitoring.use_tool_id(TOOL, "fuzz")
            self._monitoring.register_callback(TOOL, self._monitoring.events.LINE, self._line)
            self._monitoring.set_events(TOOL, self._monitoring.events.LINE)
            self._monitoring.restart_events()

    def call(self, function: Callable[[bytes], object], content: bytes) -> bool:
        """Call it; whether it reached a new line. What it raises passes through, and counts all the same (see `count`)."""
        before = self.count
        if self._monitoring is not None:
            function(content)
        else:
            sys.settrace(self._entered)
            try:
                function(content)
            finally:
                sys.settrace(None)
        return self.count > before

    def _entered(self, frame: FrameType, _event: str, _argument: object) -> Any:
        code = frame.f_code
        left = self._left.get(code)
        if left is None:
            left = self._left[code] = {line for _, _, line in code.co_lines() if line} if _is_followed(code) else set()
        if not left:
            return None

        def line_reached(inner: FrameType, _event: str, _argument: object) -> Any:
            if inner.f_lineno in left:
                left.remove(inner.f_lineno)
                self.count += 1
            return line_reached

        return line_reached(frame, "", None)

    def _line(self, code: CodeType, _line: int) -> Any:
        self.count += _is_followed(code)
        return self._monitoring.DISABLE


def _is_followed(code: CodeType) -> bool:
    return code.co_filename.startswith(FOLLOWED)
