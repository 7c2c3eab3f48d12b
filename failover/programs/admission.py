"""Whether a bundle may run on this robot, asked when it comes and again when it becomes active.

In this order, and each step only if the one before said yes: a known key; not expired; the digest; the signature; the form; what
it needs is here; its author has the right `program` on its path. Until then nothing of it is unpacked.
"""

from __future__ import annotations

import importlib.util
import time
from datetime import UTC, date, datetime
from pathlib import Path

from msgspec import Struct

from failover.client.control import Control
from failover.config import accounts, programs, rights
from failover.core.programs import bundle
from failover.core.programs.bundle import Program, Signature
from failover.core.rights import hours
from failover.core.rights.rules import decide, without_rules
from failover.errors import AgentRefusedError, BundleRefusedError, LostAgentError, NoAgentError, RightsError
from failover.programs import keys

RIGHT = "program"


class Admitted(Struct, frozen=True):
    """A bundle that may run here. ``because``: the decision about its author's right."""

    program: Program
    owner: str
    because: str


def admit(content: bytes | memoryview, team: Path) -> Admitted:
    """Check all of a bundle.

    Args:
        team: the team directory, with programs.toml and rights.toml.

    Raises:
        BundleRefusedError: says why.
        FileMistakeError: programs.toml or rights.toml is mistaken.
        ProgramError: the library for signatures is not installed.
    """
    signature, rest = bundle.split(content)
    owner = _owner(signature, rest, team)
    program = bundle.read(rest)
    missing = [one for one in program.manifest.needs if not _is_here(one)]
    if missing:
        raise BundleRefusedError(
            f"{program.manifest.name} needs {', '.join(missing)}, not here: install it, and send the bundle again"
        )
    return Admitted(program, owner, check_right(owner, program.manifest.path, team))


def _owner(signature: Signature | None, rest: memoryview, team: Path) -> str:
    """Whose word this is, once it is proved."""
    file = team / programs.PROGRAMS_FILE
    if signature is None:
        raise BundleRefusedError("the bundle has no signature: failover program sign FILE --key KEY")
    key = programs.read(team).get(signature.key)
    if key is None:
        raise BundleRefusedError(
            f"the bundle is signed by the key {signature.key[:16]}…, which is not in {file}: add it there, with its owner"
        )
    now_s = time.time()
    if datetime.fromtimestamp(now_s, UTC).date() > key.last_day():
        raise BundleRefusedError(f"the key of {key.owner} expired on {key.until} ({file}): sign with a new key")
    if signature.until_s and now_s > signature.until_s:
        day = date.fromtimestamp(signature.until_s)
        raise BundleRefusedError(f"the signature of {key.owner} expired on {day}: sign the bundle anew")
    if bundle.digest_of(rest) != signature.digest:
        raise BundleRefusedError(
            f"the bundle was changed after {key.owner} signed it: its content has another digest than the signature"
        )
    text = bundle.signed_text(signature.digest, signature.key, signature.signed_s, signature.until_s)
    if not keys.is_signed(text, signature.key, signature.signature):
        raise BundleRefusedError(f"the signature is not one of {key.owner}'s key: the bundle is forged or damaged")
    return key.owner


def _is_here(module: str) -> bool:
    """Whether a module is installed; nothing is imported but the packages above it."""
    try:
        return importlib.util.find_spec(module.partition(".")[0]) is not None
    except (ImportError, ValueError):
        return False


def check_right(owner: str, path: str, team: Path) -> str:
    """The decision that lets this person's programs speak for this path, as of now.

    Raises:
        BundleRefusedError: the rules say no, or it cannot be known.
        FileMistakeError: rights.toml is mistaken.
    """
    found = rights.read(team)
    if found is not None and found.config.source == "ldap":
        return _asked(owner, path)
    try:
        subject = accounts.subject_named(owner, found.config.groups if found is not None else {})
        if found is None:
            answer = without_rules(subject, RIGHT, path)
        else:
            now = datetime.now()
            minute = hours.minute_of(now.weekday(), now.hour, now.minute)
            answer = decide(found.rules, subject, RIGHT, path, minute)
    except RightsError as error:
        raise BundleRefusedError(f"the right of {owner} to send programs cannot be known: {error}") from error
    if not answer:
        raise BundleRefusedError(f"{answer.because}; docs/rights.md says how a rule gives the right {RIGHT}")
    return answer.because


def _asked(owner: str, path: str) -> str:
    """The agent's word, which knows the directory server."""
    try:
        with Control.open() as agent:
            answer = agent.ask("rights", user=owner, right=RIGHT, path=path)
    except (NoAgentError, LostAgentError, AgentRefusedError) as error:
        raise BundleRefusedError(
            f"the agent asks the directory server for the rights of {owner}, and does not tell them: {error}"
        ) from error
    if not answer["allow"]:
        raise BundleRefusedError(str(answer["because"]))
    return str(answer["because"])
