"""The page's own files, each at an address with a hash of its content: a browser keeps it for good, and never has an old one."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Final

from msgspec import Struct

FOLDER: Final = Path(__file__).parent / "assets"
INDEX: Final = "index.html"
KINDS: Final = {".css": "text/css", ".js": "text/javascript", ".svg": "image/svg+xml"}
HASH_SIZE: Final = 8
"""Bytes of the hash in a name."""


class Asset(Struct, frozen=True):
    """One file as it is served."""

    kind: str
    content: bytes


class Assets:
    """All of them, read once."""

    def __init__(self, folder: Path = FOLDER) -> None:
        self._files: dict[str, Asset] = {}
        page = (folder / INDEX).read_text()
        for path in sorted(folder.iterdir()):
            if path.suffix in KINDS:
                content = path.read_bytes()
                name = f"{path.stem}.{hashlib.blake2b(content, digest_size=HASH_SIZE).hexdigest()}{path.suffix}"
                self._files[name] = Asset(f"{KINDS[path.suffix]}; charset=utf-8", content)
                page = page.replace(f"/assets/{path.name}", f"/assets/{name}")
        self.index = page.encode()

    def get(self, name: str) -> Asset | None:
        """The file of that name, hash included; None: there is none."""
        return self._files.get(name)
