"""The table ``[store]`` of agent.toml: where sealed copies go, and how many a witness keeps. See `failover.archive`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from failover.config.quantities import size_bytes

S3: Final = "s3://"
EVERY_S_MAX: Final = 86_400
KEEP_MAX: Final = 10_000


@dataclass(frozen=True, slots=True)
class StoreConfig:
    """The archive of one member.

    Attributes:
        s3: ``s3://BUCKET/PREFIX``, or the absolute path of a folder on another disk; "" for no archive.
        witness: the witness of the team that keeps them, in place of ``s3``; "" for none.
        s3_endpoint: URL of a server that speaks the protocol of S3; "": S3 itself, or what the environment says.
        s3_every_s: seconds between two copies of a component; one that has not changed is not copied again.
        s3_keep: copies of each component; older ones are removed.
        resume: where members vote: a component of which no robot has a checkpoint any more resumes from its newest copy.
        sealed_size: at a witness: bytes of all sealed copies that it keeps, as "20GB"; "": it keeps none.
    """

    s3: str = ""
    witness: str = ""
    s3_endpoint: str = ""
    s3_every_s: int = 60
    s3_keep: int = 10
    resume: bool = False
    sealed_size: str = ""

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
        if self.s3 and self.witness:
            raise ValueError(f"s3 is {self.s3!r} and witness {self.witness!r}: copies go to one place; remove one of the two")
        if self.resume and not self.place:
            raise ValueError("resume is true, and there is no archive; set s3 or witness, or remove resume")
        if self.sealed_size:
            try:
                size_bytes(self.sealed_size)
            except ValueError as error:
                raise ValueError(f"sealed_size: {error}") from error
        for key, value, most in (("s3_every_s", self.s3_every_s, EVERY_S_MAX), ("s3_keep", self.s3_keep, KEEP_MAX)):
            if not 1 <= value <= most:
                raise ValueError(f"{key} is {value}; it must be at least 1 and at most {most}")

    @property
    def place(self) -> str:
        """Where copies go, for people; "" for nowhere."""
        return self.s3 or (f"of witness {self.witness}" if self.witness else "")
