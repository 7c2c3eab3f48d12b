"""Fresh key pairs, made by the agent's program: it alone knows the cryptography, and this package never imports it."""

from __future__ import annotations

import json
import subprocess
import sys

from failover.errors import TeamFileError


def new_pair() -> tuple[str, str]:
    """A CURVE pair, public and secret, each 40 characters of Z85.

    Raises:
        TeamFileError: the agent's program is not installed, or made no keys.
    """
    ran = subprocess.run([sys.executable, "-P", "-m", "agent.main", "keypair"], capture_output=True, text=True, check=False)
    try:
        pair = json.loads(ran.stdout)
        return str(pair["public"]), str(pair["secret"])
    except (ValueError, KeyError, TypeError) as error:
        said = (ran.stderr.strip() or ran.stdout.strip() or "nothing").splitlines()[-1]
        raise TeamFileError(f"failover-agent keypair made no keys; it said: {said}") from error
