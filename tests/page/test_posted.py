"""What a browser posts is checked before anything is done with it: any bytes are an order, or are refused in words."""

from __future__ import annotations

import asyncio
from typing import Any

import pytest

pytest.importorskip("starlette")

from starlette.requests import Request

from page import app
from page.errors import TurnedAwayError


def posted(content: bytes) -> app.Login:
    async def receive() -> dict[str, Any]:
        return {"type": "http.request", "body": content, "more_body": False}

    headers = [(b"content-type", b"application/json")]
    return asyncio.run(app._body(Request({"type": "http", "method": "POST", "headers": headers}, receive), app.Login))


def test_a_login_is_read() -> None:
    assert posted(b'{"name":"anna","password":"x"}') == app.Login("anna", "x")


@pytest.mark.parametrize("content", [b"", b"{", b'{"name":"\xff","password":"x"}', b'{"name":' + b"[" * 12_000, b"[]"])
def test_what_no_page_posts_is_turned_away(content: bytes) -> None:
    with pytest.raises(TurnedAwayError, match="a request that no page of ours sends"):
        posted(content)
