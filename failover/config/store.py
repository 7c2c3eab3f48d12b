"""The table ``[store]`` of agent.toml: where copies of checkpoints go that no robot keeps. See `failover.archive`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

S3: Final = "s3://"
EVERY_S_MAX: Final = 86_400
KEEP_MAX: Final = 10_000


@dataclass(frozen=True, slots=True)
class StoreConfig:
    """The archive of one member.

    Attributes:
        s3: ``s3://BUCKET/PREFIX``, or the absolute path of a folder on another disk; "" for no archive.
        s3_endpoint: URL of a server that speaks the protocol of S3; "": S3 itself, or what the environment says.
        s3_every_s: seconds between two copies of a component; one that has not changed is not copied again.
        s3_keep: copies of each component; older ones are removed.
    """

    s3: str = ""
    s3_endpoint: str = ""
    s3_every_s: int = 60
    s3_keep: int = 10

    def __post_init__(self) -> None:
        """Refuse what could not be carried out.

        Raises:
            ValueError: says which key, what is wrong with it, and what to write instead.
        """
        bucket = self.s3.removeprefix(S3).partition("/")[0] if self.s3.startswith(S3) else ""
        if self.s3 and not bucket and not self.s3.startswith("/"):
            raise ValueError(
                f's3 is {self.s3!r}, which is no place; write "s3://BUCKET/PREFIX", or the absolute path of a folder'
            )
        if self.s3_endpoint and not self.s3_endpoint.startswith(("http://", "https://")):
            raise ValueError(f's3_endpoint is {self.s3_endpoint!r}, which is no URL; write "https://HOST:PORT"')
        for key, value, most in (("s3_every_s", self.s3_every_s, EVERY_S_MAX), ("s3_keep", self.s3_keep, KEEP_MAX)):
            if not 1 <= value <= most:
                raise ValueError(f"{key} is {value}; it must be at least 1 and at most {most}")
