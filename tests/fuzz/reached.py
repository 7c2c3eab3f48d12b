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

    def call(self, function: Callable[[bytes], object], content: bytes) -> bool:
        """Call it; whether it reached a new line. What it raises passes through, and counts all the same (see `count`)."""
        before = self.count
        if hasattr(sys, "monitoring"):
            self._monitored(function, content)
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

    def _monitored(self, function: Callable[[bytes], object], content: bytes) -> None:
        monitoring: Any = sys.monitoring  # type: ignore[attr-defined, unused-ignore]
        if monitoring.get_tool(TOOL) is None:
            monitoring.use_tool_id(TOOL, "fuzz")
            monitoring.register_callback(TOOL, monitoring.events.LINE, self._line)
        monitoring.set_events(TOOL, monitoring.events.LINE)
        try:
            function(content)
        finally:
            monitoring.set_events(TOOL, 0)

    def _line(self, code: CodeType, _line: int) -> Any:
        self.count += _is_followed(code)
        return sys.monitoring.DISABLE  # type: ignore[attr-defined, unused-ignore]


def _is_followed(code: CodeType) -> bool:
    return code.co_filename.startswith(FOLLOWED)
